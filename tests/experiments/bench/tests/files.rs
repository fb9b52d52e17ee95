//! Where a run writes to: what cannot be written is told before anything is measured, and what cannot be written any
//! more when the run ends does not take its tables away.

use std::io::{BufRead, BufReader, Read};
use std::process::{Command, Stdio};

const TINY: [&str; 7] = ["experiments", "--tiny", "--peers", "none", "--only", "constraints", "--json"];

fn bench() -> Command {
    Command::new(env!("CARGO_BIN_EXE_cara-bench"))
}

#[test]
fn a_place_that_cannot_be_written_is_told_before_anything_is_measured() {
    let folder = tempfile::tempdir().unwrap();
    let (rows, drawings) = (folder.path().join("rows.json"), folder.path().join("plots"));
    let (rows, drawings) = (rows.to_str().unwrap(), drawings.to_str().unwrap());
    let places =
        [("/proc/rows.json", drawings, "/proc/rows.json"), (".", drawings, "."), (rows, "/proc/plots", "/proc/plots")];
    for (json, plots, named) in places {
        let output = bench().args(TINY).args([json, "--plots", plots]).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && !said.contains("of the CPUs in use"), "{json} {plots}: {said}");
        assert!(said.contains(named), "{said}");
    }
}

#[test]
fn tables_are_shown_though_the_file_cannot_be_written_any_more() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("rows.json");
    let mut run = bench().args(TINY).arg(&json).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = BufReader::new(run.stderr.take().unwrap());
    let mut line = String::new();
    // The note on debug builds stands before the file is looked at.
    while line.is_empty() || line.starts_with("note") {
        line.clear();
        assert_ne!(said.read_line(&mut line).unwrap(), 0);
    }
    folder.close().unwrap();
    let (mut rest, mut shown) = (String::new(), String::new());
    said.read_to_string(&mut rest).unwrap();
    run.stdout.take().unwrap().read_to_string(&mut shown).unwrap();
    assert!(!run.wait().unwrap().success());
    assert!(rest.contains(json.with_extension("part").to_str().unwrap()), "{rest}");
    assert!(shown.contains("executed"), "{shown}");
}
