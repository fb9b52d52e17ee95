//! `cara scan`, `cara publish` and `cara counters`.

use std::io::Read;
use std::process::Stdio;

use cara_std::{Interfaces, Unit};

use crate::support::{Ran, Stage};

#[test]
fn a_scan_shows_who_is_there() {
    let stage = Stage::with(&["agv-1", "agv-2"]);
    let shown = stage.ends(0, &["scan"]);
    shown.says("agv-1").says("11").says("s_unit").says("connected").says("127.0.0.1").says("message");
    let told = stage.ends(0, &["scan", "--json"]).json();
    assert_eq!(told["unit"]["name"], "manager");
    let names: Vec<_> = told["nodes"].as_array().unwrap().iter().map(|node| node["name"].as_str().unwrap()).collect();
    assert!(names.len() == 2 && names.contains(&"agv-1") && names.contains(&"agv-2"), "{names:?}");
    assert_eq!(stage.ends(0, &["scan", "--offering", "go_to", "--json"]).json()["nodes"].as_array().unwrap().len(), 2);
    stage.ends(0, &["scan", "--offering", "fly"]).says("no such node");
    stage.ends(0, &["scan", "--search", "--listen", "10ms"]).says("agv-2");
}

#[test]
fn a_scan_shows_who_was_refused_and_why() {
    let stage = Stage::with(&["agv-1"]);
    // The same name and ID as the one that is there.
    let twin = Unit::builder("agv-1", 11, "manager", 1).unwrap().fleet(stage.fleet).interfaces(Interfaces::Loopback);
    let twin = twin.build_unit().unwrap();
    twin.start().unwrap();
    let start = std::time::Instant::now();
    loop {
        let told = stage.ends(0, &["scan", "--json"]).json();
        if told["refused"][0]["reason"] == "DuplicateIdentity" {
            break;
        }
        assert!(start.elapsed() < crate::support::PATIENCE, "{told}");
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    stage.ends(0, &["scan"]).says("DuplicateIdentity").says("give each node its own");
    twin.stop();
}

#[test]
fn without_a_manager_a_scan_surveys_the_network() {
    let stage = Stage::empty();
    let agv = Unit::builder("lost-agv", 5, "nobody", 9).unwrap().fleet(stage.fleet).interfaces(Interfaces::Loopback);
    let agv = agv.build_unit().unwrap();
    agv.start().unwrap();
    let told = stage.ends(0, &["scan", "--listen", "10s", "--json"]).json();
    agv.stop();
    let heard = told["heard"].as_array().unwrap();
    let found = heard.iter().find(|heard| heard["name"] == "lost-agv").unwrap_or_else(|| panic!("{told}"));
    assert_eq!((&found["id"], &found["role"]), (&5.into(), &"s_unit".into()));
    assert!(found["looks_for"].as_str().unwrap().contains("nobody"), "{found}");
    assert!(told["unit"].is_null());
    stage.ends(0, &["scan", "--listen", "10ms"]).says("A survey hears");
    stage.ends(3, &["scan", "--offering", "go_to"]).says("--as NAME/ID");
}

#[test]
fn a_survey_can_be_had_beside_a_manager() {
    let stage = Stage::with(&[]);
    let told = stage.ends(0, &["scan", "--survey", "--listen", "5s", "--json"]).json();
    assert!(told["heard"].as_array().unwrap().iter().any(|heard| heard["name"] == "manager"), "{told}");
}

#[test]
fn what_is_published_is_read() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(0, &["publish", "agv-1", "--timeout", "20s"]).says("published to agv-1/11");
    stage.ends(0, &["publish", "--timeout", "20s"]).says("published to all nodes");
    let told = stage.ends(0, &["publish", "--json", "--timeout", "20s"]).json();
    assert_eq!(told["unread"], serde_json::json!([]));
    stage.ends(1, &["publish", "agv-2"]).says("agv-1/11");
}

#[test]
fn counters_are_shown() {
    let stage = Stage::with(&["agv-1"]);
    let told = stage.ends(0, &["counters", "--json"]).json();
    assert!(told["unit"].as_object().is_some_and(|unit| !unit.is_empty()), "{told}");
    assert!(told["nodes"]["agv-1/11"].as_object().is_some_and(|link| !link.is_empty()), "{told}");
    stage.ends(0, &["counters"]).says("unit").says("link to agv-1/11");
    let (few, all) = (stage.ends(0, &["counters", "agv-1"]), stage.ends(0, &["counters", "agv-1", "--zeros"]));
    assert!(few.out.lines().count() < all.out.lines().count(), "{}", all.out);
    assert!(!few.out.contains("unit\n"), "{}", few.out);
    let metrics = stage.ends(0, &["counters", "--prometheus"]);
    metrics.says("# TYPE ").says("# HELP ");
    stage.ends(2, &["counters", "--prometheus", "--zeros"]);
}

#[test]
fn a_reader_that_goes_is_no_error() {
    let stage = Stage::with(&["agv-1"]);
    for verb in [["scan", "--json"], ["functions", "agv-1"], ["counters", "--zeros"], ["completions", "zsh"]] {
        let mut child = stage.command(&verb).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let mut err = String::new();
        child.stderr.take().unwrap().read_to_string(&mut err).unwrap();
        let ran = Ran { code: child.wait().unwrap().code().unwrap_or(-1), out: String::new(), err };
        assert!(ran.code == 0 && ran.err.is_empty(), "{verb:?}: {}", ran.everything());
    }
}

#[test]
fn a_pipe_gets_no_colours_and_nobody_with_no_color() {
    let stage = Stage::with(&["agv-1"]);
    for verb in [&["scan"][..], &["counters"], &["functions", "agv-9"], &["call", "agv-1", "fail"]] {
        let ran = stage.cara(verb);
        assert!(!ran.out.contains('\x1b') && !ran.err.contains('\x1b'), "{}", ran.everything());
        let forced = |no_colour: &str| {
            let mut command = stage.command(verb);
            Ran::of(command.env("CLICOLOR_FORCE", "1").env("NO_COLOR", no_colour).output().unwrap())
        };
        let (coloured, plain) = (forced(""), forced("1"));
        assert!(coloured.out.contains('\x1b') || coloured.err.contains('\x1b'), "{}", coloured.everything());
        assert!(!plain.out.contains('\x1b') && !plain.err.contains('\x1b'), "{}", plain.everything());
    }
}
