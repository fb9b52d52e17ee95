//! `cargo xtask demo`: the listing between real processes.

use std::process::ExitCode;

use anyhow::Result;

/// Runs the demonstration; success only if everything in it happened.
pub(crate) fn run() -> Result<ExitCode> {
    Ok(crate::later::DEMO.refuse())
}
