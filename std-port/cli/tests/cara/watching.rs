//! `cara watch`.

use crate::support::{Running, Stage};

#[test]
fn events_are_shown_as_they_come() {
    let mut stage = Stage::with(&["agv-1"]);
    let mut people = Running::start(stage.command(&["watch"]));
    let mut programs = Running::start(stage.command(&["watch", "--json"]));
    // What happens before the two have begun to watch is not theirs to see.
    people.expect("watching");
    programs.expect("watching");
    stage.start_agv("late-1", 12);
    let (line, object) = (people.expect("joined"), programs.expect("\"joined\""));
    assert!(line.contains("late-") && line.contains("Z  joined") && line.starts_with("20"), "{line}");
    let object: serde_json::Value = serde_json::from_str(&object).unwrap();
    assert!(
        object["node"].as_str().unwrap().starts_with("late-") && object["at_ms"].is_u64() && object["unix_ms"].is_u64(),
        "{object}"
    );
}

#[test]
fn a_failed_asynchronous_call_is_an_event() {
    let stage = Stage::with(&["agv-1"]);
    let mut watch = Running::start(stage.command(&["watch", "--count", "1", "--json"]));
    watch.expect("watching");
    stage.ends(0, &["call", "agv-1", "fail", "--async"]);
    let line = watch.expect("request_failed");
    assert!(line.contains("agv-1/11"), "{line}");
    assert_eq!(watch.end(), 0);
}

/// A program that starts them learns that they did not end by themselves.
#[test]
fn what_looks_until_ctrl_c_ends_with_its_exit_code() {
    let stage = Stage::with(&[]);
    for arguments in [&["watch"][..], &["scan", "--survey", "--listen", "1min"], &["doctor", "--listen", "1min"]] {
        assert_eq!(Running::start(stage.command(arguments)).interrupted(), 130, "{arguments:?}");
    }
}

#[test]
fn a_watch_ends_when_it_is_told_to() {
    let stage = Stage::with(&[]);
    stage.ends(0, &["watch", "--for", "50ms"]);
    stage.ends(2, &["watch", "--count", "0"]);
}
