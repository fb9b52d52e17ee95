//! Firmware in QEMU against the Linux manager: real machine code of a Cortex-M3 behind a virtual cable, in a network
//! namespace that the program makes for itself.
//!
//! Everything is checked from what the manager sees and from what the board logs; waits are bounded generously, and
//! nothing is timed.

mod board;
mod checks;
mod manager;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use cara_processes::network::{self, Own};
use clap::{Parser, Subcommand};

use board::Bench;

/// Runs an image of the board lm3s6965evb in QEMU and checks what it does.
#[derive(Parser)]
struct Arguments {
    /// The AGV's image.
    #[arg(long)]
    image: PathBuf,
    /// How often the board loses power and comes back.
    #[arg(long, default_value_t = 20)]
    restarts: u32,
    /// Only the checks whose names contain this.
    #[arg(long, default_value = "")]
    only: String,
    /// Says what the board logs.
    #[arg(long)]
    logs: bool,
    #[command(subcommand)]
    part: Option<Part>,
}

/// Parts of the test that are processes of their own.
#[derive(Subcommand)]
enum Part {
    /// A manager that can be killed.
    Manager,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let outcome = match arguments.part {
        Some(Part::Manager) => manager::stand_alone().map(|()| ExitCode::SUCCESS),
        None => in_own_network(&arguments),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("firmware: {error:#}");
        ExitCode::FAILURE
    })
}

/// Exit code of a test that could not be run; it has shown nothing.
const SKIPPED: u8 = 77;

fn in_own_network(arguments: &Arguments) -> Result<ExitCode> {
    match network::own(std::env::args_os().skip(1), &["qemu-system-arm"], true)? {
        Own::Inside => run(arguments).map(|()| ExitCode::SUCCESS),
        Own::Ended(status) if status.success() => Ok(ExitCode::SUCCESS),
        Own::Ended(status) => bail!("failed: {status}"),
        Own::Impossible(reason) => {
            eprintln!("skipped: {reason}");
            Ok(ExitCode::from(SKIPPED))
        }
    }
}

fn run(arguments: &Arguments) -> Result<()> {
    let bench = Bench::new(&arguments.image, arguments.logs)?;
    let mut passed = 0;
    for check in checks::CHECKS.iter().filter(|check| check.name.contains(&arguments.only)) {
        let start = Instant::now();
        let told = (check.run)(&bench, arguments.restarts).with_context(|| check.name.to_owned())?;
        println!("{:48} {:6.1} s  {told}", check.name, start.elapsed().as_secs_f64());
        passed += 1;
    }
    if passed == 0 {
        bail!("no check has `{}` in its name", arguments.only);
    }
    println!("{passed} checks of firmware passed");
    Ok(())
}
