//! `cara bench`.

use std::process::ExitCode;

use crate::global::Global;

/// Measures response time and availability.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// NAME, NAME/ID or #ID.
    node: String,
}

pub(crate) fn run(_: Arguments, _: &Global) -> anyhow::Result<ExitCode> {
    Err(crate::exit::Ended::usage("being built"))
}
