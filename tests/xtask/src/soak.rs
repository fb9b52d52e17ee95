//! `cargo xtask soak`: the warehouse with its standby and page for hours, links cut and processes killed, and nothing may grow; or
//! the gateway to VDA 5050 with its broker and vehicles.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Result, bail};
use cara_processes::files;
use clap::Args;

use crate::command::Run;
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
    /// `target/soak.csv` or `target/soak-gateway.csv` unless given.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Draws it here, as soak.svg.
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// The last vehicle is firmware in QEMU.
    #[arg(long)]
    board: bool,
    /// The gateway in place of the warehouse, with 20 vehicles of its own; needs mosquitto.
    #[arg(long, conflicts_with_all = ["vehicles", "board"])]
    gateway: bool,
}

/// Runs for what is left of the time, then judges all that the file has.
pub(crate) fn run(soak: &Soak) -> Result<ExitCode> {
    let usual = if soak.gateway { "target/soak-gateway.csv" } else { "target/soak.csv" };
    let csv = std::path::absolute(soak.csv.as_deref().unwrap_or(usual.as_ref()))?;
    files::can_write(&csv)?;
    let (segments, done) = measured(&csv);
    let minutes = soak.time.saturating_sub(done).as_secs().div_ceil(60) as u32;
    if minutes > 0 && soak.gateway {
        let test = "test --locked --manifest-path gateways/vda5050/Cargo.toml --target-dir target/vda5050 --test soak";
        let run = Run::cargo().args(test.split(' ')).args(["--", "--nocapture"]);
        run.env("CARA_SOAK_FILE", &csv.to_string_lossy()).env("CARA_SOAK_MINUTES", &minutes.to_string()).stream()?;
    } else if minutes > 0 {
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
