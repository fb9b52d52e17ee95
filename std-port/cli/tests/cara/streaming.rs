//! `cara stream`.

use cara_std::control::Client;
use cara_std::control::protocol::{Answer, ArgumentValue, Question};
use cara_std::{Definition, Duration, Parameters};

use crate::support::{PATIENCE, Running, Stage};

/// An AGV with `pose`, which has a value, and `battery`, which has none.
pub(crate) fn stage() -> (Stage, cara_std::Unit, cara_std::Stream) {
    let mut stage = Stage::empty();
    // Before the manager starts, which looks at its keys every few seconds.
    stage.know_all(&["agv-1/11", "late-1/12"]);
    stage.start_manager();
    let agv = stage.vehicle("agv-1", 11).build().unwrap();
    let list = agv.my_function_list();
    let pose = list.add_stream(&Definition::stream("pose(x: int)").unwrap(), Duration::ZERO).unwrap();
    list.add_stream(&Definition::stream("battery(percent: float)").unwrap(), Duration::ZERO).unwrap();
    put(&pose, 7);
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    let start = std::time::Instant::now();
    while !stage.cara(&["functions", "agv-1"]).everything().contains("pose") {
        assert!(start.elapsed() < PATIENCE);
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    (stage, agv, pose)
}

fn put(pose: &cara_std::Stream, x: i64) {
    let mut values = Parameters::new();
    values.add_int("x", 1).unwrap();
    values.set_value("x", x).unwrap();
    pose.publish(&values).unwrap();
}

#[test]
fn values_come_with_age_and_time() {
    let (stage, agv, pose) = stage();
    let mut people = Running::start(stage.command(&["stream", "agv-1", "pose"]));
    let mut programs = Running::start(stage.command(&["stream", "agv-1", "pose", "--json", "--count", "2"]));
    let line = people.expect("pose(x: 7)");
    assert!(line.ends_with(" old") && line.contains(':'), "{line}");
    let last: serde_json::Value = serde_json::from_str(&programs.expect("unix_ms")).unwrap();
    assert_eq!((&last["node"], &last["values"][0]["value"]), (&"agv-1/11".into(), &7.into()));
    assert!(last["age_us"].as_u64().unwrap() > 1_000, "{last}");
    put(&pose, 8);
    people.expect("pose(x: 8)");
    programs.expect("8");
    assert_eq!((programs.end(), people.interrupted()), (0, 130));
    agv.stop();
}

#[test]
fn without_a_name_each_stream_is_listed_once() {
    let (stage, agv, _) = stage();
    stage.ends(0, &["stream", "agv-1"]).says("pose(x: 7)").says("battery() -> (percent: float)  no value yet");
    let listed = stage.ends(0, &["stream", "agv-1", "--json"]);
    assert_eq!(listed.lines().len(), 2);
    assert!(stage.cara(&["functions", "agv-1"]).everything().contains("stream"));
    agv.stop();
}

#[test]
fn what_is_no_stream_is_said() {
    let (stage, agv, _) = stage();
    let reported = stage.cara(&["stream", "agv-1", "speed", "--json"]).error();
    assert_eq!(reported["name"], "UnknownFunction", "{reported}");
    stage.ends(2, &["stream", "agv-1", "pose", "--rate", "0"]);
    stage.ends(2, &["stream", "agv-1", "--rate", "1"]);
    agv.stop();
}

#[test]
fn one_connection_gets_the_streams_of_all_nodes_also_of_later_ones() {
    let (stage, _agv, _pose) = stage();
    let mut client = Client::find_in(stage.control(), Some("manager/1")).unwrap();
    let closer = client.closer().unwrap();
    let mut answers = client.ask(&Question::Streams { interval_ms: 0, names: Vec::new() }).unwrap();
    // The manager's own log is among them.
    let mut next = || loop {
        match answers.next() {
            Some(Ok(Answer::Value { node, .. })) if node == "manager/1" => {}
            Some(Ok(Answer::Value { node, stream, values, .. })) => break Some((node, stream, values)),
            _ => break None,
        }
    };
    let first = next().unwrap();
    assert_eq!(
        (&*first.0, &*first.1, &first.2[0].value),
        ("agv-1/11", "pose() -> (x: int)", &ArgumentValue::Int(vec![7]))
    );
    stage.know("agv-2", 12);
    let later = stage.vehicle("agv-2", 12).build().unwrap();
    let place =
        later.my_function_list().add_stream(&Definition::stream("pose(x: int)").unwrap(), Duration::ZERO).unwrap();
    put(&place, 9);
    later.publish_my_function_list().unwrap();
    later.start().unwrap();
    let second = next().unwrap();
    assert_eq!((&*second.0, &second.2[0].value), ("agv-2/12", &ArgumentValue::Int(vec![9])));
    closer.close();
    assert_eq!(next(), None, "the connection was closed from elsewhere");
}

#[test]
fn streams_and_functions_are_told_apart() {
    let (stage, agv, _pose) = stage();
    let halt = |_: &cara_std::Served, _: &mut cara_std::ParametersView| Ok(());
    let options = cara_std::ServiceOptions::new();
    agv.my_function_list().add_service(&"halt()".parse().unwrap(), options, halt).unwrap();
    agv.publish_my_function_list().unwrap();
    crate::support::until("halt is published", || stage.cara(&["functions", "agv-1"]).everything().contains("halt"));
    let typo = stage.ends(2, &["stream", "agv-1", "pos"]);
    typo.says("did you mean `pose`?").says("battery() -> (percent: float)");
    assert!(!typo.err.contains("halt"), "{}", typo.err);
    stage.ends(2, &["stream", "agv-1", "halt"]).says("`cara call agv-1/11 halt`");
    for all in [&["call", "agv-1", "pose"][..], &["call", "--all", "pose"]] {
        stage.ends(2, all).says("is a stream").says("`cara stream agv-1/11 pose`");
    }
    agv.stop();
}
