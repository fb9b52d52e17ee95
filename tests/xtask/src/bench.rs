//! `cargo xtask bench`: the paper's experiments, in a release build.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};

use anyhow::{Context, Result};
use cara_processes::files;

use crate::command::Run;
use crate::workspace;

/// What is asked of the experiments.
#[derive(clap::Args)]
pub(crate) struct Options {
    /// Every kind of row within 4 minutes: fewer calls, and the slowest cells left out.
    #[arg(long)]
    quick: bool,
    /// The passive node prints in every cell of the response time, not only in some.
    #[arg(long)]
    print: bool,
    /// Only these other systems instead of all that `cargo xtask peers` has built; `none` for none.
    #[arg(long, value_name = "PEER", value_delimiter = ',')]
    peers: Vec<String>,
    /// Also writes all rows here, again after each experiment.
    #[arg(long, value_name = "FILE")]
    json: Option<std::path::PathBuf>,
    /// Keeps the complete experiments of this file, which an earlier run of the same commit and form wrote on this
    /// machine, and makes the others.
    #[arg(long, value_name = "FILE")]
    resume: Option<std::path::PathBuf>,
    /// So many turns of each cell of the response time instead of the usual.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    rounds: Option<u32>,
    /// Draws the paper's figures 6, 7 and 8 and the ratios here, as SVG.
    #[arg(long, value_name = "DIR")]
    plots: Option<std::path::PathBuf>,
    /// Makes the tables of this page anew, `docs/performance.md`.
    #[arg(long, value_name = "FILE")]
    page: Option<std::path::PathBuf>,
    /// Further options of `cara-bench experiments`, such as `--only response --chars 100`.
    #[arg(last = true)]
    more: Vec<String>,
}

/// Builds the program and becomes it, so that Ctrl-C reaches it alone and it can write what it has.
pub(crate) fn run(options: &Options) -> Result<ExitCode> {
    options.json.as_deref().map_or(Ok(()), files::can_write)?;
    options.plots.as_deref().map_or(Ok(()), files::can_write_in)?;
    Run::cargo().args(["build", "--release", "--quiet", "--package", "cara-bench"]).stream()?;
    let program = workspace::target().join("release").join("cara-bench");
    let mut command = Command::new(&program);
    command.arg("experiments").args(options.quick.then_some("--quick")).args(options.print.then_some("--print"));
    if !options.peers.is_empty() {
        command.arg("--peers").arg(options.peers.join(","));
    }
    command.args(options.rounds.iter().flat_map(|rounds| ["--rounds".to_owned(), rounds.to_string()]));
    let paths = [&options.json, &options.resume, &options.plots, &options.page];
    for (name, path) in ["--json", "--resume", "--plots", "--page"].into_iter().zip(paths) {
        if let Some(path) = path {
            // The program runs in the project's root, wherever this command was started.
            command.arg(name).arg(absolute(path)?);
        }
    }
    command.args(&options.more).current_dir(workspace::root());
    Err(command.exec()).with_context(|| format!("cannot start {}", program.display()))
}

fn absolute(path: &Path) -> Result<std::path::PathBuf> {
    std::path::absolute(path).with_context(|| format!("{} is no path", path.display()))
}
