//! `cargo xtask fuzz`: libFuzzer over the targets of `tests/fuzz`. Its state is the inputs in `target/fuzz/inputs`: a run that is
//! stopped goes on from them. With `--planted` bugs that are planted on purpose have to be found, each from no input at all.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;

use crate::command::Run;
use crate::paper::broken::Tree;
use crate::workspace;

/// How to run them.
#[derive(Args)]
pub(crate) struct Fuzz {
    /// A target; `all` for each.
    #[arg(value_name = "TARGET", default_value = "all")]
    target: String,
    /// Inputs to run for each target.
    #[arg(long, value_name = "N", default_value_t = 1_000_000, conflicts_with = "time")]
    runs: u64,
    /// How long to run each target instead, as in 90s, 10m or 2h.
    #[arg(long = "for", value_name = "TIME", value_parser = time)]
    time: Option<Duration>,
    /// Writes the fewest inputs that reach all that was reached to the target's `corpus`, from where tests replay them.
    #[arg(long)]
    write: bool,
    /// Plants the bugs of `tests/fuzz/planted` in a clone of the last commit, one at a time; each has to be found in N runs.
    #[arg(long, conflicts_with_all = ["time", "write"])]
    planted: bool,
}

/// Where targets are, in `src/lib.rs`, and what was found with them, in `corpus` and `crashes`.
const FOLDERS: [&str; 2] = ["tests/fuzz", "tests/fuzz/page"];
const PLANTED: &str = "tests/fuzz/planted";
const TRIPLE: &str = "x86_64-unknown-linux-gnu";

/// What libFuzzer says of a run.
#[derive(Debug, Default, PartialEq, Eq)]
struct Told {
    executions: u64,
    coverage: u64,
    /// The input that made the target panic, and what it said.
    crash: Option<(String, String)>,
}

/// A time on the command line.
pub(crate) fn time(text: &str) -> Result<Duration> {
    let (number, unit) = text.split_at(text.len().saturating_sub(1));
    let seconds = match unit {
        "s" => 1,
        "m" => 60,
        "h" => 3_600,
        _ => bail!("a time is a number and s, m or h"),
    };
    Ok(Duration::from_secs(number.parse::<u64>()?.saturating_mul(seconds)))
}

/// What is known of a target here.
#[derive(Debug, PartialEq, Eq)]
struct Target {
    /// The length of its longest input.
    longest: String,
    folder: &'static str,
}

/// The targets by name.
fn targets() -> Result<BTreeMap<String, Target>> {
    let mut targets = BTreeMap::new();
    for folder in FOLDERS {
        let text = workspace::read(&Path::new(folder).join("src/lib.rs"))?;
        let rows = text.lines().filter_map(|line| Some(line.split_once("Target { name: \"")?.1));
        targets.extend(rows.filter_map(|row| {
            let (name, rest) = row.split_once('"')?;
            let longest = rest.split_once("longest: ")?.1.split_once(' ')?.0.to_owned();
            Some((name.to_owned(), Target { longest, folder }))
        }));
    }
    Ok(targets)
}

