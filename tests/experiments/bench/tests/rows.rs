//! A tiny run of the experiments yields every kind of row, with the keys of `keys.txt` and no others: what reads the rows of an
//! earlier run counts on them. `src/results.rs` says what each means. Nothing here looks at a figure.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use serde_json::{Map, Value};

/// Kinds of rows, each with its keys.
fn documented() -> BTreeMap<String, BTreeSet<String>> {
    let lines = include_str!("keys.txt").lines().map(|line| line.split_once(": ").unwrap());
    lines.map(|(kind, keys)| (kind.to_owned(), keys.split(' ').map(str::to_owned).collect())).collect()
}

fn run() -> (Map<String, Value>, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let (json, plots) = (folder.path().join("rows.json"), folder.path().join("plots"));
    let mut bench = Command::new(env!("CARGO_BIN_EXE_cara-bench"));
    let bench =
        bench.args(["experiments", "--tiny", "--peers", "none", "--json"]).arg(&json).arg("--plots").arg(&plots);
    let output = bench.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let rows: Value = serde_json::from_str(&std::fs::read_to_string(&json).unwrap()).unwrap();
    let drawn = std::fs::read_dir(&plots).unwrap().map(|entry| entry.unwrap());
    let whole = drawn.filter(|entry| entry.metadata().unwrap().len() > 1_000);
    (rows.as_object().unwrap().clone(), whole.map(|entry| entry.file_name().into_string().unwrap()).collect())
}

/// The rows of a kind: a list, or one object.
fn rows<'v>(all: &'v Map<String, Value>, kind: &str) -> Vec<&'v Map<String, Value>> {
    match &all[kind] {
        Value::Array(rows) => rows.iter().map(|row| row.as_object().unwrap()).collect(),
        Value::Object(row) => vec![row],
        other => panic!("{kind} is {other}"),
    }
}

/// The values of a key in all rows of a kind.
fn values(all: &Map<String, Value>, kind: &str, key: &str) -> BTreeSet<String> {
    rows(all, kind).iter().map(|row| row[key].to_string().trim_matches('"').to_owned()).collect()
}

#[test]
fn every_kind_of_row_has_the_documented_keys() {
    let (all, drawn) = run();
    let kinds = documented();
    assert_eq!(all.keys().collect::<BTreeSet<_>>(), kinds.keys().collect::<BTreeSet<_>>());
    for (kind, keys) in &kinds {
        let rows = rows(&all, kind);
        assert!(!rows.is_empty(), "no row of {kind}");
        for row in rows.into_iter().filter(|row| !is_skipped(row)) {
            assert_eq!(&row.keys().cloned().collect::<BTreeSet<_>>(), keys, "{kind}");
        }
    }
    covers(&all);
    let is_laid = !rows(&all, "link_response").into_iter().any(is_skipped);
    if is_laid {
        covers_links(&all);
    }
    let on_links = ["link-6", "link-7", "link-8", "link-constraints"];
    let figures = ["figure-6", "figure-7", "figure-8"].into_iter().chain(on_links.into_iter().filter(|_| is_laid));
    for figure in figures {
        assert!(drawn.contains(&format!("{figure}.svg")), "{drawn:?}");
    }
}

/// A row that only says why there is none, where this machine or user cannot have a link of its own.
fn is_skipped(row: &Map<String, Value>) -> bool {
    let is_skipped = row.get("skipped").is_some_and(Value::is_string);
    if is_skipped {
        assert_eq!(row.keys().map(String::as_str).collect::<BTreeSet<_>>(), BTreeSet::from(["mbit", "skipped"]));
        cara_processes::skip(format_args!("{row:?}"));
    }
    is_skipped
}

/// The same keys in both modes; instructions where they can be counted.
fn share(plain: &Value, notes: &[Value]) {
    let keys = |share: &Value| share.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(plain), keys(&plain["secured"]));
    assert_eq!((&plain["mode"], &plain["secured"]["mode"]), (&"plain".into(), &"secured".into()));
    let is_counted = Command::new("valgrind").arg("--version").output().is_ok_and(|output| output.status.success());
    for share in [plain, &plain["secured"]] {
        let counted = ["instructions_per_call", "generate_instructions", "process_instructions"].map(|key| &share[key]);
        // A machine with much other load may need longer for a call under callgrind than a call may take.
        if is_counted && !notes.iter().any(|note| note.as_str().unwrap().contains("under callgrind")) {
            assert!(counted.iter().all(|value| value.as_f64().unwrap() > 0.0), "{share:?}");
        } else {
            println!("instructions are not looked at: {notes:?}");
        }
    }
}

