//! `cara logs`, of nodes on Linux; tests/firmware has those of boards.

use std::io::Write as _;

use cara_std::Log;
use serde_json::Value;

use crate::support::{Running, Stage, until};

fn stage() -> Stage {
    let mut stage = Stage::empty();
    stage.know("agv-1", 11);
    stage.start_manager();
    stage
}

#[test]
fn every_line_of_a_unit_comes_and_what_came_before_first() {
    let stage = stage();
    let mut log = Log::default();
    log.write_all(b"begins\n").unwrap();
    let agv = stage.vehicle("agv-1", 11).build().unwrap();
    agv.my_function_list().add_log(&log).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    let mut shown = Running::start(stage.command(&["logs"]));
    shown.expect("begins");
    for number in 0..100 {
        writeln!(log, "line {number} of the unit").unwrap();
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    for number in 0..100 {
        let line = shown.expect("");
        assert!(line.contains("agv-1/11") && line.ends_with(&format!("line {number} of the unit")), "{line}");
    }
    agv.stop();
}

#[test]
fn a_node_streams_its_log_where_its_file_says_so() {
    let stage = stage();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("agv.toml");
    let text = "name = \"agv-1\"\nid = 11\nrole = \"s_unit\"\nmanager = { name = \"manager\", id = 1 }\n[log]\nstream = true\n";
    std::fs::write(&file, text).unwrap();
    let mut node = stage.command(&["node", file.to_str().unwrap()]).spawn().unwrap();
    let mut shown = Running::start(stage.command(&["logs", "--json"]));
    // Beside the manager's.
    while !shown.expect("joined").contains("\"node\":\"agv-1/11\"") {}
    node.kill().unwrap();
    node.wait().unwrap();
}

#[test]
fn a_manager_shows_its_own_log_beside_those_of_vehicles_and_by_its_name() {
    let mut stage = Stage::with(&["agv-1"]);
    for named in [&["logs"][..], &["logs", "."], &["logs", "manager"], &["logs", "manager/1"]] {
        let mut shown = Running::start(stage.command(named));
        let line = shown.expect("joined");
        assert!(line.contains("manager/1") && line.contains("agv-1"), "{named:?}: {line}");
    }
    let mut shown = Running::start(stage.command(&["logs", "manager", "--json"]));
    stage.stop_agvs();
    let line: Value = serde_json::from_str(&shown.expect("left")).unwrap();
    assert!(line["node"] == "manager/1" && line["lost"].is_null(), "{line}");
}

#[test]
fn a_manager_s_file_may_keep_its_log_to_itself() {
    let mut stage = Stage::empty();
    let file = stage.control().join("manager.toml");
    std::fs::write(&file, "name = \"manager\"\nid = 1\n[log]\nstream = false\n").unwrap();
    stage.start_manager_with(&[file.to_str().unwrap()]);
    let refused = stage.ends(2, &["logs", "manager", "--json", "--for", "20s"]).error();
    assert_eq!(refused["name"], "NoLog", "{refused}");
}

/// All that was written is shown or counted, and neither who writes nor other operators wait for a reader that takes nothing.
#[test]
fn a_reader_that_is_late_loses_bytes_of_the_log_and_a_frozen_one_holds_up_nobody() {
    let stage = Stage::empty();
    let manager = stage.manager().build().unwrap();
    let mut log = Log::default();
    manager.show_log(&log);
    manager.start().unwrap();
    let start = |more: &[&str]| Running::start(stage.command(&[&["logs", "manager", "--json"], more].concat()));
    writeln!(log, "begins").unwrap();
    let (mut late, mut frozen) = (start(&[]), start(&[]));
    late.expect("begins");
    frozen.expect("begins");
    frozen.freeze();
    let (mut written, mut seen, mut lost) = (0, 0, 0);
    // More than is kept, faster than anybody looks, once this host is quick enough.
    while lost == 0 {
        for number in 0..10_000 {
            let line = format!("line {number} of the manager\n");
            written += line.len();
            log.write_all(line.as_bytes()).unwrap();
        }
        log.write_all(b"ends\n").unwrap();
        loop {
            let line: Value = serde_json::from_str(&late.expect("")).unwrap();
            lost += line["lost"].as_u64().unwrap_or(0) as usize;
            match line["text"].as_str() {
                Some("ends") => break,
                text => seen += text.map_or(0, |text| text.len() + 1),
            }
        }
    }
    assert!(seen > 0 && lost + seen == written, "{lost} lost and {seen} seen of {written}");
    // The frozen one's socket is full by now, or has been cut off.
    for round in 0..200 {
        writeln!(log, "{}", "x".repeat(4_000)).unwrap();
        if round % 50 == 0 {
            stage.ends(0, &["scan"]);
        }
    }
    writeln!(log, "still there").unwrap();
    late.expect("still there");
    frozen.thaw();
    until("the frozen one is told what it has lost, or was cut off", || {
        let line = frozen.line().map(|line| serde_json::from_str::<Value>(&line).unwrap());
        line.is_none_or(|line| line["lost"].as_u64() > Some(0))
    });
    manager.stop();
}
