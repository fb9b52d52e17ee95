//! Bugs that are planted on purpose, behind the cfg `cara_planted` that nothing else sets: each has to be found.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
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
        let finders = finders(&output);
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

/// Sets the cfg in the crates of the workspace alone: what they depend on is that of every other build. Cargo tells builds
/// apart by the path of the wrapper; what this one makes goes to a folder of its own, so that nothing else runs it.
fn plant(build: Run, bug: &str) -> Result<Run> {
    let folder = folder(bug);
    fs::create_dir_all(&folder)?;
    let wrapper = folder.join("rustc-with-bug");
    fs::write(&wrapper, format!("#!/bin/sh\nexec \"$@\" --cfg 'cara_planted=\"{bug}\"'\n"))?;
    fs::set_permissions(&wrapper, Permissions::from_mode(0o755))?;
    Ok(build
        .env("RUSTC_WORKSPACE_WRAPPER", &wrapper.to_string_lossy())
        .env("CARGO_BUILD_BUILD_DIR", &workspace::target().to_string_lossy())
        .env("CARGO_TARGET_DIR", &folder.to_string_lossy()))
}

fn folder(bug: &str) -> PathBuf {
    workspace::target().join("planted").join(bug)
}

/// Scenarios of which the output says that a run of theirs failed.
fn finders(output: &str) -> Vec<&str> {
    let mut current = "";
    let mut finders = Vec::new();
    for line in output.lines() {
        if !line.starts_with(' ') {
            current = line.split_whitespace().next().unwrap_or_default();
        } else if line.starts_with("  FAILED with seed") && finders.last() != Some(&current) {
            finders.push(current);
        }
    }
    finders
}

#[cfg(test)]
mod tests {
    use super::finders;

    #[test]
    fn failed_scenarios_are_named_once() {
        let output = "a (1): 10 seeds, 0.1 s\n  faults: none\n  FAILED with seed 1: x\n    assertion\n  FAILED with seed 2: x\n\
                      b (2): 10 seeds\n  FAILED: `x` was never reached\n";
        assert_eq!(finders(output), ["a"]);
    }
}