pub(crate) fn run(fuzz: &Fuzz) -> Result<ExitCode> {
    let mut targets = targets()?;
    targets.retain(|name, _| fuzz.target == "all" || fuzz.target == *name);
    ensure!(!targets.is_empty(), "{} is no target: see src/lib.rs in {}", fuzz.target, FOLDERS.join(" and "));
    if fuzz.planted {
        return planted(fuzz, &targets);
    }
    let program = build(workspace::root(), &workspace::target().join("fuzz"))?;
    let mut crashes = 0;
    for (name, Target { longest, folder: home }) in &targets {
        let corpus = workspace::root().join(home).join("corpus").join(name).with_extension("inputs");
        let folder = workspace::target().join("fuzz/inputs").join(name);
        unpack(&corpus, &folder)?;
        let limit = match fuzz.time {
            Some(time) => format!("-max_total_time={}", time.as_secs()),
            None => format!("-runs={}", fuzz.runs),
        };
        let start = Instant::now();
        let told = drive(&program, name, longest, &limit, &folder)?;
        let took = start.elapsed().as_secs_f64();
        println!("{name:<10} {:>9} executions in {took:.0} s, {} edges covered", told.executions, told.coverage);
        if let Some((input, why)) = &told.crash {
            crashes += 1;
            println!("{name:<10} CRASHED: {why}\n{input}: mend it, and move it to {home}/crashes/{name}-WHAT");
        } else if fuzz.write {
            let (count, bytes) = pack(&program, name, &folder, &corpus)?;
            println!("{name:<10} {count} inputs in {bytes} bytes");
        }
    }
    Ok(if crashes == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Builds the program, with the project's crates instrumented.
fn build(root: &Path, target: &Path) -> Result<PathBuf> {
    let wrapper = root.join("tests/fuzz/libfuzzer/instrument.sh");
    let manifest = root.join("tests/fuzz/libfuzzer/Cargo.toml");
    let cargo = Run::cargo().within(root).env("RUSTC_WRAPPER", &wrapper.to_string_lossy());
    // Code that is built in pieces runs slower.
    let cargo = cargo.env("CARGO_INCREMENTAL", "0");
    let cargo = cargo.args(["build", "--quiet", "--locked", "--release", "--target", TRIPLE, "--manifest-path"]);
    cargo.args([&manifest]).args([Path::new("--target-dir"), target]).stream()?;
    Ok(target.join(TRIPLE).join("release/cara-libfuzzer"))
}

fn drive(program: &Path, name: &str, longest: &str, limit: &str, folder: &Path) -> Result<Told> {
    fs::create_dir_all(folder)?;
    let artifacts = format!("-artifact_prefix={}-", folder.display());
    let longest = format!("-max_len={longest}");
    let arguments = [&longest, "-len_control=30", "-timeout=60", "-print_final_stats=1", &artifacts, limit];
    let libfuzzer = Run::new(&program.to_string_lossy()).env("CARA_FUZZ_TARGET", name).env("RUST_BACKTRACE", "0");
    let output = libfuzzer.args(arguments).args([folder]).merged(|line| {
        if line.contains("\tpulse") {
            print!("{name:<10} {line}");
        }
    })?;
    told(&output).with_context(|| output.lines().rev().take(20).collect::<Vec<_>>().join("\n"))
}

fn told(output: &str) -> Option<Told> {
    let number = |text: &str| text.split_whitespace().next()?.parse::<u64>().ok();
    let coverage = output.lines().filter_map(|line| number(line.split_once(" cov: ")?.1)).next_back()?;
    let status = output.lines().filter_map(|line| number(line.strip_prefix('#')?)).next_back()?;
    let total = output.lines().find_map(|line| number(line.strip_prefix("stat::number_of_executed_units:")?));
    let input = output.lines().find_map(|line| line.split_once("Test unit written to "));
    let mut lines = output.lines().skip_while(|line| !line.contains(" panicked at "));
    let why = lines.next().zip(lines.next()).map_or("no panic", |(_, why)| why);
    let crash = input.map(|(_, input)| (input.to_owned(), why.to_owned()));
    Some(Told { executions: total.unwrap_or(status), coverage, crash })
}

/// The inputs of a committed file, each behind its length in two bytes.
fn inputs(mut file: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (length, rest) = file.split_first_chunk()?;
        let (input, rest) = rest.split_at_checked(u16::from_le_bytes(*length).into())?;
        file = rest;
        Some(input)
    })
}

/// Puts the committed inputs into a folder.
fn unpack(corpus: &Path, folder: &Path) -> Result<()> {
    fs::create_dir_all(folder)?;
    let file = fs::read(corpus).unwrap_or_default();
    for (number, input) in inputs(&file).enumerate() {
        fs::write(folder.join(format!("committed-{number}")), input)?;
    }
    Ok(())
}

/// Commits the fewest inputs that cover what those in a folder do; how many, and their bytes.
fn pack(program: &Path, name: &str, folder: &Path, corpus: &Path) -> Result<(usize, usize)> {
    let few = folder.with_extension("few");
    let _ = fs::remove_dir_all(&few);
    fs::create_dir_all(&few)?;
    let libfuzzer = Run::new(&program.to_string_lossy()).env("CARA_FUZZ_TARGET", name);
    let merged = libfuzzer.args(["-set_cover_merge=1", "-use_counters=0"]).args([&few, folder]).captured()?;
    ensure!(merged.0, "{}", merged.2);
    let mut packed = Vec::new();
    let mut files = fs::read_dir(&few)?.map(|file| Ok(file?.path())).collect::<Result<Vec<_>>>()?;
    files.sort();
    for file in &files {
        let input = fs::read(file)?;
        packed.extend_from_slice(&u16::try_from(input.len())?.to_le_bytes());
        packed.extend_from_slice(&input);
    }
    fs::create_dir_all(corpus.parent().unwrap_or(corpus))?;
    fs::write(corpus, &packed)?;
    fs::remove_dir_all(&few)?;
    Ok((files.len(), packed.len()))
}

