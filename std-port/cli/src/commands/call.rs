//! `cara call`.

use std::process::ExitCode;

use crate::global::Global;

/// Calls a function.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// NAME, NAME/ID or #ID.
    node: Option<String>,
}

pub(crate) fn run(_: Arguments, _: &Global) -> anyhow::Result<ExitCode> {
    Err(crate::exit::Ended::usage("being built"))
}
