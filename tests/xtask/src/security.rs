//! `cargo xtask security`: everything that attackers try, on the simulator and on units of the Linux port, in one table.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use clap::Args;

use crate::command::Run;
use crate::groups::Extent;
use crate::workspace;

/// How much is tried, and where the figures go.
#[derive(Args)]
pub(crate) struct Security {
    /// Tries some of everything.
    #[arg(long)]
    quick: bool,
    /// Also writes the figures here.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// The command: the table, and success only if no attack came to anything.
pub(crate) fn run(options: &Security) -> Result<ExitCode> {
    let extent = if options.quick { Extent::Quick } else { Extent::Full };
    attack(extent, options.json.as_deref()).map(|()| ExitCode::SUCCESS)
}

/// The group.
pub(crate) fn check(extent: Extent) -> Result<()> {
    attack(extent, None)
}

fn attack(extent: Extent, json: Option<&Path>) -> Result<()> {
    let folder = workspace::root().join("target/security");
    std::fs::create_dir_all(&folder).context("cannot make a folder for figures")?;
    let simulator = folder.join("simulator.txt");
    std::fs::write(&simulator, simulated()?)?;
    let run =
        Run::cargo().args(["run", "--quiet", "--package", "cara-security", "--", "--simulator"]).args([&simulator]);
    let run = if extent == Extent::Quick { run.args(["--quick"]) } else { run };
    let run = match json {
        // The child runs in the project's root, wherever this command was started.
        Some(path) => run.args(["--json".as_ref(), std::path::absolute(path)?.as_os_str()]),
        None => run,
    };
    run.stream()
}

/// What the simulator's attackers print.
fn simulated() -> Result<String> {
    let test = ["test", "--quiet", "--package", "cara-sim", "--test", "security", "--", "--nocapture"];
    let (code, output) = Run::cargo().args(test).output()?;
    ensure!(code == Some(0), "attacks on the simulator: {output}");
    Ok(output)
}
