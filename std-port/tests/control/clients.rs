//! Clients that misbehave, that are too many, and that find their unit or not.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, ArgumentValue, CONTROL_VERSION, LONGEST_LINE, Question};
use cara_std::control::{Client, Control, ControlError, RunningUnit, UnitState, running_in};

use crate::support::{Depot, PATIENCE, ask, call, manager, until};

/// A client by hand, behind the hello.
struct Raw {
    stream: UnixStream,
    reader: BufReader<UnixStream>,
}

impl Raw {
    fn new(depot: &Depot) -> Self {
        let stream = UnixStream::connect(depot.path()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let reader = BufReader::new(stream.try_clone().unwrap());
        let mut raw = Self { stream, reader };
        assert!(matches!(raw.read(), Answer::Hello { .. }));
        raw
    }

    /// One that is not idle.
    fn watching(depot: &Depot) -> Self {
        let mut raw = Self::new(depot);
        raw.write(b"{\"ask\":\"watch\"}\n");
        assert!(matches!(raw.read(), Answer::Event { event, .. } if event == "watching"));
        raw
    }

    fn write(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).unwrap();
    }

    fn read(&mut self) -> Answer {
        let mut line = String::new();
        self.reader.read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{line}: {error}"))
    }

    fn is_refused_with(&mut self, name: &str) {
        assert!(matches!(self.read(), Answer::Failed(failure) if failure.error == name));
    }

    /// The connection serves as before.
    fn continues(&mut self) {
        self.write(b"{\"ask\":\"search\"}\n");
        assert_eq!(self.read(), Answer::Done);
    }
}

#[test]
fn what_is_no_question_is_told_so_and_the_next_line_is_read() {
    let depot = Depot::new();
    let mut raw = Raw::new(&depot);
    let deep = format!("{}\n", "[".repeat(100_000));
    for garbage in [
        &b"hello\n"[..],
        b"{}\n",
        b"{\"ask\":\"fly\"}\n",
        b"{\"ask\":\"functions\"}\n",
        b"{\"ask\":\"functions\",\"node\":7}\n",
        b"{\"ask\":\"functions\",\"node\":\"a\",\"more\":1}\n",
        b"\xff\xfe\x00\n",
        b"{\"ask\":\"ping\",\"node\":\"a\",\"count\":-1,\"pause_us\":0,\"timeout_ms\":0}\n",
        deep.as_bytes(),
    ] {
        raw.write(garbage);
        raw.is_refused_with("BadQuestion");
        raw.continues();
    }
    // An empty line is a sign of life, and not answered.
    raw.write(b"\n\n");
    raw.continues();
}

/// What a client keeps moving takes its signs of life: `go_to` has a lease of 2 s.
#[test]
fn what_a_client_holds_ends_without_its_signs_of_life() {
    let (depot, _agv) = Depot::with_agv();
    let position = crate::support::argument("position", 2, ArgumentValue::Int(vec![1, 2]));
    let go_to = call(Some("agv"), "go_to", vec![position]);
    let mut silent = Raw::new(&depot);
    silent.write(&[serde_json::to_vec(&Question::Hold(go_to)).unwrap(), b"\n".to_vec()].concat());
    let ended = loop {
        match silent.read() {
            Answer::Failed(failure) => break failure,
            answer => assert!(matches!(answer, Answer::Called { .. }), "{answer:?}"),
        }
    };
    assert_eq!(ended.error, "Unattended", "{ended}");
    silent.continues();
}

