//! `cargo xtask orders`: fleets drawn from many seeds, in which nothing may move that is not wanted and each vehicle has a manager
//! soon; and the same with bugs that are planted on purpose, each of which a normal run must find. A command of its own, for each
//! bug is a build.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Result, ensure};
use clap::Args;

use crate::command::Run;
use crate::paper::broken::{CONTEXT, Tree};
use crate::{paper, workspace};

/// How to run them.
#[derive(Args)]
pub(crate) struct Orders {
    /// Seeds of the fleet of 5 vehicles.
    #[arg(long, default_value_t = 10_000)]
    seeds: u32,
    /// Seeds of the fleet of 200.
    #[arg(long, default_value_t = 100)]
    large: u32,
    /// Plants the bugs of `tests/sim/planted` and `tests/planted` in a clone of the last commit instead, one at a time.
    #[arg(long)]
    planted: bool,
}

/// Those of the first are found by the fleets, each of the second by the test that it names.
const PATCHES: [&str; 2] = ["tests/sim/planted", "tests/planted"];
/// Before the test that finds a bug, in the first line of its patch; behind a scenario stands ` on PORT`.
const FOUND_BY: &str = "Found by ";
const ON: &str = " on ";
/// Fewest bugs that are planted.
const LEAST: usize = 24;
const SMALL: &str = "tests/sim/tests/orders/main.rs::five_vehicles_move_only_as_they_are_wanted";

pub(crate) fn run(orders: &Orders) -> Result<ExitCode> {
    if orders.planted {
        return planted();
    }
    let tests = [
        ("orders", "five_vehicles", orders.seeds),
        ("orders", "many_vehicles", orders.large),
        ("standby", "each_vehicle_has_a_manager_soon", orders.seeds),
        ("standby", "two_hundred_vehicles", orders.large),
        ("handed", "a_vehicle_that_is_handed_over", orders.seeds.div_ceil(10)),
    ];
    for (program, test, seeds) in tests {
        let start = Instant::now();
        let cargo =
            Run::cargo().args(["test", "--quiet", "--release", "--package", "cara-sim", "--test", program, test]);
        let cargo = cargo.args(["--", "--nocapture", "--include-ignored"]);
        cargo.env("CARA_SIM_SEEDS", &seeds.to_string()).stream()?;
        println!("{seeds} seeds in {:.0} s", start.elapsed().as_secs_f64());
    }
    Ok(ExitCode::SUCCESS)
}

fn patches() -> Result<Vec<PathBuf>> {
    let mut patches = workspace::files_with("patch")?;
    patches.retain(|file| PATCHES.iter().any(|folder| file.starts_with(folder)));
    patches.sort();
    Ok(patches)
}

/// The test that is to find a bug, as its patch says.
fn finder(patch: &Path) -> Result<String> {
    let text = workspace::read(patch)?;
    Ok(text.lines().next().and_then(|line| line.strip_prefix(FOUND_BY)).unwrap_or(SMALL).to_owned())
}

/// A scenario on a port is a test of that port's program.
fn of_port(test: &str) -> String {
    let scenario = test.split_once(ON).and_then(|(rule, port)| Some((rule.split_once("::")?.1, port)));
    scenario.map_or_else(|| test.to_owned(), |(name, port)| format!("tests/scenarios/tests/{port}.rs::{name}"))
}

/// Fails where a patch does not apply, its test is not there, or too few are there.
pub(crate) fn check() -> Result<()> {
    let patches = patches()?;
    for patch in &patches {
        Run::new("git").args(["apply", "--check", CONTEXT]).args([patch]).text()?;
        let test = finder(patch)?;
        let rule = test.split_once(ON).map_or(test.as_str(), |(rule, _)| rule);
        let read = |path: &str| workspace::read(Path::new(path)).unwrap_or_default();
        let missing = paper::broken(rule, |path| workspace::root().join(path).exists(), read);
        ensure!(missing.is_none(), "{}: {}", patch.display(), missing.unwrap_or_default());
    }
    ensure!(patches.len() >= LEAST, "{} bugs are there, {LEAST} are to be planted", patches.len());
    println!("{} bugs of orders to plant, each applies", patches.len());
    Ok(())
}

fn planted() -> Result<ExitCode> {
    let (start, tree, patches) = (Instant::now(), Tree::new()?, patches()?);
    let tests = patches.iter().map(|patch| finder(patch)).collect::<Result<Vec<_>>>()?;
    for test in tests.iter().collect::<BTreeSet<_>>() {
        ensure!(tree.passes_as_it_is(&of_port(test)), "{test} does not pass without a bug");
    }
    let mut found = 0;
    for (patch, test) in patches.iter().zip(&tests) {
        let verdict = tree.finds(patch, &of_port(test));
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

#[cfg(test)]
mod tests {
    use super::of_port;

    #[test]
    fn a_scenario_is_a_test_of_the_program_of_its_port() {
        let scenario = of_port("tests/scenarios/src/rules/turns.rs::a_rule on embassy");
        assert_eq!(scenario, "tests/scenarios/tests/embassy.rs::a_rule");
        assert_eq!(of_port("core/src/time.rs::a_rule"), "core/src/time.rs::a_rule");
    }
}
