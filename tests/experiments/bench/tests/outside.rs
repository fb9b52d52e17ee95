//! Other systems in the run: those that are there are measured, those that are not are told, and one that breaks does
//! not hold up the others. Nothing here needs any of them: a second copy of the floor stands in for one that works.

use std::fmt::Write;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// A table of other systems; each started by `sh -c`.
fn table(scripts: &[(&str, &str)]) -> String {
    let mut table = String::new();
    for (name, script) in scripts {
        let (common, start) = ("version = \"echo 1.2.3\"\none_way = true", format!("['sh', '-c', '{script}', 'sh']"));
        writeln!(table, "[[peer]]\nname = \"{name}\"\nsystem = \"{name}\"\n{common}\nstart = {start}").unwrap();
        writeln!(table, "files = [{}]", if *name == "absent" { "'no-such-file'" } else { "" }).unwrap();
    }
    table
}

/// A tiny run of the experiments `only` beside these systems.
fn run(scripts: &[(&str, &str)], only: &str) -> (bool, Value) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("peers.toml");
    std::fs::write(&file, table(scripts)).unwrap();
    bench(&["--patience-s", "3", "--only", only, "--peers-file", file.to_str().unwrap()])
}

fn bench(options: &[&str]) -> (bool, Value) {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("rows.json");
    let mut bench = Command::new(env!("CARGO_BIN_EXE_cara-bench"));
    let output = bench.args(["experiments", "--tiny", "--json"]).arg(&json).args(options).output().unwrap();
    let rows = std::fs::read_to_string(&json).unwrap();
    (output.status.success(), serde_json::from_str(&rows).unwrap())
}

fn report<'v>(all: &'v Value, peer: &str) -> &'v Value {
    let reports = all["run"]["peers"].as_array().unwrap();
    reports.iter().find(|report| report["peer"] == peer).unwrap_or_else(|| panic!("no {peer} in {reports:?}"))
}

fn has_rows(all: &Value, kind: &str, peer: &str) -> bool {
    all[kind].as_array().unwrap().iter().any(|row| row["peer"] == peer)
}

/// Plays the floor under another name.
fn floor(before: &str) -> String {
    let bench = env!("CARGO_BIN_EXE_cara-bench");
    let peer = "shift 3; exec";
    assert!(Path::new(bench).is_absolute());
    // The words behind are `serve --peer NAME …`; the name gives way to the floor's.
    format!("role=$1; {before} {peer} \"{bench}\" \"$role\" --peer floor \"$@\"")
}

#[test]
fn another_system_is_measured_beside_the_floor() {
    let works = floor("");
    let (is_fine, all) = run(&[("works", &works), ("absent", "true")], "response,throughput");
    assert!(is_fine);
    assert_eq!(
        (&report(&all, "works")["state"], &report(&all, "works")["version"]),
        (&"measured".into(), &"1.2.3".into())
    );
    assert!(has_rows(&all, "response", "works") && has_rows(&all, "throughput", "works"));
    assert_eq!(report(&all, "absent")["state"], "absent");
    assert!(report(&all, "absent")["notes"][0].as_str().unwrap().contains("cargo xtask peers"));
    assert!(!has_rows(&all, "response", "absent"));
}

#[test]
fn one_that_breaks_is_told_and_the_others_go_on() {
    let ends_later = floor("test $role = serve || { sleep 0.3; echo no more >&2; exit 1; };");
    let silent = floor("test $role = serve || exec sleep 1000;");
    let works = floor("");
    let scripts = [
        ("ends", "echo out of order >&2; exit 3"),
        ("ends_later", &ends_later),
        ("silent_server", "exec sleep 1000"),
        ("silent_client", &silent),
        ("babbles", "echo something else; exec sleep 1000"),
        ("works", &works),
    ];
    let (is_fine, all) = run(&scripts, "response");
    assert!(is_fine, "a run does not fail for another system");
    let reported = [
        ("ends", "out of order"),
        ("ends_later", "no more"),
        ("silent_server", "no answer for 3 s"),
        ("silent_client", "no answer for 3 s"),
        ("babbles", "something else"),
    ];
    for (peer, reason) in reported {
        assert_eq!(report(&all, peer)["state"], "broken", "{peer}");
        let notes = report(&all, peer)["notes"].as_array().unwrap();
        assert!(notes.iter().any(|note| note.as_str().unwrap().contains(reason)), "{peer}: {notes:?}");
        assert!(!has_rows(&all, "response", peer), "{peer}");
    }
    assert!(has_rows(&all, "response", "works") && has_rows(&all, "response", "cara"));
}

#[test]
fn whatever_is_built_here_is_measured_and_the_rest_is_told() {
    let (is_fine, all) = bench(&["--only", "response"]);
    assert!(is_fine);
    let reports = all["run"]["peers"].as_array().unwrap();
    assert!(reports.len() >= 8, "{reports:?}");
    for report in reports {
        let peer = report["peer"].as_str().unwrap();
        println!("{report}");
        match report["state"].as_str().unwrap() {
            "measured" => assert!(has_rows(&all, "response", peer), "{report}"),
            "absent" => assert!(!has_rows(&all, "response", peer), "{report}"),
            _ => assert!(report["notes"][0].is_string(), "{report}: why?"),
        }
    }
}
