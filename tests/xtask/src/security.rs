//! `cargo xtask security`: everything that attackers try, on the simulator, on boards in QEMU and on units of the Linux
//! port, in one table.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use cara_processes::files;
use clap::Args;

use crate::binaries;
use crate::firmware;
use crate::groups::{Extent, Outcome};
use crate::workspace;

/// How much is tried, and where the figures go.
#[derive(Args)]
pub(crate) struct Security {
    /// Tries some of everything, and leaves the boards out.
    #[arg(long)]
    quick: bool,
    /// Only measures how long vehicles and boards take to join beside recorded and forged discovery: so many for each attack.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000), conflicts_with_all = ["quick", "json"])]
    starts: Option<u32>,
    /// Also writes the figures here.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// The command: the table, and success only if no attack came to anything.
pub(crate) fn run(options: &Security) -> Result<ExitCode> {
    if let Some(starts) = options.starts {
        return kept_away(starts);
    }
    options.json.as_deref().map_or(Ok(()), files::can_write)?;
    let extent = if options.quick { Extent::Quick } else { Extent::Full };
    if let Some(reason) = attack(extent, options.json.as_deref())? {
        println!("without boards: {reason}");
    }
    Ok(ExitCode::SUCCESS)
}

/// Starts Linux vehicles and boards beside each attack.
fn kept_away(starts: u32) -> Result<ExitCode> {
    let starts = starts.to_string();
    binaries::release("cara-security")?.args(["--starts", &starts]).stream()?;
    if let Some(reason) = firmware::kept_away(&starts)? {
        println!("without boards: {reason}");
    }
    Ok(ExitCode::SUCCESS)
}

/// The group. What could not be attacked makes it skipped.
pub(crate) fn check(extent: Extent) -> Outcome {
    match attack(extent, None) {
        Ok(Some(reason)) if extent == Extent::Full => Outcome::Skipped(reason),
        Ok(_) => Outcome::Passed,
        Err(error) => Outcome::Failed(format!("{error:#}")),
    }
}

/// Attacks everything; why boards were left out, if they were.
fn attack(extent: Extent, json: Option<&Path>) -> Result<Option<String>> {
    let folder = workspace::root().join("target/security");
    std::fs::create_dir_all(&folder).context("cannot make a folder for figures")?;
    let [simulator, boards] = ["simulator.txt", "boards.json"].map(|name| folder.join(name));
    std::fs::write(&simulator, simulated()?)?;
    let left_out = match extent {
        Extent::Full => firmware::attack(&boards)?,
        Extent::Quick => Some("the quick run has none".to_owned()),
    };
    let run = binaries::debug("cara-security")?.args(["--simulator".as_ref(), simulator.as_os_str()]);
    let run = if extent == Extent::Quick { run.args(["--quick"]) } else { run };
    let run = if left_out.is_none() { run.args(["--with".as_ref(), boards.as_os_str()]) } else { run };
    let run = match json {
        // The child runs in the project's root, wherever this command was started.
        Some(path) => run.args(["--json".as_ref(), std::path::absolute(path)?.as_os_str()]),
        None => run,
    };
    run.stream()?;
    Ok(left_out)
}

/// What the simulator's attackers print.
fn simulated() -> Result<String> {
    let (code, output) = binaries::tests().args(["--quiet", "--test", "security", "--", "--nocapture"]).output()?;
    ensure!(code == Some(0), "attacks on the simulator: {output}");
    Ok(output)
}
