//! `cargo xtask sanitize`: the thread sanitizer over the Linux port, or Miri over the core. Both need a nightly compiler, which the
//! project uses for nothing else, so this is a command of its own and no group of checks.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufRead, Read, Write};
use std::process::ExitCode;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;

use crate::command::{Run, exists};
use crate::workspace;

const TARGET: &str = "x86_64-unknown-linux-gnu";

/// What to look at, and with what.
#[derive(Args)]
pub(crate) struct Sanitize {
    /// Runs the unit tests of the core and of its cipher in Miri instead: the named ones, or all, which takes an hour.
    #[arg(long, value_name = "TEST", num_args = 0..)]
    miri: Option<Vec<String>>,
}

pub(crate) fn run(sanitize: &Sanitize) -> Result<ExitCode> {
    match &sanitize.miri {
        Some(tests) => miri(tests),
        None => threads(),
    }
}

/// What a test may take in Miri, which is some hundred times slower than the machine.
const LIMIT: Duration = Duration::from_secs(120);

/// Miri finds reads of what was not written, references that alias, and bytes that are of no value of their type. A run that was
/// stopped goes on with the tests that its commit has left; a test beyond the limit is named, and is no failure.
fn miri(tests: &[String]) -> Result<ExitCode> {
    let miri = Run::new("rustup").args(["run", "nightly", "cargo", "miri", "--version"]).captured()?;
    if !miri.0 {
        bail!("Miri is missing: rustup toolchain install nightly --component miri --component rust-src");
    }
    let listed = interpreted(&["--list", "--format", "terse"]).args(tests).text()?;
    let names: Vec<&str> = listed.lines().filter_map(|line| line.strip_suffix(": test")).collect();
    let commit = Run::new("git").args(["rev-parse", "--short", "HEAD"]).text()?;
    let place = workspace::target().join("miri").join(format!("tests-{}", commit.trim()));
    let mut state = File::options().read(true).append(true).create(true).open(&place)?;
    let mut done = String::new();
    state.read_to_string(&mut done)?;
    let mut results: HashMap<&str, String> = done
        .lines()
        .filter_map(|line| line.split_once(' '))
        .filter_map(|(result, name)| Some((*names.iter().find(|known| **known == name)?, result.to_owned())))
        .collect();
    loop {
        let left: Vec<&str> = names.iter().copied().filter(|name| !results.contains_key(name)).collect();
        let Some(next) = left.first() else { break };
        println!("{} of {} tests are left", left.len(), names.len());
        let mut unfinished = next;
        let is_late = batch(&left, |name, result| {
            let Some(at) = left.iter().position(|known| *known == name) else { return Ok(()) };
            println!("{result} {name}");
            unfinished = left.get(at + 1).unwrap_or(unfinished);
            results.insert(left[at], result.to_owned());
            Ok(writeln!(state, "{result} {name}")?)
        })?;
        // Miri ends the process with the test in which it has found something.
        if !results.contains_key(unfinished) {
            let result = if is_late { "late" } else { "FAILED" };
            println!("{result} {unfinished}");
            results.insert(unfinished, result.to_owned());
            writeln!(state, "{result} {unfinished}")?;
        }
    }
    let count = |result| results.values().filter(|one| *one == result).count();
    let failed = count("FAILED");
    println!(
        "{} tests passed, {failed} failed, {} are not for Miri, {} took longer than {} s: {}",
        count("ok"),
        count("ignored"),
        count("late"),
        LIMIT.as_secs(),
        place.display()
    );
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The unit tests of the core and of its cipher, in Miri.
fn interpreted(words: &[&str]) -> Run {
    let cargo = ["run", "nightly", "cargo", "miri", "test", "--quiet", "--target-dir", "target/miri"];
    let run = Run::new("rustup").args(cargo).args(["-p", "cara-core", "-p", "cara-secure", "--lib", "--"]).args(words);
    // Properties ask the clock for seeds; a few cases of each are what the interpreter has time for.
    let run = run.env("MIRIFLAGS", "-Zmiri-disable-isolation");
    run.env("PROPTEST_CASES", "2").env("RUST_BACKTRACE", "0")
}

/// Runs tests one after the other, and passes each result on. Ends with the last, with one that fails, or where nothing comes
/// within the limit, which is told.
fn batch(tests: &[&str], mut ended: impl FnMut(&str, &str) -> Result<()>) -> Result<bool> {
    let words = ["--exact", "--test-threads=1", "--format=pretty"];
    let (mut child, output) = interpreted(&words).args(tests).started()?;
    let (sender, lines) = mpsc::channel();
    std::thread::spawn(move || output.lines().map_while(|line| sender.send(line.ok()?).ok()).for_each(drop));
    let is_late = loop {
        match lines.recv_timeout(LIMIT) {
            Ok(line) => {
                let result = line.strip_prefix("test ").and_then(|line| line.split_once(" ... "));
                if let Some((name, result)) = result {
                    // "name - should panic ... ok", "name ... ignored, why"
                    let first = |text, end| str::split(text, end).next().unwrap_or(text);
                    ended(first(name, " - "), first(result, ","))?;
                }
            }
            Err(RecvTimeoutError::Timeout) => break true,
            Err(RecvTimeoutError::Disconnected) => break false,
        }
    };
    if is_late {
        // Cargo alone would leave the interpreter.
        Run::new("kill").args(["-KILL", "--", &format!("-{}", child.id())]).text()?;
    }
    child.wait()?;
    Ok(is_late)
}

/// Runs the unit and port tests of the Linux port. A data race, or a thread that is never joined, fails them.
fn threads() -> Result<ExitCode> {
    if !exists("rustup") {
        bail!("rustup is missing: see https://rustup.rs");
    }
    let toolchains = Run::new("rustup").args(["toolchain", "list"]).text()?;
    let components = match has_nightly(&toolchains) {
        true => Run::new("rustup").args(["component", "list", "--installed", "--toolchain", "nightly"]).text()?,
        false => String::new(),
    };
    if let Some(command) = missing(&toolchains, &components) {
        bail!("the thread sanitizer needs a nightly compiler and the sources of the standard library: {command}");
    }
    let cargo =
        ["run", "nightly", "cargo", "test", "-Zbuild-std", "--target", TARGET, "--target-dir", "target/sanitize"];
    let tests = ["-p", "cara-std", "--features", "async", "--lib", "--test", "port"];
    let run = Run::new("rustup").args(cargo).args(tests).env("RUSTFLAGS", "-Zsanitizer=thread");
    // A backtrace takes longer to write below the sanitizer than a call waits for its answer.
    run.env("RUST_BACKTRACE", "0").stream()?;
    println!("no data race and no leaked thread; target/sanitize can be removed");
    Ok(ExitCode::SUCCESS)
}

fn has_nightly(toolchains: &str) -> bool {
    toolchains.lines().any(|line| line.starts_with("nightly-x86_64") || line.trim() == "nightly")
}

/// The command that brings what is not installed.
fn missing(toolchains: &str, components: &str) -> Option<&'static str> {
    match (has_nightly(toolchains), components.lines().any(|line| line.trim() == "rust-src")) {
        (false, _) => Some("rustup toolchain install nightly --component rust-src"),
        (true, false) => Some("rustup component add rust-src --toolchain nightly"),
        (true, true) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::missing;

    #[test]
    fn what_is_missing_is_told_with_the_command_that_brings_it() {
        let stable = "stable-x86_64-unknown-linux-gnu (active, default)\n";
        let both = format!("{stable}nightly-x86_64-unknown-linux-gnu\n");
        assert!(missing(stable, "").unwrap().contains("toolchain install nightly"));
        assert!(
            missing("nightly-2026-01-01-x86_64-unknown-linux-gnu\n", "")
                .is_some_and(|reported| reported.contains("install"))
        );
        assert!(missing(&both, "cargo\nrustc\n").unwrap().contains("component add rust-src"));
        assert_eq!(missing(&both, "cargo\nrust-src\n"), None);
    }
}
