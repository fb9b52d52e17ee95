//! `cara completions`.

use std::process::ExitCode;

use crate::global::Global;

/// Prints a completion script.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The shell.
    shell: clap_complete::Shell,
}

pub(crate) fn run(_: Arguments, _: &Global) -> anyhow::Result<ExitCode> {
    Err(crate::exit::Ended::usage("being built"))
}
