//! Access tables: checked alone, and in force on a node.

use std::fs;

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{Stage, until};

const TABLE: &str = "\
[[allow]]
who = [\"agv/7\", \"operator\"]
functions = [\"stop\"]
verbs = \"call\"
rate = \"5/min\"

[[allow]]
who = \"m_units\"
functions = \"*\"
verbs = [\"list\", \"publish\"]
";

fn folder(table: &str) -> (TempDir, String) {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("access.toml");
    fs::write(&path, table).unwrap();
    (folder, path.display().to_string())
}

#[test]
fn a_table_is_shown_as_it_is_understood() {
    let (_folder, path) = folder(TABLE);
    let stage = Stage::empty();
    let shown = stage.ends(0, &["access", "check", &path]);
    shown.says(":1: agv/7 may call stop, 5/min").says(":1: operator may call stop, 5/min");
    shown.says(":7: every m_unit may list and publish every function").says("rules: 3");
    let json: Value = serde_json::from_str(&stage.ends(0, &["access", "check", &path, "--json"]).out).unwrap();
    assert_eq!((&json["correct"], &json["rules"][2]["line"]), (&Value::Bool(true), &7.into()));
}

#[test]
fn a_question_is_answered_with_the_rule_that_decides() {
    let (_folder, path) = folder(TABLE);
    let stage = Stage::empty();
    for (exit, who, verb, function, says) in [
        (0, "agv/7", "--call", "stop", ":1: agv/7 may call stop, 5/min"),
        (0, "agv/7@s_unit", "--list", "stop", "allowed: agv/7@s_unit may see stop"),
        (1, "agv/7@s_unit", "--call", "go_to", "not allowed"),
        (0, "operator", "--call", "stop", ":1: operator may"),
        (1, "operator", "--publish", "stop", "not allowed"),
        (0, "depot/1@m_unit", "--publish", "go_to", ":7: every m_unit"),
        (1, "depot/1@s_unit", "--publish", "go_to", "not allowed"),
    ] {
        stage.ends(exit, &["access", "check", &path, "--who", who, verb, function]).says(says);
    }
    stage.ends(2, &["access", "check", &path, "--who", "depot/1", "--list", "go_to"]).says("depot/1@m_unit");
    stage.ends(2, &["access", "check", &path, "--who", "agv", "--list", "go_to"]).says("NAME/ID");
    stage.ends(2, &["access", "check", &path, "--who", "agv/7"]);
}

#[test]
fn mistakes_are_told_with_line_and_column() {
    let (_folder, path) = folder("[[allow]]\nwho = \"agv\"\nfunctions = [\"go to\"]\nverbs = \"call\"\n");
    let stage = Stage::empty();
    let reported = stage.ends(2, &["access", "check", &path]);
    reported.says("access.toml:2:7: 'agv' names no node").says("access.toml:3:13: 'go to' is no function's name");
    stage.ends(2, &["access", "check", "/no/such.toml"]).says("cannot be read");
    // A node does not start with it, whichever way it is named.
    stage.ends(2, &["node", "--name", "a", "--id", "1", "--access", &path]).says("access.toml:2:7");
    let (_other, config) = folder(&format!("name = \"a\"\nid = 1\naccess = \"{path}\"\n"));
    stage.ends(2, &["node", "--check", &config]).says(":3:10: the access table is wrong").says(":2:7: 'agv'");
}

#[test]
fn the_example_of_the_documentation_is_a_table() {
    let page = fs::read_to_string("../../docs/access.md").unwrap();
    let (_, after) = page.split_once("```toml access\n").unwrap();
    let (_folder, path) = folder(after.split_once("```").unwrap().0);
    let stage = Stage::empty();
    stage.ends(0, &["access", "check", &path]).says("rules: 8");
    stage.ends(1, &["access", "check", &path, "--who", "operator", "--call", "go_to"]);
    stage.ends(0, &["access", "check", &path, "--who", "operator", "--list", "go_to"]);
    stage.ends(0, &["access", "check", &path, "--who", "monitor/9@m_unit", "--list", "stop_all"]);
}

/// In one step: a file that is empty for long, on a busy machine, is a table without rules.
fn write(path: &str, text: &str) {
    let new = format!("{path}.new");
    fs::write(&new, text).unwrap();
    fs::rename(new, path).unwrap();
}

#[test]
fn the_operator_of_a_node_is_refused_and_a_new_table_is_taken_over() {
    const VEHICLES: &str = "[[allow]]\nwho = \"s_units\"\nfunctions = \"*\"\nverbs = \"publish\"\n\
                            [[allow]]\nwho = \"operator\"\nfunctions = [\"echo\", \"fail\"]\nverbs = \"list\"\n";
    const OPERATOR: &str = "[[allow]]\nwho = \"operator\"\nfunctions = [\"echo\"]\nverbs = \"call\"\n";
    let (_folder, path) = folder(VEHICLES);
    let mut stage = Stage::empty();
    stage.start_manager_with(&["--access", &path]);
    stage.start_agv("agv", 7);
    until("the AGV is there", || stage.ready() == 1);
    let call = ["call", "agv", "echo(text: \"hello\")"];
    stage.ends(1, &call).says("the unit's access table does not let the operator call 'echo'");
    assert_eq!(stage.ends(1, &[&call[..], &["--json"]].concat()).error()["name"], "NotAllowed");
    let functions = stage.ends(0, &["functions", "agv"]).out;
    assert!(functions.contains("echo") && !functions.contains("mix"), "{functions}");
    write(&path, &format!("{VEHICLES}{OPERATOR}"));
    until("the operator may call", || stage.cara(&call).code == 0);
    stage.ends(1, &["call", "agv", "fail"]).says("'fail'");
    write(&path, "[[allow]]\n");
    until("the mistake is counted", || stage.ends(0, &["counters", "--json"]).out.contains("\"AccessFileWrong\":1"));
    stage.ends(0, &call).says("hello");
}
