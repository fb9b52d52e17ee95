//! What the audit log has of operators and of the unit's own program.

use std::path::PathBuf;

use cara_std::control::Control;
use cara_std::control::protocol::{Answer, Question};
use cara_std::{
    Error, Parameters, ParametersView, Peer, Renew, RequestOptions, Served, ServiceError, ServiceOptions, Unit,
};
use serde_json::Value;

use crate::support::{Depot, ask, call, manager, until};

/// So long that nothing here ends by time.
const LEASE: cara_std::Duration = cara_std::Duration::from_secs(600);

/// A depot with an audit log and a vehicle that drives, halts and is reset.
pub(crate) struct Audited {
    pub(crate) depot: Depot,
    peer: Peer<()>,
    path: PathBuf,
    agv: Unit,
}

impl Audited {
    pub(crate) fn new() -> Self {
        let depot = Depot::of(|fleet, directory| {
            let builder = manager("manager", 1, fleet).control(Control::Path(directory.join("manager.sock")));
            builder.audit(directory.join("audit")).unwrap()
        });
        let agv = depot.agv("agv", 7);
        let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let wheels = agv.my_function_list().actuator(|| {}).unwrap();
        let services = [
            ("drive()", ServiceOptions::new().moves(&wheels, LEASE)),
            ("halt()", ServiceOptions::new().stops(&wheels)),
            ("brake()", ServiceOptions::new().stops(&wheels)),
            ("free()", ServiceOptions::new().resets(&wheels)),
        ];
        for (definition, options) in services {
            agv.my_function_list().add_service(&definition.parse().unwrap(), options, nothing).unwrap();
        }
        agv.publish_my_function_list().unwrap();
        let peer = depot.system.s_unit("agv").unwrap();
        until("it is known", || peer.function("free").is_some());
        let path = depot.directory.path().join("audit");
        Self { depot, peer, path, agv }
    }

    pub(crate) fn lines(&self) -> Vec<Value> {
        let text = std::fs::read_to_string(&self.path).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// What each asked, of what, and its outcome.
    fn all(&self) -> Vec<[String; 3]> {
        let word = |value: &Value| value.as_str().unwrap_or("-").to_owned();
        self.lines().iter().map(|line| ["ask", "function", "outcome"].map(|key| word(&line[key]))).collect()
    }

    /// The same, once there are so many.
    fn reported(&self, count: usize) -> Vec<[String; 3]> {
        until("it is told", || self.lines().len() >= count);
        self.all()
    }

    /// The same without resets that came too early, which count for none.
    fn done(&self, count: usize) -> Vec<[String; 3]> {
        let done = || {
            let mut all = self.all();
            all.retain(|line| *line != ["reset", "free", "Inhibited"]);
            all
        };
        until("it is told", || done().len() >= count);
        done()
    }

    fn call(&self, function: &str, options: &RequestOptions) -> Result<(), Error> {
        self.peer.call(function, &mut Parameters::new()).with(*options).wait().map_err(Error::from)
    }
}

fn line(ask: &str, function: &str, outcome: &str) -> [String; 3] {
    [ask, function, outcome].map(str::to_owned)
}

#[test]
fn the_end_of_a_hold_is_noted_whichever_end_it_takes() {
    let audited = Audited::new();
    let hold = || Question::Hold(call(Some("agv"), "drive", vec![]));
    let held = |answer: Option<Result<Answer, _>>| matches!(answer, Some(Ok(Answer::Called { error: None, .. })));

    // As with Ctrl-C, or where the client is killed: its connection is closed.
    let mut client = audited.depot.client();
    assert!(held(client.ask(&hold()).unwrap().next()));
    drop(client);
    let mut expected = vec![line("hold", "drive", "ok"), line("hold", "drive", "released")];
    assert_eq!(audited.reported(2), expected);

    // A plain call of the same function takes it over, and the holder is told.
    let mut client = audited.depot.client();
    let mut holding = client.ask(&hold()).unwrap();
    assert!(held(holding.next()));
    let mut other = audited.depot.client();
    ask(&mut other, Question::Call(call(Some("agv"), "drive", vec![]))).unwrap();
    let end = holding.next().unwrap().unwrap_err();
    assert!(end.to_string().contains("took over"), "{end}");
    let mut reported = audited.reported(5);
    // The call and the end of the hold are noted by two threads.
    reported[3..].sort();
    expected.extend([line("hold", "drive", "ok"), line("call", "drive", "ok"), line("hold", "drive", "TakenOver")]);
    assert_eq!(reported, expected);

    // The unit itself is stopped.
    assert!(held(client.ask(&hold()).unwrap().next()));
    audited.depot.system.stop();
    expected.extend([line("hold", "drive", "ok"), line("hold", "drive", "stopped")]);
    let mut reported = audited.reported(7);
    reported[3..5].sort();
    assert_eq!(reported, expected);
    assert!(audited.lines().iter().all(|line| line["origin"] == "operator" && line["node"] == "agv/7"));
}

#[test]
fn stops_and_resets_are_noted_with_their_functions() {
    let audited = Audited::new();
    let mut client = audited.depot.client();
    ask(&mut client, Question::Stop { node: None }).unwrap();
    // One that may have been asked for before the stop lifts nothing.
    let is_reset = |answers: Vec<Answer>| matches!(answers[..], [Answer::Called { error: None, .. }]);
    let reset = || Question::Reset { node: Some("agv".to_owned()) };
    until("it is reset", || is_reset(ask(&mut client, reset()).unwrap()));
    assert_eq!(audited.done(2), [line("stop", "halt,brake", "ok"), line("reset", "free", "ok")]);
}

#[test]
fn what_the_program_moves_stops_and_resets_is_noted() {
    let audited = Audited::new();
    let wanted = RequestOptions::renewing(Renew::Process);
    assert_eq!(audited.call("drive", &wanted), Ok(()));
    assert_eq!(audited.call("halt", &RequestOptions::default()), Ok(()));
    assert!(matches!(audited.call("drive", &wanted), Err(Error::Inhibited { .. })));
    until("it is reset", || audited.call("free", &RequestOptions::default()) == Ok(()));
    audited
        .peer
        .call("drive", &mut Parameters::new())
        .with(RequestOptions { take_over: true, ..wanted })
        .send()
        .unwrap();
    let none: Parameters = Parameters::new();
    let all = audited.depot.system.call_all("halt", &none).wait();
    assert!(all.iter().all(|(_, outcome)| outcome.is_ok()), "{all:?}");
    let expected = [
        line("call", "drive", "ok"),
        line("stop", "halt", "ok"),
        line("call", "drive", "Inhibited"),
        line("reset", "free", "ok"),
        line("call", "drive", "ok"),
        line("stop", "halt", "ok"),
    ];
    assert_eq!(audited.done(6), expected);
    let lines = audited.lines();
    assert!(lines.iter().all(|line| line["origin"] == "program" && line["node"] == "agv/7"), "{lines:?}");
    assert!(lines.iter().all(|line| line["pid"] == std::process::id()), "{lines:?}");
    let take_overs: Vec<_> = lines.iter().filter(|line| line["take_over"] == true).collect();
    assert!(matches!(take_overs[..], [line] if line["function"] == "drive"), "{take_overs:?}");

    // What moves nothing is not noted.
    let before = lines.len();
    assert!(matches!(audited.call("fail", &RequestOptions::default()), Err(Error::Service(_))));
    audited.agv.stop();
    until("it has gone", || !audited.peer.is_connected());
    assert_eq!(audited.call("halt", &RequestOptions::default()), Err(Error::NotConnected));
    assert_eq!(audited.lines().len(), before);
}