/// A hop passes on the signs of life of its own client, and makes none up.
#[test]
fn what_is_held_for_another_client_takes_that_ones_signs_of_life() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    client.leave_beats();
    let (beater, closer) = (client.closer().unwrap(), client.closer().unwrap());
    std::thread::spawn(move || {
        std::thread::sleep(PATIENCE);
        closer.close();
    });
    let beats = std::thread::spawn(move || {
        let (started, mut last, mut gap) = (Instant::now(), Instant::now(), Duration::ZERO);
        while started.elapsed() < Duration::from_secs(3) {
            beater.beat();
            gap = gap.max(last.elapsed());
            last = Instant::now();
            std::thread::sleep(Duration::from_millis(100));
        }
        (last, gap)
    });
    let position = crate::support::argument("position", 2, ArgumentValue::Int(vec![1, 2]));
    let hold = Question::Hold(call(Some("agv"), "go_to", vec![position]));
    let answers: Vec<_> = client.ask(&hold).unwrap().collect();
    let ended = Instant::now();
    assert!(matches!(answers.last(), Some(Err(ControlError::Failed(why))) if why.error == "Unattended"), "{answers:?}");
    let (last, gap) = beats.join().unwrap();
    assert!(ended >= last || gap >= Duration::from_secs(1), "it ended while they came, {gap:?} apart");
}

#[test]
fn a_line_that_is_too_long_is_passed_over() {
    let depot = Depot::new();
    let mut raw = Raw::new(&depot);
    let mut long = vec![b' '; LONGEST_LINE + 1];
    long.push(b'\n');
    raw.write(&long);
    raw.is_refused_with("TooLong");
    raw.continues();
    // As long as may be is read.
    let question = b"{\"ask\":\"search\"}\n";
    let mut longest = vec![b' '; LONGEST_LINE + 1 - question.len()];
    longest.extend_from_slice(question);
    raw.write(&longest);
    assert_eq!(raw.read(), Answer::Done);
}

#[test]
fn half_a_line_is_no_question_and_costs_nothing() {
    let depot = Depot::new();
    // Fewer than may be open at a time: their threads leave their places a little later.
    for _ in 0..5 {
        let mut raw = Raw::new(&depot);
        raw.write(b"{\"ask\":\"sea");
        drop(raw);
    }
    // The threads of closed connections free their slots.
    until("there is room", || Client::connect(&depot.path()).is_ok());
    let mut raw = Raw::new(&depot);
    raw.write(b"{\"ask\":\"sea");
    raw.write(b"rch\"}\n");
    assert_eq!(raw.read(), Answer::Done);
    // A client that has closed its sending direction still gets its answers.
    raw.write(b"{\"ask\":\"unit\"}\n{\"ask\":\"sea");
    raw.stream.shutdown(std::net::Shutdown::Write).unwrap();
    assert!(matches!(raw.read(), Answer::Unit(_)));
    assert_eq!(raw.read(), Answer::Done);
    assert_eq!(raw.reader.read(&mut [0; 1]).unwrap(), 0);
}

#[test]
fn a_client_that_does_not_read_is_cut_off_and_disturbs_nobody() {
    let (depot, _agv) = Depot::with_agv();
    let mut deaf = Raw::new(&depot);
    deaf.stream.set_write_timeout(Some(PATIENCE)).unwrap();
    std::thread::scope(|scope| {
        let flood = scope.spawn(move || {
            let question = b"{\"ask\":\"counters\"}\n".repeat(100);
            loop {
                if let Err(error) = deaf.stream.write_all(&question) {
                    return error.kind();
                }
            }
        });
        let mut client = depot.client();
        while !flood.is_finished() {
            let answers = ask(&mut client, Question::Call(call(Some("agv"), "echo", crate_arguments()))).unwrap();
            assert!(matches!(&answers[..], [Answer::Called { error: None, .. }]), "{answers:?}");
        }
        let cut_off = [std::io::ErrorKind::BrokenPipe, std::io::ErrorKind::ConnectionReset];
        let end = flood.join().unwrap();
        assert!(cut_off.contains(&end), "{end}");
    });
}

fn crate_arguments() -> Vec<cara_std::control::protocol::Argument> {
    use crate::support::argument;
    use cara_std::control::protocol::Number;
    vec![
        argument("i", 2, ArgumentValue::Int(vec![1, 2])),
        argument("f", 4, ArgumentValue::Float(vec![Number::Finite(1.0); 4])),
        argument("s", 20, ArgumentValue::String(String::new())),
        argument("b", 2, ArgumentValue::Bool(vec![true, false])),
        argument("y", 8, ArgumentValue::Bytes(String::new())),
    ]
}

