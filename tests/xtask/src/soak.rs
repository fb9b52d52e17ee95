//! `cargo xtask soak`: the warehouse with its standby and page for hours, links cut and processes killed, and nothing may grow.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Result, bail};
use cara_processes::files;
use clap::Args;

use crate::fuzz::time;
use crate::{binaries, demo};

/// What a soak is to be.
#[derive(Args)]
pub(crate) struct Soak {
    /// How many vehicles.
    #[arg(long, default_value_t = 200)]
    vehicles: u32,
    /// For how long in all, as in 20m or 2h; what FILE has counts.
    #[arg(long = "for", value_name = "TIME", default_value = "2h", value_parser = time)]
    time: Duration,
    /// What processes held, each 10 s; a run that was stopped goes on with it.
    #[arg(long, value_name = "FILE", default_value = "target/soak.csv")]
    csv: PathBuf,
    /// Draws it here, as soak.svg.
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// The last vehicle is firmware in QEMU.
    #[arg(long)]
    board: bool,
}

/// Runs for what is left of the time, then judges all that the file has.
pub(crate) fn run(soak: &Soak) -> Result<ExitCode> {
    files::can_write(&soak.csv)?;
    let csv = std::path::absolute(&soak.csv)?;
    let (segments, done) = measured(&csv);
    let minutes = soak.time.saturating_sub(done).as_secs().div_ceil(60) as u32;
    if minutes > 0 {
        let options = demo::Options::soak(soak.vehicles, minutes, segments + 1, soak.board, csv.clone());
        if demo::warehouse(&options)? != ExitCode::SUCCESS {
            bail!("the warehouse was not as it has to be, see above; {} has what it held", csv.display());
        }
    }
    let folder = soak.plots.as_deref().map(std::path::absolute).transpose()?;
    let judge = binaries::debug("cara-bench")?.args(["soak".as_ref(), csv.as_os_str()]).args(folder);
    Ok(if judge.code()? == Some(0) { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// How many runs a file has, and for how long they ran together.
fn measured(csv: &Path) -> (u64, Duration) {
    let text = fs::read_to_string(csv).unwrap_or_default();
    let last = text.lines().rev().find_map(|line| {
        let mut fields = line.split(',').map(|field| field.parse::<u64>().ok());
        Some((fields.next()?? + 1, Duration::from_secs(fields.next()??)))
    });
    last.unwrap_or_default()
}
