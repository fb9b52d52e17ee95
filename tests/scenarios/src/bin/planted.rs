//! Builds with each bug that is planted behind a test-only cfg, and requires that the scenarios find it.
//!
//! `planted [BUG…]`; all of them without a name.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Output};
use std::time::Instant;

use cara_processes::planted;

const RUN: &[&str] = &["run", "--package", "cara-scenarios", "--bin", "seeds", "--", "--seeds", "10"];
const BUILD: &[&str] = &["build", "--package", "cara-scenarios", "--bin", "seeds"];

/// The third one, `lost_wakeup`, is a race of threads: the model of the hand-over finds it in every run (`loom`), the
/// scenarios on Linux only in most.
const BUGS: [&str; 2] = ["double_execution", "leaked_slot"];

fn main() -> ExitCode {
    let names: Vec<String> = std::env::args().skip(1).collect();
    let wanted: Vec<&str> =
        BUGS.into_iter().filter(|bug| names.is_empty() || names.iter().any(|name| name == bug)).collect();
    if wanted.is_empty() {
        eprintln!("there is no such bug: {}", names.join(", "));
        return ExitCode::from(2);
    }
    let found = wanted.iter().filter(|bug| finds(bug)).count();
    println!("{found} of {} planted bugs found", wanted.len());
    if found == wanted.len() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Whether the run fails because of the bug, rather than the build.
fn finds(bug: &str) -> bool {
    let start = Instant::now();
    let wrapper = planted::wrapper(&root(), bug).expect("the target folder can be written");
    let built = cargo(&wrapper, BUILD);
    if !built.status.success() {
        println!("{bug}: does not build\n{}", String::from_utf8_lossy(&built.stderr));
        return false;
    }
    let output = cargo(&wrapper, RUN);
    let text = String::from_utf8_lossy(&output.stdout);
    let finders = finders(&text);
    let found = !output.status.success() && !finders.is_empty();
    let verdict = if found { "found" } else { "NOT FOUND" };
    let seconds = start.elapsed().as_secs();
    println!("{bug}: {verdict} in {seconds} s by {} scenarios: {}", finders.len(), finders.join(", "));
    found
}

/// Scenarios of which the output says that a run of theirs failed.
fn finders(text: &str) -> Vec<String> {
    let mut current = "";
    let mut finders: Vec<String> = Vec::new();
    for line in text.lines() {
        let word = line.split_whitespace().next().unwrap_or_default();
        let linux = line.strip_prefix("test ").filter(|rest| rest.contains("... FAILED"));
        if let Some(name) = linux.and_then(|rest| rest.split_whitespace().next()) {
            finders.push(name.to_owned());
        } else if !line.starts_with(' ') {
            current = word;
        } else if line.starts_with("  FAILED with seed") && finders.last().is_none_or(|last| last != current) {
            finders.push(current.to_owned());
        }
    }
    finders
}

fn cargo(wrapper: &Path, arguments: &[&str]) -> Output {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    Command::new(cargo)
        .args(arguments)
        .current_dir(root())
        .env("RUSTC_WORKSPACE_WRAPPER", wrapper)
        .output()
        .expect("cargo can be started")
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

#[cfg(test)]
mod tests {
    use super::finders;

    #[test]
    fn failed_scenarios_are_named_once() {
        let seeds = "a (1): 10 seeds, 0.1 s\n  faults: none\n  FAILED with seed 1: x\n    assertion\n  FAILED with seed 2: x\n\
                     b (2): 10 seeds\n  FAILED: `x` was never reached\n";
        assert_eq!(finders(seeds), ["a"]);
        assert_eq!(finders("test c ... FAILED (3 ms)\ntest d ... ok (1 ms)\n"), ["c"]);
    }
}