#[test]
fn the_ninth_client_is_told_why_it_is_not_taken() {
    let depot = Depot::new();
    let mut clients: Vec<_> = (0..8).map(|_| Raw::watching(&depot)).collect();
    match Client::connect(&depot.path()) {
        Err(error @ ControlError::Full { .. }) => assert!(error.to_string().contains("close one"), "{error}"),
        other => panic!("{:?}", other.map(|client| client.unit().clone())),
    }
    let units = running_in(depot.directory.path()).unwrap();
    assert!(matches!(&units[..], [RunningUnit { state: UnitState::Full(_), .. }]), "{units:?}");
    assert!(matches!(Client::find_in(depot.directory.path(), None), Err(ControlError::Full { .. })));
    let mut stops = Client::connect_to_stop(&depot.path()).unwrap();
    assert!(
        stops.ask(&Question::Stop { node: None }).unwrap().all(|answer| answer.is_ok()),
        "there is nothing to be stopped"
    );
    let other: Vec<_> = stops.ask(&Question::Metrics).unwrap().collect();
    assert!(matches!(&other[..], [Err(ControlError::Failed(failure))] if failure.error == "Full"), "{other:?}");
    clients.pop();
    until("there is room again", || Client::connect(&depot.path()).is_ok());
}

/// Clients that ask nothing give way, and one that waits for events does not.
#[test]
fn idle_clients_do_not_lock_the_operator_out() {
    let depot = Depot::new();
    let mut watching = Raw::watching(&depot);
    let mut idle: Vec<_> = (0..7).map(|_| depot.client()).collect();
    let mut more = Vec::new();
    for _ in 0..8 {
        until("the next one is taken", || Client::connect(&depot.path()).map(|client| more.push(client)).is_ok());
    }
    let serves = |client: &mut Client| {
        client.ask(&Question::Unit).is_ok_and(|mut answers| matches!(answers.next(), Some(Ok(_))))
    };
    assert!(!idle.iter_mut().all(serves), "some had to go");
    let _agv = depot.agv("agv", 7);
    assert!(matches!(watching.read(), Answer::Event { event, .. } if event == "joined" || event == "not_joined"));
}

/// A unit that hangs takes the time of a question to it, not of one to another unit.
#[test]
fn a_unit_that_hangs_holds_up_no_question_to_another() {
    let depot = Depot::new();
    let directory = depot.directory.path();
    let _hung: Vec<_> =
        (1..4).map(|id| UnixListener::bind(directory.join(format!("hung-{id}-3.sock"))).unwrap()).collect();
    let other = manager("other", 9, depot.fleet).control(Control::Path(directory.join("other-9-3.sock")));
    let other = other.build().unwrap();
    other.start().unwrap();
    let took = |unit: Option<&str>| {
        let start = std::time::Instant::now();
        let found = Client::find_in(directory, unit).map(|client| client.unit().unit.clone());
        (found.ok(), start.elapsed())
    };
    let (found, of_another) = took(Some("other/9"));
    let (_, of_all) = took(None);
    assert_eq!(found.as_deref(), Some("other/9"));
    // One time-out for all hanging units together, and none for a question to another unit. Comparing the two does not
    // depend on the speed of the machine.
    assert!(of_all >= Duration::from_secs(2) && of_another < of_all, "{of_another:?}, {of_all:?}");
    let units = running_in(directory).unwrap();
    assert_eq!(units.iter().filter(|unit| unit.state == UnitState::Silent).count(), 3);
}

