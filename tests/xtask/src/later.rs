//! Units of this version beside units of a later one, and of earlier ones.
//!
//! A build with the patch `a-later-version` speaks one version more and says what this one does not know wherever the wire format
//! has room for it: items, capabilities, suites, frames, session bodies, flags, and longer headers and bodies of every kind.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::command::Run;
use crate::{binaries, demo, planted, workspace};

const LATER: &str = "a-later-version";

/// Every scenario between later units, and the demonstration between both versions, either way round.
pub(crate) fn check() -> Result<()> {
    binaries::build(&demo::PROGRAMS)?;
    let builds = [&demo::PROGRAMS[..], &["seeds"]].concat();
    binaries::changed(binaries::debug_build(&builds), LATER)?.stream()?;
    let later = binaries::changed_folder(LATER).join("debug");
    let seeds = later.join("seeds");
    // That so few seeds reach all that a scenario is to reach is not asked here.
    let (_, output, errors) = Run::new(&seeds.to_string_lossy()).args(["--seeds", "50"]).captured()?;
    let failed = planted::failed(&output);
    ensure!(failed.is_empty(), "between later units {} fail: {output}{errors}", failed.join(", "));
    for counted in [", items skipped ", "datagram items skipped "] {
        ensure!(output.contains(counted), "nothing was passed over as {counted:?}: {output}");
    }
    both_ways(&later, "a later one")
}

/// The demonstration beside builds of earlier revisions. Each version of the wire format that units in use may speak has a
/// tag, `wire-N`.
pub(crate) fn versions(revisions: &[String]) -> Result<()> {
    let tags = Run::new("git").args(["tag", "--list", "wire-*"]).text()?;
    let revisions: Vec<&str> = match revisions {
        [] => tags.lines().collect(),
        revisions => revisions.iter().map(String::as_str).collect(),
    };
    ensure!(!revisions.is_empty(), "there is no tag wire-N here: name a revision");
    binaries::build(&demo::PROGRAMS)?;
    for revision in revisions {
        let commit =
            Run::new("git").args(["rev-parse", "--verify", "--short", &format!("{revision}^{{commit}}")]).text()?;
        let folder = workspace::target().join("versions").join(commit.trim());
        let (tree, build) = (folder.join("tree"), folder.join("build"));
        if !tree.join(".git").exists() {
            let clone = Run::new("git").args(["clone", "--quiet", "--shared", "--no-checkout", "."]);
            clone.args([tree.as_os_str()]).text()?;
        }
        Run::new("git").within(&tree).args(["checkout", "--quiet", "--detach", commit.trim()]).text()?;
        let cargo = binaries::debug_build(&demo::PROGRAMS).within(&tree);
        cargo.env("CARGO_TARGET_DIR", &build.to_string_lossy()).stream()?;
        both_ways(&build.join("debug"), revision)?;
    }
    Ok(())
}

fn both_ways(theirs: &Path, name: &str) -> Result<()> {
    let ours = workspace::target().join("debug");
    println!("== a manager of this version, and AGVs of {name}");
    demo::between(&ours, theirs)?;
    println!("== a manager of {name}, and AGVs of this version");
    demo::between(theirs, &ours)
}
