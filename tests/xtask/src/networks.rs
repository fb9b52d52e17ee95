//! `cargo xtask networks`: what breaks between two hosts, what is lost, and how long until calls are answered again.

use std::process::ExitCode;

use anyhow::Result;
use clap::Args;

use crate::command::Run;

/// How much is to break.
#[derive(Args)]
pub(crate) struct Networks {
    /// Faults of each kind, of 0.5 to 12 s.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(1..))]
    each: u32,
    /// Only kinds whose names contain this.
    #[arg(long, value_name = "TEXT", default_value = "")]
    kind: String,
}

/// Breaks it, and prints the table.
pub(crate) fn run(networks: &Networks) -> Result<ExitCode> {
    let test =
        Run::cargo().args(["test", "--quiet", "--package", "cara-std", "--test", "networks", "--", "--nocapture"]);
    test.env("CARA_EACH", &networks.each.to_string()).env("CARA_KIND", &networks.kind).env("CI", "1").stream()?;
    Ok(ExitCode::SUCCESS)
}
