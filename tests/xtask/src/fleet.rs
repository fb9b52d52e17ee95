//! `cargo xtask fleet`: a manager with many nodes, measured in a release build.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;
use cara_processes::files;

use crate::binaries;
use crate::command::Run;
use crate::groups::Extent;

/// Turns of the comparison of costs where it is one check among many.
const CHECKED_ROUNDS: &str = "5";

/// All figures, for as many nodes as are asked for.
pub(crate) fn run(nodes: Option<u16>, processes: Option<u16>, json: Option<&Path>) -> Result<ExitCode> {
    json.map_or(Ok(()), files::can_write)?;
    let mut run = measured()?;
    for (option, number) in [("--nodes", nodes), ("--processes", processes)] {
        if let Some(number) = number {
            run = run.args([option, &number.to_string()]);
        }
    }
    let run = match json {
        // The child runs in the project's root, wherever this command was started.
        Some(path) => run.args(["--json".as_ref(), std::path::absolute(path)?.as_os_str()]),
        None => run,
    };
    run.stream()?;
    Ok(ExitCode::SUCCESS)
}

/// The group: whether a bound is broken.
pub(crate) fn check(extent: Extent) -> Result<()> {
    let nodes = if extent == Extent::Full { "1000" } else { "500" };
    measured()?.args(["--nodes", nodes, "--rounds", CHECKED_ROUNDS]).stream()
}

fn measured() -> Result<Run> {
    binaries::release("cara-fleet")
}