fn covers_links(all: &Map<String, Value>) {
    let set = |values: &[&str]| values.iter().map(|value| (*value).to_owned()).collect::<BTreeSet<_>>();
    assert_eq!(values(all, "link_response", "peer"), set(&["floor", "floor_again", "cara", "simulated"]));
    assert_eq!(values(all, "link_availability", "peer"), set(&["floor", "cara", "simulated"]));
    for kind in ["link_response", "link_availability"] {
        assert_eq!(values(all, kind, "distribution"), set(&["1", "2"]), "{kind}");
        for row in rows(all, kind) {
            assert_eq!(row["print"] == true, row["peer"] != "simulated", "{kind}");
        }
    }
    for kind in ["link_availability", "link_constraints"] {
        assert_eq!(values(all, kind, "delivery"), set(&["reliable", "best_effort"]), "{kind}");
        assert_eq!(values(all, kind, "mode"), set(&["plain", "secured"]), "{kind}");
        for row in rows(all, kind) {
            let count = |key: &str| row[key].as_u64().unwrap();
            assert_eq!(count("offered"), count("executed") + count("refused") + count("lost"), "{row:?}");
        }
    }
}

/// What a kind must show has its rows.
fn covers(all: &Map<String, Value>) {
    let set = |values: &[&str]| values.iter().map(|value| (*value).to_owned()).collect::<BTreeSet<_>>();
    assert_eq!(values(all, "run", "is_complete"), set(&["true"]));
    assert_eq!(values(all, "response", "peer"), set(&["floor", "floor_again", "cara"]));
    assert_eq!(values(all, "response", "distribution"), set(&["1", "2"]));
    assert_eq!(values(all, "response", "print"), set(&["true", "false"]));
    assert_eq!(values(all, "availability", "delivery"), set(&["reliable", "best_effort"]));
    assert_eq!(values(all, "availability", "distribution"), set(&["1", "2"]));
    assert_eq!(values(all, "throughput", "kind"), set(&["request", "one_way"]));
    assert_eq!(values(all, "echoes", "print"), set(&["true"]));
    assert_eq!(values(all, "echoes", "distribution"), set(&["1", "2"]));
    assert_eq!(values(all, "availability", "print"), set(&["true", "false"]));
    for kind in ["response", "echoes", "throughput", "availability", "scale", "constraints"] {
        assert_eq!(values(all, kind, "mode"), set(&["plain", "secured"]), "{kind}");
    }
    share(&all["share"], all["run"]["notes"].as_array().unwrap());
    let experiments = all["run"]["experiments"].as_array().unwrap();
    assert_eq!(experiments.len(), 9);
    assert!(experiments.iter().all(|done| done["is_complete"] == true), "{experiments:?}");
    for goal in rows(all, "goals") {
        assert_eq!(goal["figure"].is_number(), goal["is_reached"].is_boolean(), "{goal:?}");
    }
    assert!(rows(all, "goals").iter().any(|goal| goal["is_reached"].is_boolean()));
    for row in rows(all, "response") {
        let is_secured = row["mode"] == "secured";
        assert_eq!(
            (is_secured, is_secured),
            (row["plain_ratio"].is_f64(), is_secured && row["peer"] == "cara"),
            "{row:?}"
        );
    }
    for row in rows(all, "availability") {
        let count = |key: &str| row[key].as_u64().unwrap();
        assert_eq!(count("offered"), count("sent") + count("refused"), "{row:?}");
        assert_eq!(count("sent"), count("executed") + count("lost"), "{row:?}");
    }
    // A text that no datagram holds is refused, and said to be.
    let long =
        rows(all, "availability").into_iter().filter(|row| row["delivery"] == "best_effort" && row["chars"] == 5_000);
    assert!(long.clone().count() > 0);
    for row in long {
        assert_eq!(row["refused"], row["offered"], "{row:?}");
    }
}
