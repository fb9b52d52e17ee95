//! `cargo xtask sanitize`: the thread sanitizer over the Linux port, or Miri over the core. Both need a nightly compiler, which the
//! project uses for nothing else, so this is a command of its own and no group of checks.

use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::Args;

use crate::command::{Run, exists};

const TARGET: &str = "x86_64-unknown-linux-gnu";

/// What to look at, and with what.
#[derive(Args)]
pub(crate) struct Sanitize {
    /// Runs the unit tests of the core and of its cipher in Miri instead: the named ones, or all, which takes hours.
    #[arg(long, value_name = "TEST", num_args = 0..)]
    miri: Option<Vec<String>>,
}

pub(crate) fn run(sanitize: &Sanitize) -> Result<ExitCode> {
    match &sanitize.miri {
        Some(tests) => miri(tests),
        None => threads(),
    }
}

/// Miri finds reads of what was not written, references that alias, and bytes that are of no value of their type.
fn miri(tests: &[String]) -> Result<ExitCode> {
    let miri = Run::new("rustup").args(["run", "nightly", "cargo", "miri", "--version"]).captured()?;
    if !miri.0 {
        bail!("Miri is missing: rustup toolchain install nightly --component miri --component rust-src");
    }
    let cargo = ["run", "nightly", "cargo", "miri", "test", "--target-dir", "target/miri"];
    let tests =
        ["-p", "cara-core", "-p", "cara-secure", "--lib", "--"].into_iter().chain(tests.iter().map(String::as_str));
    // Properties ask the clock for seeds; a few cases of each are what the interpreter has time for.
    let run = Run::new("rustup").args(cargo).args(tests).env("MIRIFLAGS", "-Zmiri-disable-isolation");
    run.env("PROPTEST_CASES", "2").env("RUST_BACKTRACE", "0").stream()?;
    Ok(ExitCode::SUCCESS)
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
