//! `cara scan`.

use std::process::ExitCode;

use crate::global::Global;

/// Shows who is there, and who was refused and why.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Only nodes that offer this function.
    #[arg(long, value_name = "FUNCTION")]
    offering: Option<String>,
}

pub(crate) fn run(_: Arguments, _: &Global) -> anyhow::Result<ExitCode> {
    Err(crate::exit::Ended::usage("being built"))
}
