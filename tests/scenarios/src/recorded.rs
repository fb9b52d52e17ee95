//! Core sessions that were recorded from a manager on Linux (`Builder::record_core` of `cara-std`), run again.

use std::path::{Path, PathBuf};

use cara_std::rerun;

/// How often a recording is run: each time it must do the same.
const RUNS: usize = 10;

/// Where the recordings are that the test `recorded` runs.
pub fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("recorded")
}

/// Runs a recording again; what it did, or which input it did something else at.
pub fn run(file: &Path) -> Result<String, String> {
    let named = |why: &dyn std::fmt::Display| format!("{}: {why}", file.display());
    let text = std::fs::read_to_string(file).map_err(|error| named(&error))?;
    let mut first = None;
    for run in 1..=RUNS {
        let done = rerun(&text).map_err(|error| named(&format_args!("run {run}: {error}")))?;
        if *first.get_or_insert_with(|| done.clone()) != done {
            return Err(named(&format_args!("run {run} differs from the first one")));
        }
    }
    let first = first.ok_or_else(|| named(&"no runs"))?;
    let cut = first.cut.map_or_else(String::new, |why| format!("; it ends early: {why}"));
    Ok(named(&format_args!("{} inputs, hash {:016x}, {RUNS} of {RUNS} equal{cut}", first.inputs, first.hash)))
}

/// Makes a test of a recording that does the same again.
pub fn keep(file: &Path, name: &str) -> Result<String, String> {
    if name.is_empty() || !name.chars().all(|letter| letter.is_ascii_alphanumeric() || "-_".contains(letter)) {
        return Err(format!("`{name}` is no name for a test: use letters, digits, - and _"));
    }
    let report = run(file)?;
    let kept = folder().join(format!("{name}.core"));
    if kept.exists() {
        return Err(format!("{} is there: choose another name, or remove it", kept.display()));
    }
    let copied = std::fs::create_dir_all(folder()).and_then(|()| std::fs::copy(file, &kept));
    copied.map_err(|error| format!("{}: {error}", kept.display()))?;
    Ok(format!("{report}\nkept as {}", kept.display()))
}
