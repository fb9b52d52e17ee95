//! `cargo xtask paper`: each committed patch breaks what a row of `docs/paper.md` says, and the row's test fails.
//!
//! A patch is `tests/paper/NUMBER-what-is-broken.patch`. It is applied to a clone of the last commit under
//! `target/paper`, whose builds are kept from patch to patch. The test is the first one that the row names.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};

use super::programs::{self, Program};
use super::{TABLE, order, row};
use crate::command::Run;
use crate::workspace;

const PATCHES: &str = "tests/paper";

/// A change that breaks what a row says.
struct Patch {
    /// Of the row.
    number: String,
    /// Its file, relative to the root.
    file: PathBuf,
}

/// All patches, in the order of their numbers.
fn patches() -> Result<Vec<Patch>> {
    let files = workspace::files_with("patch")?.into_iter().filter(|file| file.starts_with(PATCHES));
    let mut patches: Vec<Patch> = files.filter_map(Patch::of).collect();
    patches.sort_by(|one, other| (order(&one.number), &one.file).cmp(&(order(&other.number), &other.file)));
    Ok(patches)
}

impl Patch {
    fn of(file: PathBuf) -> Option<Self> {
        let number = file.file_name()?.to_str()?.split_once('-')?.0.to_owned();
        Some(Self { number, file })
    }

    fn name(&self) -> String {
        self.file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    }
}

/// Lines around a change that must be there: of the two in a patch the further ones may have changed.
pub(crate) const CONTEXT: &str = "-C1";

/// Fewest rows that have a patch.
const LEAST: usize = 40;

/// Adds what keeps a patch from being tried; how many rows have one.
pub(super) fn problems(table: &str, wrong: &mut Vec<String>) -> Result<usize> {
    let patches = patches()?;
    let tests = tests(table);
    for patch in &patches {
        let file = patch.file.display();
        if !tests.contains_key(patch.number.as_str()) {
            wrong.push(format!("{file}: its row names no test"));
        }
        if let Err(why) = Run::new("git").args(["apply", "--check", CONTEXT]).args([&patch.file]).text() {
            wrong.push(format!("{file} does not apply: {why:#}"));
        }
    }
    let rows = patches.iter().map(|patch| &patch.number).collect::<BTreeSet<_>>().len();
    if rows < LEAST {
        wrong.push(format!("{rows} rows have a patch, {LEAST} must have one"));
    }
    Ok(rows)
}

/// For each row the test that fails when what the row says is broken.
fn tests(table: &str) -> BTreeMap<&str, &str> {
    table.lines().filter_map(row).filter_map(|row| Some((row.number, row.tests().next()?))).collect()
}

/// Applies the patches of these rows one at a time, all without a number, and requires that each is found.
pub(crate) fn run(numbers: &[String]) -> Result<ExitCode> {
    let mut patches = patches()?;
    patches.retain(|patch| numbers.is_empty() || numbers.contains(&patch.number));
    let table = workspace::read(Path::new(TABLE))?;
    let tests = tests(&table);
    let test = |patch: &Patch| tests.get(patch.number.as_str()).copied().context("its row names no test");
    let (start, tree) = (Instant::now(), Tree::new()?);
    // A test that always fails would find everything.
    let named: BTreeSet<&str> = patches.iter().filter_map(|patch| test(patch).ok()).collect();
    let sound: BTreeSet<&str> = named.into_iter().filter(|test| tree.passes_as_it_is(test)).collect();
    println!("{} tests pass without a patch, {:.0} s", sound.len(), start.elapsed().as_secs_f64());
    let mut found = 0;
    for patch in &patches {
        let start = Instant::now();
        let verdict = test(patch).and_then(|test| {
            ensure!(sound.contains(test), "its test does not pass without it");
            tree.finds(&patch.file, test)
        });
        let verdict = match verdict {
            Ok(test) => {
                found += 1;
                format!("found by {test}")
            }
            Err(why) => format!("NOT FOUND: {why:#}"),
        };
        println!("{:<60} {:>5.0} s  {verdict}", patch.name(), start.elapsed().as_secs_f64());
    }
    println!("{found} of {} found at {} in {:.0} s", patches.len(), tree.commit, start.elapsed().as_secs_f64());
    Ok(if found == patches.len() && found > 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// A clone of the last commit, with builds of its own.
pub(crate) struct Tree {
    pub(crate) root: PathBuf,
    pub(crate) commit: String,
}

impl Tree {
    pub(crate) fn new() -> Result<Self> {
        Self::at(workspace::root().join("target/paper/tree"))
    }

    pub(crate) fn at(root: PathBuf) -> Result<Self> {
        if !root.join(".git").exists() {
            let clone = Run::new("git").args(["clone", "--quiet", "--shared", "--no-checkout", "."]);
            clone.args([root.as_os_str()]).text()?;
        }
        let tree = Self { root, commit: Run::new("git").args(["rev-parse", "--short", "HEAD"]).text()?.trim().into() };
        tree.git(&["fetch", "--quiet", "origin", "HEAD"])?;
        tree.git(&["reset", "--quiet", "--hard", "FETCH_HEAD"])?;
        Ok(tree)
    }

    pub(crate) fn apply(&self, patch: &Path) -> Result<()> {
        let file = workspace::root().join(patch);
        self.git(&["apply", CONTEXT, &file.to_string_lossy()]).map(drop)
    }

    /// Undoes what was applied.
    pub(crate) fn reset(&self) -> Result<()> {
        self.git(&["reset", "--quiet", "--hard"]).map(drop)
    }

    fn git(&self, arguments: &[&str]) -> Result<String> {
        Run::new("git").within(&self.root).args(arguments).text()
    }

    pub(crate) fn passes_as_it_is(&self, test: &str) -> bool {
        match self.passes(test) {
            Ok((_, passed)) => passed,
            Err(error) => {
                println!("{error:#}");
                false
            }
        }
    }

    /// The name of the test, if it fails with the patch, which is relative to the root.
    pub(crate) fn finds(&self, patch: &Path, test: &str) -> Result<String> {
        self.apply(patch)?;
        let ended = self.passes(test);
        self.reset()?;
        match ended? {
            (name, false) => Ok(name),
            (name, true) => bail!("{name} passes"),
        }
    }

    /// Name of the test that a row calls `test`, and whether it passes.
    fn passes(&self, test: &str) -> Result<(String, bool)> {
        let selection = programs::selection(&self.root, test)?;
        let selection: Vec<&str> = selection.iter().map(String::as_str).collect();
        let target = self.root.with_file_name("build");
        let cargo = Run::cargo().within(&self.root).env("CARGO_TARGET_DIR", &target.to_string_lossy());
        // Most of the time goes into compiling.
        let quick =
            [("CARGO_INCREMENTAL", "1"), ("CARGO_PROFILE_DEV_OPT_LEVEL", "0"), ("CARGO_PROFILE_DEV_DEBUG", "0")];
        let cargo = quick.iter().fold(cargo, |cargo, (name, value)| cargo.env(name, value));
        let programs = Program::build(cargo, &self.root, &selection)?;
        let found = programs.iter().find_map(|program| Some((program, program.test(test)?)));
        let (program, name) = found.with_context(|| format!("{test} is no test"))?;
        Ok((name.to_owned(), program.passes(name)?))
    }
}