#[test]
fn a_unit_that_takes_no_connection_is_said_to_stand_still() {
    let directory = crate::support::directory();
    let _listener = UnixListener::bind(directory.path().join("m_1-7-3.sock")).unwrap();
    let units = running_in(directory.path()).unwrap();
    let expected = ("m_1/7".to_owned(), 3, UnitState::Silent);
    assert_eq!(
        units.iter().map(|unit| (unit.unit.clone(), unit.fleet, unit.state.clone())).collect::<Vec<_>>(),
        [expected]
    );
    match Client::find_in(directory.path(), Some("m_1")) {
        Err(error @ ControlError::Silent { .. }) => assert!(error.to_string().contains("restart it"), "{error}"),
        other => panic!("{:?}", other.err()),
    }
}

/// One that introduces itself, takes a question, answers with each beginning of `answer` on a connection of its own, and then
/// stands still: it accepts nothing more and closes nothing.
#[test]
fn a_question_ends_whatever_part_of_the_answer_came_before_the_unit_hung() {
    let answer = b"{\"answer\":\"done\"}\n";
    let directory = crate::support::directory();
    let path = directory.path().join("m_1-7-3.sock");
    let listener = UnixListener::bind(&path).unwrap();
    let hello =
        format!("{{\"answer\":\"hello\",\"control_version\":{CONTROL_VERSION},\"unit\":\"m_1/7\",\"fleet\":3}}\n");
    // Before the first question: who asks looks at the unit again on a connection of its own.
    let connected: Vec<_> = (0..answer.len())
        .map(|_| {
            let path = path.clone();
            let client = std::thread::spawn(move || Client::connect(&path).unwrap());
            let mut stream = listener.accept().unwrap().0;
            stream.write_all(hello.as_bytes()).unwrap();
            (client.join().unwrap(), stream)
        })
        .collect();
    let (ended, outcomes) = channel();
    let mut streams = Vec::new();
    for (length, (mut client, mut stream)) in connected.into_iter().enumerate() {
        let ended = ended.clone();
        std::thread::spawn(move || {
            let outcome = client.ask(&Question::Search).and_then(Iterator::collect::<Result<Vec<_>, _>>);
            let _ = ended.send((length, outcome));
        });
        BufReader::new(&stream).read_line(&mut String::new()).unwrap();
        stream.write_all(&answer[..length]).unwrap();
        streams.push(stream);
    }
    for _ in &streams {
        let (length, outcome) = outcomes.recv_timeout(PATIENCE).expect("each question ends");
        assert!(matches!(outcome, Err(ControlError::Silent { .. })), "after {length} bytes: {outcome:?}");
    }
}

#[test]
fn a_slow_call_keeps_nobody_else_waiting() {
    let (depot, _agv) = Depot::with_agv();
    let mut slow = depot.client();
    std::thread::scope(|scope| {
        let waiting = scope.spawn(|| ask(&mut slow, Question::Call(call(Some("agv"), "slow", vec![]))).unwrap());
        let mut client = depot.client();
        for _ in 0..50 {
            assert!(ask(&mut client, Question::Unit).is_ok());
            assert!(matches!(
                ask(&mut client, crate::support::ping("agv", 1, 20_000)).unwrap()[..],
                [Answer::Sample { us: Some(_), .. }]
            ));
        }
        assert!(!waiting.is_finished());
        depot.gate.open();
        assert!(matches!(waiting.join().unwrap()[..], [Answer::Called { error: None, .. }]));
    });
}

#[test]
fn a_unit_that_is_dropped_stops_though_a_client_is_connected() {
    let (depot, agv) = Depot::with_agv();
    let mut watching = depot.client();
    let mut idle = depot.client();
    let path = depot.path();
    let mut watch = watching.ask(&Question::Watch).unwrap();
    assert!(matches!(watch.next(), Some(Ok(Answer::Event { event, .. })) if event == "watching"));
    // The directory must outlive the unit, which removes its socket there.
    let Depot { directory: _directory, system, .. } = depot;
    drop(system);
    assert!(!path.exists());
    assert!(watch.filter(Result::is_err).count() <= 1, "it ends, whether it is told or not");
    until("the vehicle has noticed", || !agv.is_connected());
    let broken = match idle.ask(&Question::Unit) {
        Ok(mut answers) => answers.any(|answer| matches!(answer, Err(ControlError::Broken(_)))),
        Err(error) => matches!(error, ControlError::Broken(_)),
    };
    assert!(broken);
}

