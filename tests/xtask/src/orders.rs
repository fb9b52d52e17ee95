//! `cargo xtask orders`: fleets drawn from many seeds, in which nothing may move that is not wanted; and the same with bugs that
//! are planted on purpose, each of which a normal run must find. A command of its own, for each bug is a build.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Result, ensure};
use clap::Args;

use crate::command::Run;
use crate::paper::broken::{CONTEXT, Tree};
use crate::workspace;

/// How to run them.
#[derive(Args)]
pub(crate) struct Orders {
    /// Seeds of the fleet of 5 vehicles.
    #[arg(long, default_value_t = 10_000)]
    seeds: u32,
    /// Seeds of the fleet of 200.
    #[arg(long, default_value_t = 100)]
    large: u32,
    /// Plants the bugs of `tests/sim/planted` in a clone of the last commit instead, one at a time.
    #[arg(long)]
    planted: bool,
}

const PATCHES: &str = "tests/sim/planted";
/// Fewest bugs that are planted.
const LEAST: usize = 12;
const SMALL: &str = "tests/sim/tests/orders/main.rs::five_vehicles_move_only_as_they_are_wanted";

pub(crate) fn run(orders: &Orders) -> Result<ExitCode> {
    if orders.planted {
        return planted();
    }
    for (test, seeds) in [("five_vehicles", orders.seeds), ("many_vehicles", orders.large)] {
        let start = Instant::now();
        let cargo =
            Run::cargo().args(["test", "--quiet", "--release", "--package", "cara-sim", "--test", "orders", test]);
        cargo.args(["--", "--nocapture"]).env("CARA_SIM_SEEDS", &seeds.to_string()).stream()?;
        println!("{seeds} seeds in {:.0} s", start.elapsed().as_secs_f64());
    }
    Ok(ExitCode::SUCCESS)
}

fn patches() -> Result<Vec<PathBuf>> {
    let mut patches = workspace::files_with("patch")?;
    patches.retain(|file| file.starts_with(PATCHES));
    patches.sort();
    Ok(patches)
}

/// Fails where a patch does not apply, or too few are there.
pub(crate) fn check() -> Result<()> {
    let patches = patches()?;
    for patch in &patches {
        Run::new("git").args(["apply", "--check", CONTEXT]).args([patch]).text()?;
    }
    ensure!(patches.len() >= LEAST, "{PATCHES} has {} bugs, {LEAST} are to be planted", patches.len());
    println!("{} bugs of orders to plant, each applies", patches.len());
    Ok(())
}

fn planted() -> Result<ExitCode> {
    let (start, tree, patches) = (Instant::now(), Tree::new()?, patches()?);
    ensure!(tree.passes_as_it_is(SMALL), "{SMALL} does not pass without a bug");
    let mut found = 0;
    for patch in &patches {
        let verdict = tree.finds(patch, SMALL);
        found += usize::from(verdict.is_ok());
        let name = Path::new(patch).file_stem().unwrap_or_default().to_string_lossy();
        match verdict {
            Ok(_) => println!("{name:<70} found"),
            Err(why) => println!("{name:<70} NOT FOUND: {why:#}"),
        }
    }
    println!("{found} of {} found at {} in {:.0} s", patches.len(), tree.commit, start.elapsed().as_secs_f64());
    Ok(if found == patches.len() && found >= LEAST { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
