//! `cara logs`, of nodes on Linux; tests/firmware has those of boards.

use std::io::Write as _;

use cara_std::Log;

use crate::support::{Running, Stage};

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
    let line = shown.expect("joined");
    assert!(line.contains("\"node\":\"agv-1/11\"") && line.contains("INFO"), "{line}");
    node.kill().unwrap();
    node.wait().unwrap();
}
