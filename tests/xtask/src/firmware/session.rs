//! `cargo xtask firmware BOARD --run`: a board in QEMU, its manager, and a prompt for `cara` beside them.

use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::Args;

use super::boards::{self, AGV};
use super::{NOT_ALLOWED, TESTED, tests};
use crate::install;

/// The boards and programs of the session.
#[derive(Args)]
pub(crate) struct SessionOptions {
    /// Runs an emulated board, with a manager and a prompt that takes verbs of `cara`; Ctrl-D ends it.
    #[arg(long)]
    pub(crate) run: bool,
    /// The vehicle's name.
    #[arg(long, requires = "run", default_value = "agv-17")]
    name: String,
    /// The vehicle's ID number.
    #[arg(long, requires = "run", default_value_t = 17)]
    id: u32,
    /// Its manager, as NAME/ID.
    #[arg(long, requires = "run", value_name = "NAME/ID", default_value = "depot/1")]
    manager: String,
    /// Their fleet.
    #[arg(long, requires = "run", default_value_t = 0)]
    fleet: u32,
}

/// Builds what is needed and runs it until the input ends.
pub(crate) fn session(board: Option<&str>, options: &SessionOptions) -> Result<ExitCode> {
    let Some(board) = board else { bail!("say which board: cargo xtask firmware {TESTED} --run") };
    let board = boards::emulated(board)?;
    install::program("qemu-system-arm", "qemu-system-arm").map_err(anyhow::Error::msg)?;
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    let image = board.build(&AGV)?;
    let (id, fleet) = (options.id.to_string(), options.fleet.to_string());
    let reported = ["session", "--name", &options.name, "--id", &id, "--manager", &options.manager, "--fleet", &fleet];
    match tests(board, &image)?.args(reported).interactive().code()? {
        Some(0) => Ok(ExitCode::SUCCESS),
        Some(NOT_ALLOWED) => bail!("the board needs a network of its own, see above"),
        Some(_) => bail!("the session ended, for the reason above"),
        None => bail!("a signal ended the session"),
    }
}