#[test]
fn what_was_left_unread_does_not_answer_the_next_question() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    assert!(matches!(
        client.ask(&Question::Functions { node: "agv".into() }).unwrap().next(),
        Some(Ok(Answer::Function(_)))
    ));
    assert!(matches!(ask(&mut client, Question::Unit).unwrap()[..], [Answer::Unit(_)]));
    let _ = client.ask(&Question::Functions { node: "x".into() }).unwrap();
    assert!(matches!(ask(&mut client, Question::Unit).unwrap()[..], [Answer::Unit(_)]));
}

#[test]
fn a_client_finds_the_unit_that_runs_or_says_which_there_are() {
    let depot = Depot::new();
    let directory = depot.directory.path();
    assert_eq!(Client::find_in(directory, None).unwrap().unit().unit, "manager/1");
    let beside = |name: &str, id, file: &str| {
        let system = manager(name, id, depot.fleet).control(Control::Path(directory.join(file))).build().unwrap();
        system.start().unwrap();
        system
    };
    let (_second, _third) = (beside("manager", 2, "b.sock"), beside("other", 3, "c.sock"));
    // A socket on which no process listens is not listed.
    drop(UnixListener::bind(directory.join("stale.sock")).unwrap());
    let units: Vec<_> = running_in(directory).unwrap().into_iter().map(|unit| unit.unit).collect();
    assert_eq!(units, ["manager/2", "other/3", "manager/1"]);
    match Client::find_in(directory, None) {
        Err(error @ ControlError::Several(_)) => assert!(error.to_string().contains("other/3"), "{error}"),
        other => panic!("{:?}", other.err()),
    }
    assert!(
        matches!(Client::find_in(directory, Some("manager")), Err(ControlError::Several(units)) if units.len() == 2)
    );
    assert_eq!(Client::find_in(directory, Some("manager/2")).unwrap().unit().unit, "manager/2");
    assert_eq!(Client::find_in(directory, Some("other")).unwrap().unit().unit, "other/3");
    match Client::find_in(directory, Some("nobody")) {
        Err(ControlError::NotRunning { wanted, running }) => {
            assert_eq!((wanted.as_str(), running.len()), ("nobody", 3))
        }
        other => panic!("{:?}", other.err()),
    }
    let empty = crate::support::directory();
    assert!(matches!(Client::find_in(empty.path(), None), Err(ControlError::NoneRunning(_))));
    assert!(matches!(Client::find_in(&empty.path().join("none"), None), Err(ControlError::NoneRunning(_))));
    assert!(matches!(Client::connect(&empty.path().join("none.sock")), Err(ControlError::NoneRunning(_))));
}

/// Something that answers with `line` on a socket.
fn impostor(line: &'static [u8]) -> (tempfile::TempDir, Result<Client, ControlError>) {
    let directory = crate::support::directory();
    let path = directory.path().join("x.sock");
    let listener = UnixListener::bind(&path).unwrap();
    let answering = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let _ = stream.write_all(line);
        // Until the client is gone.
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let _ = stream.read(&mut [0; 1]);
    });
    let client = Client::connect(&path);
    let client = client.map(|client| {
        drop(client);
        unreachable!("it is no unit")
    });
    answering.join().unwrap();
    (directory, client)
}

#[test]
fn a_client_says_what_is_wrong_with_the_other_end() {
    let newer = impostor(b"{\"answer\":\"hello\",\"control_version\":3,\"unit\":\"x/1\",\"fleet\":0}\n").1;
    assert!(matches!(newer, Err(ControlError::Version { theirs: 3 })));
    for line in [&b"SSH-2.0\n"[..], b"{\"answer\":\"done\"}\n"] {
        assert!(matches!(impostor(line).1, Err(ControlError::Broken(_))), "{line:?}");
    }
    assert!(matches!(impostor(b"").1, Err(ControlError::Silent { .. })));
}