/// A patch is `tests/fuzz/planted/TARGET-what-is-broken.patch`.
fn planted(fuzz: &Fuzz, targets: &BTreeMap<String, Target>) -> Result<ExitCode> {
    let place = workspace::target().join("fuzz/planted");
    let tree = Tree::at(place.join("tree"))?;
    let (mut found, mut tried) = (0, 0);
    for patch in workspace::files_with("patch")?.iter().filter(|file| file.starts_with(PLANTED)) {
        let name = patch.file_stem().unwrap_or_default().to_string_lossy();
        let target = name.split('-').next().unwrap_or_default();
        let Some(Target { longest, .. }) = targets.get(target) else { continue };
        tried += 1;
        let folder = place.join("inputs");
        let _ = fs::remove_dir_all(&folder);
        tree.apply(patch)?;
        let program = build(&tree.root, &place.join("build"));
        tree.reset()?;
        let (start, limit) = (Instant::now(), format!("-runs={}", fuzz.runs));
        let told = drive(&program?, target, longest, &limit, &folder)?;
        let took = start.elapsed().as_secs_f64();
        match &told.crash {
            Some((_, why)) => {
                found += 1;
                println!("{name:<60} found after {} executions, {took:.0} s: {why}", told.executions);
            }
            None => println!("{name:<60} NOT FOUND in {} executions, {took:.0} s", told.executions),
        }
    }
    println!("{found} of {tried} found at {}", tree.commit);
    ensure!(tried > 0, "no bug is planted for {}: see {PLANTED}", fuzz.target);
    ensure!(found == tried, "not all were found");
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::time::Duration;

    use super::{FOLDERS, Target, Told, inputs, targets, time, told};
    use crate::workspace;

    #[test]
    fn the_targets_are_read_from_their_table() {
        let targets = targets().unwrap();
        let known = |name, longest: &str, folder| {
            assert_eq!(targets.get(name), Some(&Target { longest: longest.to_owned(), folder }), "{name}");
        };
        known("session", "200", "tests/fuzz");
        known("page", "300", "tests/fuzz/page");
        let texts = FOLDERS.map(|folder| workspace::read(&Path::new(folder).join("src/lib.rs")).unwrap());
        assert_eq!(targets.len(), texts.concat().matches("Target { name: ").count());
    }

    #[test]
    fn what_libfuzzer_says_is_understood() {
        let good =
            "#2\tINITED cov: 5 ft: 6\n#900\tDONE   cov: 17 ft: 6 corp: 2/2b\nstat::number_of_executed_units: 901\n";
        assert_eq!(told(good), Some(Told { executions: 901, coverage: 17, crash: None }));
        let bad = "#7\tNEW    cov: 9 ft\nthread '<unnamed>' (1) panicked at a.rs:1:1:\na motor moves\n\
                   artifact_prefix='x'; Test unit written to x/crash-1\n";
        let crash = Some(("x/crash-1".to_owned(), "a motor moves".to_owned()));
        assert_eq!(told(bad), Some(Told { executions: 7, coverage: 9, crash }));
        assert_eq!(told("no such program"), None);
    }

    #[test]
    fn a_packed_file_is_its_inputs() {
        assert_eq!(inputs(&[1, 0, 7, 0, 0, 2, 0, 8, 9]).collect::<Vec<_>>(), [&[7][..], &[], &[8, 9]]);
        assert_eq!(inputs(&[3, 0, 7]).count(), 0);
    }

    #[test]
    fn a_time_has_a_unit() {
        assert_eq!(time("10m").unwrap(), Duration::from_secs(600));
        assert!(time("10").is_err() && time("").is_err() && time("xs").is_err());
    }
}
