//! Bugs that are planted on purpose, behind the cfg `cara_planted` that nothing else sets: each has to be found.

use std::path::PathBuf;

use anyhow::{Result, bail};

use crate::command::Run;
use crate::{binaries, workspace};

/// Found by scenarios. The third, `lost_wakeup`, is a race of threads: the model of the hand-over finds it in every run, the
/// scenarios on Linux only in most.
const BY_SCENARIOS: [&str; 2] = ["double_execution", "leaked_slot"];

/// Builds the scenarios with each bug, and requires that some of them fail.
pub(crate) fn scenarios() -> Result<()> {
    for bug in BY_SCENARIOS {
        plant(binaries::debug_build(&["seeds"]), bug)?.stream()?;
        let seeds = folder(bug).join("debug/seeds");
        let (passed, output, errors) = Run::new(&seeds.to_string_lossy()).args(["--seeds", "10"]).captured()?;
        let finders = failed(&output);
        if passed || finders.is_empty() {
            bail!("no scenario found the planted {bug}: {output}{errors}");
        }
        println!("{bug}: found by {} scenarios: {}", finders.len(), finders.join(", "));
    }
    Ok(())
}

/// The model of the hand-over must pass, and must fail with its bug.
pub(crate) fn loom() -> Result<()> {
    // It has to be named: it takes too long beside the other tests.
    let model = || binaries::tests().args(["--test", "hand_over"]);
    model().stream()?;
    let (passed, output, _) = plant(model(), "lost_wakeup")?.captured()?;
    if passed || !output.contains("no thread reads") {
        bail!("the planted lost wake-up was not found: {output}");
    }
    println!("the planted lost wake-up is found");
    Ok(())
}

fn plant(build: Run, bug: &str) -> Result<Run> {
    binaries::with_cfg(build, &folder(bug), &format!("cara_planted=\"{bug}\""))
}

fn folder(bug: &str) -> PathBuf {
    workspace::target().join("planted").join(bug)
}

/// Scenarios of which the output says that a run of theirs failed.
pub(crate) fn failed(output: &str) -> Vec<&str> {
    let mut current = "";
    let mut failed = Vec::new();
    for line in output.lines() {
        if !line.starts_with(' ') {
            current = line.split_whitespace().next().unwrap_or_default();
        } else if line.starts_with("  FAILED with seed") && failed.last() != Some(&current) {
            failed.push(current);
        }
    }
    failed
}

#[cfg(test)]
mod tests {
    use super::failed;

    #[test]
    fn failed_scenarios_are_named_once() {
        let output = "a (1): 10 seeds, 0.1 s\n  faults: none\n  FAILED with seed 1: x\n    assertion\n  FAILED with seed 2: x\n\
                      b (2): 10 seeds\n  FAILED: `x` was never reached\n";
        assert_eq!(failed(output), ["a"]);
    }
}
