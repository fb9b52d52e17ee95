//! Bugs that are planted on purpose, by patches: each has to be found.

use anyhow::{Result, bail};

use crate::command::Run;
use crate::paper::broken::CONTEXT;
use crate::{binaries, workspace};

/// Found by scenarios. The third, `lost-wake-up`, is a race of threads: the model of the hand-over finds it in every run, the
/// scenarios on Linux only in most.
const BY_SCENARIOS: [&str; 2] = ["double-execution", "leaked-slot"];

/// Fails where a patch of `tests/variants` does not apply.
pub(crate) fn check() -> Result<()> {
    let patches = workspace::files_with("patch")?;
    for patch in patches.iter().filter(|patch| patch.starts_with(binaries::VARIANTS)) {
        Run::new("git").args(["apply", "--check", CONTEXT]).args([patch]).text()?;
    }
    Ok(())
}

/// Builds the scenarios with each bug, and requires that some of them fail.
pub(crate) fn scenarios() -> Result<()> {
    for bug in BY_SCENARIOS {
        binaries::changed(binaries::debug_build(&["seeds"]), bug)?.stream()?;
        let seeds = binaries::changed_folder(bug).join("debug/seeds");
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
    let (passed, output, _) = binaries::changed(model(), "lost-wake-up")?.captured()?;
    if passed || !output.contains("no thread reads") {
        bail!("the planted lost wake-up was not found: {output}");
    }
    println!("the planted lost wake-up is found");
    Ok(())
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
