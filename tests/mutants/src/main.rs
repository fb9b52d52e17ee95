//! Tries the mutants that cargo-mutants lists. A build for each would take minutes on a small machine, so all of them are written
//! into the sources of a clone, and the environment says which one is active: one build, and one run of the tests for each.
//!
//! `cara-mutants TREE LIST STATE EQUIVALENT I/N`: `TREE` is the clone, `STATE` a file that lets a stopped run go on.

mod build;
mod mutant;
mod rewrite;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::{Context, Result, bail, ensure};

use crate::build::Programs;
use crate::mutant::{Mutant, State};

/// In the state, before the name of a function that is needed in constants.
const CONSTANT: &str = "constant";
/// Kept in the core of the clone.
const CHOOSES: &str = r#"
/// Which mutant is active.
pub mod mutant {
    /// Whether this one is.
    pub fn on(number: u32) -> bool {
        static CHOSEN: std::sync::LazyLock<u32> = std::sync::LazyLock::new(|| {
            std::env::var("CARA_MUTANT").ok().and_then(|number| number.parse().ok()).unwrap_or(u32::MAX)
        });
        *CHOSEN == number
    }
}
"#;

fn main() -> Result<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [tree, list, state, equivalent, shard] = &arguments[..] else { bail!("TREE LIST STATE EQUIVALENT I/N") };
    let (tree, state) = (Path::new(tree), Path::new(state));
    let (index, shards) = shard.split_once('/').context("a shard is I/N")?;
    let (index, shards): (usize, usize) = (index.parse()?, shards.parse()?);
    ensure!(index < shards, "shards are numbered from 0");
    let mut mutants = mutant::list(Path::new(list))?;
    let files: BTreeSet<String> = mutants.iter().map(|mutant| mutant.file.clone()).collect();
    let sources = files.into_iter().map(|file| Ok((committed(tree, &file)?, file)));
    let sources: BTreeMap<String, String> =
        sources.map(|pair| pair.map(|(text, file)| (file, text))).collect::<Result<_>>()?;
    let blob = |file: &String| {
        Ok((file.clone(), git(tree, &["rev-parse", "--short", &format!("HEAD:{file}")])?.trim().to_owned()))
    };
    let blobs = sources.keys().map(blob).collect::<Result<BTreeMap<_, _>>>()?;
    let known = known(state, &blobs)?;
    // Other sources and tests may judge it otherwise.
    let survived = format!("{}-{}", State::Survived.name(), git(tree, &["rev-parse", "--short", "HEAD"])?.trim());
    for mutant in mutants.iter_mut().filter(|mutant| known.contains(&(State::Unviable.name(), mutant.name.clone()))) {
        mutant.state = State::Unviable;
    }
    // Written to the state as well, so that a run that goes on builds nothing anew.
    let constants = known.iter().filter(|(state, _)| state == CONSTANT);
    let mut keep_const = constants.filter_map(|(_, name)| Some(name.rsplit_once(": ")?.1.to_owned())).collect();
    let mut programs = build_all(tree, &sources, &mut mutants, &mut keep_const)?;
    let equivalent = equivalents(Path::new(equivalent))?;
    let mut log = fs::OpenOptions::new().create(true).append(true).open(state)?;
    let mut note = |state: &str, file: &str, name: &str| writeln!(log, "{} {state} {name}", blobs[file]);
    let is_new = |mutant: &&Mutant| !known.contains(&(mutant.state.name(), mutant.name.clone()));
    for mutant in mutants.iter().filter(|mutant| mutant.state == State::Unviable).filter(is_new) {
        note(&mutant.state.name(), &mutant.file, &mutant.name)?;
    }
    if let Some(file) = sources.keys().next().filter(|_| known.iter().all(|(state, _)| state != CONSTANT)) {
        keep_const.iter().try_for_each(|name| note(CONSTANT, file, &format!("{file}: {name}")))?;
    }
    for (number, mutant) in mutants.iter_mut().enumerate() {
        if mutant.state != State::Wanted || number % shards != index {
            continue;
        }
        mutant.state = State::Killed;
        if known.contains(&(State::Killed.name(), mutant.name.clone())) {
            continue;
        }
        let has_survived = known.contains(&(survived.clone(), mutant.name.clone()));
        match if has_survived { None } else { programs.kills(number)? } {
            Some(by) => {
                println!("killed    {}: {by}", mutant.name);
                note(&mutant.state.name(), &mutant.file, &mutant.name)?;
            }
            None => {
                mutant.state = if equivalent.contains(&mutant.name) { State::Equivalent } else { State::Survived };
                println!("{:<9} {} at line {}", mutant.state.name(), mutant.name, mutant.line);
                if !has_survived {
                    note(&survived, &mutant.file, &mutant.name)?;
                }
            }
        }
    }
    mutants.iter_mut().filter(|mutant| mutant.state == State::Wanted).for_each(|mutant| mutant.state = State::Untried);
    println!("\n| file | mutants | {} |", State::ALL.map(State::name).join(" | "));
    println!("|---|{}", "---|".repeat(State::ALL.len() + 1));
    for file in sources.keys() {
        let count = |state| mutants.iter().filter(|mutant| mutant.file == *file && mutant.state == state).count();
        let counts = State::ALL.map(count);
        println!(
            "| {file} | {} | {} |",
            counts.iter().sum::<usize>(),
            counts.map(|count| count.to_string()).join(" | ")
        );
    }
    let survives = mutants.iter().any(|mutant| mutant.state == State::Survived);
    Ok(if survives { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Builds all mutants that compile into the test programs.
fn build_all(
    tree: &Path,
    sources: &BTreeMap<String, String>,
    mutants: &mut [Mutant],
    keep_const: &mut BTreeSet<String>,
) -> Result<Programs> {
    let library = "core/src/lib.rs";
    let text = committed(tree, library)?;
    // The core knows `std` in its tests only.
    let std = if text.contains("\nextern crate std;") {
        text.replace("#[cfg(test)]\nextern crate std;", "extern crate std;")
    } else {
        format!("{text}\nextern crate std;")
    };
    write(&tree.join(library), &format!("{std}{CHOOSES}"))?;
    loop {
        let mut places = BTreeMap::new();
        for (file, source) in sources {
            let rewritten = rewrite::rewrite(file, source, mutants, keep_const)?;
            write(&tree.join(file), &rewritten.text)?;
            places.insert(file.clone(), rewritten.places);
        }
        let wrong = match build::build(tree)? {
            Ok(programs) => return Ok(programs),
            Err(wrong) => wrong,
        };
        let mut news = false;
        for error in &wrong {
            news |= error.constant.as_ref().is_some_and(|name| keep_const.insert(name.clone()));
            let within =
                |range: &std::ops::Range<usize>| range.start <= error.place.start && error.place.end <= range.end;
            let touches =
                |range: &std::ops::Range<usize>| range.start < error.place.end && error.place.start < range.end;
            let places = places.get(&error.file).map(Vec::as_slice).unwrap_or_default();
            // An error may reach over both ways of a condition; then all mutants in it are to blame.
            let blamed: Vec<_> = places.iter().filter(|(_, range)| within(range)).collect();
            let blamed = if blamed.is_empty() && error.constant.is_none() {
                places.iter().filter(|(_, range)| touches(range)).collect()
            } else {
                blamed
            };
            for (number, _) in blamed {
                news |= std::mem::replace(&mut mutants[*number].state, State::Unviable) == State::Wanted;
            }
        }
        let first = wrong.first().map(|error| error.text.as_str()).unwrap_or_default();
        ensure!(news, "the mutants do not build: {first}");
        println!("{} errors; without what caused them:", wrong.len());
    }
}

/// A file of the clone as it is committed.
fn committed(tree: &Path, file: &str) -> Result<String> {
    git(tree, &["show", &format!("HEAD:{file}")])
}

fn git(tree: &Path, arguments: &[&str]) -> Result<String> {
    let output = Command::new("git").current_dir(tree).args(arguments).output()?;
    ensure!(output.status.success(), "git {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

/// Writes a file unless it is so already: what has not changed is not built anew.
fn write(file: &Path, text: &str) -> Result<()> {
    if fs::read_to_string(file)? != text {
        fs::write(file, text)?;
    }
    Ok(())
}

/// What is known of mutants in files that have not changed since: a line `BLOB STATE NAME` each.
fn known(state: &Path, blobs: &BTreeMap<String, String>) -> Result<BTreeSet<(String, String)>> {
    let text = if state.exists() { fs::read_to_string(state)? } else { String::new() };
    let line = |line: &str| {
        let (blob, rest) = line.split_once(' ')?;
        let (state, name) = rest.split_once(' ')?;
        (blob == blobs.get(name.split_once(": ")?.0)?).then(|| (state.to_owned(), name.to_owned()))
    };
    Ok(text.lines().filter_map(line).collect())
}

/// Those that change nothing that anybody can see: a line `NAME | REASON` each.
fn equivalents(file: &Path) -> Result<BTreeSet<String>> {
    let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
    let lines = text.lines().filter(|line| !line.is_empty() && !line.starts_with('#'));
    let name = |line: &str| line.rsplit_once(" | ").map(|(name, _)| name.to_owned()).context("NAME | REASON");
    lines.map(name).collect()
}

/// The folder of a package in the clone.
fn folder(tree: &Path, package: &str) -> PathBuf {
    tree.join(match package {
        "cara-core" => "core",
        _ => "tests/sim",
    })
}
