//! A node that hangs. It is this test binary again, in a process that can be stopped; it ends with its standard input.

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use cara_std::Error;
use cara_std::control::protocol::{Answer, CallQuestion, Question};
use rustix::process::{Pid, Signal, kill_process};

use crate::support::{Depot, ask, call, ping, until, vehicle};

const FLEET: &str = "CARA_TEST_FLEET";

struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "run by the other test here, in a process of its own"]
fn as_child() {
    let fleet = std::env::var(FLEET).expect("the fleet").parse().unwrap();
    let agv = vehicle("agv", 7, fleet).build().unwrap();
    let nothing =
        |_: &cara_std::Served, _: &mut cara_std::ParametersView| -> Result<(), cara_std::ServiceError> { Ok(()) };
    agv.my_function_list().add_service(&"nothing()".parse().unwrap(), Default::default(), nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
}

#[test]
fn nothing_waits_for_a_node_that_hangs() {
    let depot = Depot::new();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "frozen::as_child", "--ignored", "--test-threads=1"]).env(FLEET, depot.fleet.to_string());
    let agv = Process(command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap());
    until("it offers its function", || !depot.system.nodes_offering("nothing").is_empty());
    let peer = depot.system.s_unit("agv").unwrap();
    let mut client = depot.client();
    assert!(matches!(ask(&mut client, ping("agv", 1, 20_000)).unwrap()[..], [Answer::Sample { us: Some(_), .. }]));
    cara_processes::freeze(&agv.0).unwrap();
    // Whatever was on its way; from here on nothing answers.
    until("it stands still", || {
        peer.ping(Duration::from_millis(50)) != Err(Error::NotConnected)
            && peer.ping(Duration::from_millis(50)).is_err()
    });
    // The link ends some seconds later, which is another error.
    let ended = |error: &str| ["TimedOut", "NotConnected", "Interrupted"].contains(&error);
    let answers = ask(&mut client, ping("agv", 2, 100)).unwrap();
    assert_eq!(answers.len(), 2);
    for answer in answers {
        assert!(
            matches!(&answer, Answer::Sample { us: None, error: Some(failure) } if ended(&failure.error)),
            "{answer:?}"
        );
    }
    let question = CallQuestion { timeout_ms: Some(100), ..call(Some("agv"), "nothing", vec![]) };
    let answers = ask(&mut client, Question::Call(question)).unwrap();
    assert!(
        matches!(&answers[..], [Answer::Called { error: Some(failure), .. }] if ended(&failure.error)),
        "{answers:?}"
    );
    until("its link has ended", || !peer.is_connected());
    assert_eq!(peer.ping(Duration::from_millis(50)), Err(Error::NotConnected));
    kill_process(Pid::from_child(&agv.0), Signal::CONT).unwrap();
    until("it is back and answers", || peer.ping(Duration::from_secs(1)).is_ok());
}
