//! `cargo xtask faults`: how long the motors of an emulated board go on behind a fault, beside the bound.

use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::Args;

use super::boards::{self, FAULTS};
use super::{NOT_ALLOWED, TESTED, emulated, tests};
use crate::groups::Outcome;
use crate::install;

/// How many faults are injected.
#[derive(Args)]
pub(crate) struct Faults {
    /// Faults of each kind.
    #[arg(long, default_value_t = 26, value_parser = clap::value_parser!(u32).range(1..))]
    each: u32,
    /// Only kinds whose names contain this.
    #[arg(long, value_name = "TEXT", default_value = "")]
    kind: String,
    /// From which the moments of the faults follow; drawn, and printed, if not given.
    #[arg(long)]
    seed: Option<u64>,
    /// The emulated board.
    #[arg(long, default_value = TESTED)]
    board: String,
}

impl Faults {
    /// Those of a check.
    pub(super) fn checked(board: &str) -> Self {
        Self { each: CHECKED, kind: String::new(), seed: None, board: board.to_owned() }
    }
}

/// Faults of each kind in the checks.
const CHECKED: u32 = 6;

/// Injects faults and prints the table of the longest stops.
pub(crate) fn faults(faults: &Faults) -> Result<ExitCode> {
    install::program("qemu-system-arm", "qemu-system-arm").map_err(anyhow::Error::msg)?;
    install::program("nft", "nftables").map_err(anyhow::Error::msg)?;
    match injected(faults, &[])? {
        Some(0) => Ok(ExitCode::SUCCESS),
        Some(NOT_ALLOWED) => bail!("the board needs a network of its own, see above"),
        code => bail!("it ended with code {code:?}"),
    }
}

/// Injects a few of each kind.
pub(crate) fn check() -> Outcome {
    if let Err(reason) = install::program("nft", "nftables") {
        return Outcome::Skipped(reason);
    }
    emulated(|| injected(&Faults::checked(TESTED), &["--busy-host"]))
}

pub(super) fn injected(faults: &Faults, more: &[&str]) -> Result<Option<i32>> {
    let board = boards::emulated(&faults.board)?;
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    let image = board.build(&FAULTS)?;
    let seed = faults.seed.map(|seed| ["--seed".to_owned(), seed.to_string()]);
    let each = faults.each.to_string();
    tests(board, &image)?
        .args(["faults", "--each", &each, "--kind", &faults.kind])
        .args(seed.iter().flatten())
        .args(more)
        .code()
}
