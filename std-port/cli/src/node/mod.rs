//! `cara node`.

use std::process::ExitCode;

use crate::global::Global;

/// To come.
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_: Arguments, _: &Global) -> anyhow::Result<ExitCode> {
    Err(crate::exit::Ended::usage("being built"))
}
