//! Runs all attacks on Linux units and prints one table.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use cara_security::between::Middle;
use cara_security::links::{self, Extent};
use cara_security::linux::{Linux, LinuxVehicles, Weakness};
use cara_security::tally::Report;
use cara_security::{discovery, floods, kept_away, permission, tally};
use clap::Parser;

/// More than the attempts of any attack: their manager would refuse two vehicles of one identity at the same time.
const VEHICLES: u32 = 4_096;

/// Attacks units of the Linux port on loopback.
#[derive(Parser)]
struct Arguments {
    /// Some of everything.
    #[arg(long)]
    quick: bool,
    /// Only the parts whose names contain this: links, between, permission, discovery, floods.
    #[arg(long, default_value = "")]
    only: String,
    /// Only vehicles that start beside recorded and forged discovery: so many for each attack and rate.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000))]
    starts: Option<u32>,
    /// What the simulator's attackers have printed: their figures stand first in the table.
    #[arg(long, value_name = "FILE")]
    simulator: Option<PathBuf>,
    /// Figures that another program has written, for the table.
    #[arg(long, value_name = "FILE")]
    with: Vec<PathBuf>,
    /// Also writes the figures here.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    run(&Arguments::parse()).unwrap_or_else(|error| {
        eprintln!("security: {error:#}");
        ExitCode::FAILURE
    })
}

fn run(arguments: &Arguments) -> Result<ExitCode> {
    if let Some(starts) = arguments.starts {
        let mut report = Report::default();
        kept_away::run(&mut report, Weakness::None, starts, &[1, 4, 20, 100])?;
        // At one a second nothing is refused yet, so that no counter need tell of it.
        let all_joined = report.rows.iter().all(|row| row.successes == 0);
        return Ok(if all_joined { ExitCode::SUCCESS } else { ExitCode::FAILURE });
    }
    let extent = if arguments.quick { Extent::Quick } else { Extent::Full };
    let linux = Linux::new(VEHICLES, Weakness::None)?;
    let mut report = Report::default();
    if let Some(path) = &arguments.simulator {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        report.rows.extend(tally::simulated(&text));
        ensure!(!report.rows.is_empty(), "{} has no figures of the simulator's attackers", path.display());
    }
    let (manager, vehicles) = (linux.manager()?, LinuxVehicles::new(&linux));
    let wanted = |part: &str| part.contains(&arguments.only);
    if wanted("links") {
        links::run(&mut report, &manager, extent)?;
        links::run(&mut report, &vehicles, extent)?;
    }
    if wanted("between") {
        Middle::new(&linux, &manager, &vehicles).run(&mut report, extent)?;
    }
    if wanted("permission") {
        permission::run(&mut report, &linux, &manager, extent)?;
    }
    if wanted("discovery") {
        discovery::run(&mut report, &linux, &manager, extent)?;
    }
    if wanted("floods") {
        floods::run(&mut report, &linux, &manager, extent)?;
    }
    for path in &arguments.with {
        report.rows.extend(Report::read(path)?.rows);
    }
    println!("{report}");
    if let Some(path) = &arguments.json {
        report.write(path)?;
    }
    let faults = report.faults();
    faults.iter().for_each(|fault| eprintln!("{fault}"));
    Ok(if faults.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
