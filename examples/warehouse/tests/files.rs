//! What a user is told of a mistake in a file, or of a floor that is too small.

use std::process::Command;

fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_warehouse")).arg("run").args(arguments).output().unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn mistakes_end_a_run_before_it_begins() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    std::fs::write(path("orders"), "3,5 11,5\n3,4 2,2\n").unwrap();
    let (code, reported) = run(&["--orders", &path("orders")]);
    assert_eq!(code, Some(1));
    let shown =
        "orders:2:5: no vehicle can stand on 2,2: name a cell that is `.` on the map\n  |\n2 | 3,4 2,2\n  |     ^";
    assert!(reported.contains(shown), "{reported}");
    std::fs::write(path("map"), "type octile\nheight 1\nwidth 3\nmap\n..x\n").unwrap();
    std::fs::write(path("stations"), "").unwrap();
    let (code, reported) = run(&["--map", &path("map"), "--stations", &path("stations")]);
    assert!(code == Some(1) && reported.contains("map:5:3: `x` is no cell"), "{reported}");
}

#[test]
fn a_floor_can_be_too_small() {
    let (code, reported) = run(&["--vehicles", "999"]);
    assert!(code == Some(1) && reported.contains("too small for 999 vehicles"), "{reported}");
}
