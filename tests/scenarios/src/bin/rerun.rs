//! Runs a recorded core session ten times again, and makes a test of it.
//!
//! `rerun FILE [--keep NAME]`: `--keep` copies the file to `tests/scenarios/recorded/NAME.core`, which the test `recorded` runs
//! from then on.

use std::process::ExitCode;

use cara_scenarios::recorded;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let done = match words[..] {
        [file] => recorded::run(file.as_ref()),
        [file, "--keep", name] => recorded::keep(file.as_ref(), name),
        _ => Err("rerun FILE [--keep NAME]".into()),
    };
    match done {
        Ok(report) => {
            println!("{report}");
            ExitCode::SUCCESS
        }
        Err(why) => {
            eprintln!("{why}");
            ExitCode::FAILURE
        }
    }
}
