//! `cargo xtask networks` and `cargo xtask hosts`: what breaks between two hosts or on one, what is lost, and how long until calls
//! are answered again.

use std::process::ExitCode;

use anyhow::Result;
use clap::Args;

use crate::command::Run;

/// How much is to break.
#[derive(Args)]
pub(crate) struct Faults {
    /// Faults of each kind, of 0.5 to 12 s.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(1..))]
    each: u32,
    /// Only kinds whose names contain this.
    #[arg(long, value_name = "TEXT", default_value = "")]
    kind: String,
}

/// Breaks networks, and prints the table.
pub(crate) fn networks(faults: &Faults) -> Result<ExitCode> {
    inject(faults, Run::cargo().args(["test", "--quiet", "--package", "cara-std", "--test", "networks"]))
}

/// Breaks hosts, and prints the table. What the test mounts nobody else sees, and it is gone with its processes.
pub(crate) fn hosts(faults: &Faults) -> Result<ExitCode> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let words = ["--mount", &cargo, "test", "--quiet", "--package", "cara-cli", "--test", "hosts"];
    inject(faults, Run::new("unshare").args(words))
}

fn inject(faults: &Faults, test: Run) -> Result<ExitCode> {
    let test = test.args(["--", "--nocapture"]).env("CARA_EACH", &faults.each.to_string());
    test.env("CARA_KIND", &faults.kind).env("CI", "1").stream()?;
    Ok(ExitCode::SUCCESS)
}
