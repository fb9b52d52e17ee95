//! `cargo xtask chaos`: fleets on the simulator under all faults at once, judged all the time (`tests/sim/tests/chaos.rs`); and the
//! same with bugs that are planted on purpose, each of which has to be found.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Result;
use clap::Args;

use crate::command::Run;
use crate::paper::broken::Tree;
use crate::workspace;

/// How to run it.
#[derive(Args)]
pub(crate) struct Chaos {
    /// Fleets, each of another seed.
    #[arg(long, value_name = "N", default_value_t = 1_000, value_parser = clap::value_parser!(u32).range(1..))]
    seeds: u32,
    /// The first seed: a run that was stopped goes on from there, and several machines share one.
    #[arg(long, value_name = "SEED", default_value_t = 0, conflicts_with = "planted")]
    first: u32,
    /// Units of each fleet, the manager among them.
    #[arg(long, value_name = "M", default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=1_000))]
    nodes: u32,
    /// Hours that all units of all fleets have together; 20 s for each fleet if not given.
    #[arg(long, value_name = "H")]
    hours: Option<u32>,
    /// Plants bugs in a clone of the last commit instead, one at a time, and looks for each in N fleets.
    #[arg(long, conflicts_with = "hours")]
    planted: bool,
}

/// Fleets of a part of a run, which says where it is after each.
const PART: u32 = 5_000;

/// Bugs that break what chaos judges.
const PLANTED: [&str; 12] = [
    "tests/sim/planted/a-late-command-moves-as-if-it-were-new.patch",
    "tests/sim/planted/a-lease-does-not-end-by-time.patch",
    "tests/sim/planted/a-release-is-ignored.patch",
    "tests/sim/planted/a-renewal-counts-from-its-arrival.patch",
    "tests/sim/planted/a-reset-undoes-a-later-stop.patch",
    "tests/sim/planted/a-stop-does-not-latch.patch",
    "tests/sim/planted/a-stop-of-all-stops-one-actuator.patch",
    "tests/sim/planted/a-claim-is-forgotten-at-a-restart.patch",
    "tests/planted/a-call-made-earlier-replaces-a-later-one.patch",
    "tests/sim/planted/no-hook-runs-when-time-is-over.patch",
    "tests/variants/double-execution.patch",
    "tests/variants/leaked-slot.patch",
];

pub(crate) fn run(chaos: &Chaos) -> Result<ExitCode> {
    if chaos.planted {
        return planted(chaos);
    }
    let start = Instant::now();
    let end = chaos.first.saturating_add(chaos.seeds);
    for first in (chaos.first..end).step_by(PART as usize) {
        let seeds = PART.min(end - first);
        test(chaos, first, seeds, workspace::root(), &workspace::target()).stream()?;
        let done = first + seeds - chaos.first;
        let hours = f64::from(done) * f64::from(chaos.nodes) * seconds(chaos) as f64 / 3_600.0;
        let took = start.elapsed().as_secs_f64();
        println!(
            "{done} fleets of {} units, {hours:.0} node-hours in {took:.0} s; next --first {}",
            chaos.nodes,
            first + seeds
        );
    }
    Ok(ExitCode::SUCCESS)
}

/// How long faults begin in each fleet.
fn seconds(chaos: &Chaos) -> u64 {
    let each = |hours: u32| u64::from(hours) * 3_600 / u64::from(chaos.seeds) / u64::from(chaos.nodes);
    chaos.hours.map_or(20, each).max(5)
}

fn test(chaos: &Chaos, first: u32, seeds: u32, root: &Path, target: &Path) -> Run {
    let cargo =
        Run::cargo().within(root).args(["test", "--quiet", "--release", "--package", "cara-sim", "--test", "chaos"]);
    let cargo = cargo.args([Path::new("--target-dir"), target]).args(["whatever", "--", "--nocapture"]);
    let cargo = cargo.env("CARA_SIM_SEEDS", &seeds.to_string()).env("RUST_BACKTRACE", "0");
    let cargo = cargo.env("CARA_SIM_FIRST", &first.to_string());
    cargo.env("CARA_CHAOS_NODES", &chaos.nodes.to_string()).env("CARA_CHAOS_SECONDS", &seconds(chaos).to_string())
}

fn planted(chaos: &Chaos) -> Result<ExitCode> {
    let place = workspace::target().join("chaos");
    let tree = Tree::at(place.join("tree"))?;
    let mut found = 0;
    for patch in PLANTED.map(PathBuf::from) {
        let name = patch.file_stem().unwrap_or_default().to_string_lossy();
        tree.apply(&patch)?;
        let start = Instant::now();
        let ran = test(chaos, 0, chaos.seeds, &tree.root, &place.join("build")).captured();
        tree.reset()?;
        let (passed, output, errors) = ran?;
        let why = errors.lines().skip_while(|line| !line.contains(" panicked at tests/sim/")).nth(1);
        let took = start.elapsed().as_secs_f64();
        match why.filter(|_| !passed) {
            Some(why) => {
                found += 1;
                println!("{name:<60} found, {took:.0} s: {why}");
            }
            None => println!("{name:<60} NOT FOUND, {took:.0} s: {}", output.lines().last().unwrap_or_default()),
        }
    }
    println!("{found} of {} found in {} fleets each, at {}", PLANTED.len(), chaos.seeds, tree.commit);
    Ok(if found == PLANTED.len() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
