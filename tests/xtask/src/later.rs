//! Units of this version beside units of a later one, and of earlier ones.
//!
//! A build with the patch `a-later-version` speaks one version more and says what this one does not know wherever the wire format
//! has room for it: items, capabilities, suites, frames, session bodies, flags, and longer headers and bodies of every kind.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};

use crate::command::Run;
use crate::groups::Outcome;
use crate::{binaries, demo, firmware, install, planted, upgrade, workspace};

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

/// The demonstration, a fleet in motion, an emulated board and gateways beside builds of earlier revisions: the tags `wire-N` and `v*`, or else the last commit
/// of the day before this one's.
pub(crate) fn versions(revisions: &[String]) -> Result<()> {
    let tags = Run::new("git").args(["tag", "--list", "wire-*", "v*"]).text()?;
    let mut revisions: Vec<String> = match revisions {
        [] => tags.lines().map(str::to_owned).collect(),
        revisions => revisions.to_vec(),
    };
    if revisions.is_empty() {
        let today = Run::new("git").args(["log", "-1", "--format=%cd", "--date=short"]).text()?;
        let before = format!("--before={}T00:00:00Z", today.trim());
        revisions.push(Run::new("git").args(["rev-list", "-1", &before, "HEAD"]).text()?.trim().to_owned());
    }
    binaries::build(&demo::PROGRAMS)?;
    for revision in &revisions {
        let theirs = build_of(revision)?;
        both_ways(&theirs, revision)?;
        println!("== a fleet of {revision} becomes one of this version, and goes back");
        upgrade::there_and_back(&theirs, &workspace::target().join("debug"))?;
        let sources = theirs.with_file_name("tree");
        println!("== an emulated board of {revision} and a manager of this version, and the other way round");
        match firmware::beside(&sources, &theirs) {
            Outcome::Passed => {}
            Outcome::Skipped(why) => println!("skipped: {why}"),
            Outcome::Failed(why) => bail!("{why}"),
        }
        println!(
            "== gateways of {revision} and of this version in turn, with a vehicle of this version, then of {revision}"
        );
        gateways(&sources)?;
    }
    Ok(())
}

/// Builds a revision; the folder of its programs.
fn build_of(revision: &str) -> Result<PathBuf> {
    let revision = format!("{revision}^{{commit}}");
    let commit = Run::new("git").args(["rev-parse", "--verify", "--short", &revision]).text()?;
    let folder = workspace::target().join("versions").join(commit.trim());
    let tree = folder.join("tree");
    if !tree.join(".git").exists() {
        let clone = Run::new("git").args(["clone", "--quiet", "--shared", "--no-checkout", "."]);
        clone.args([tree.as_os_str()]).text()?;
    }
    Run::new("git").within(&tree).args(["checkout", "--quiet", "--detach", commit.trim()]).text()?;
    let programs = [&demo::PROGRAMS[..], &["cara-firmware-tests"]].concat();
    binaries::of_another_tree(binaries::debug_build(&programs), &folder)?.stream()?;
    Ok(folder.join("debug"))
}

/// The gateway is killed under way and started again as the other version, ten times, with a vehicle of either.
fn gateways(sources: &Path) -> Result<()> {
    /// The test that kills it.
    const TEST: &str = "connection_ends_online_after_each_fail_over";
    install::program("mosquitto", "mosquitto").map_err(anyhow::Error::msg)?;
    let cargo = |command| {
        let place = ["--quiet", "--locked", "--manifest-path", "gateways/vda5050/Cargo.toml", "--target-dir"];
        Run::cargo().args([command]).args(place)
    };
    let theirs = sources.with_file_name("vda5050");
    let programs = ["--bins", "--example", "vehicle"];
    cargo("build").within(sources).args([&theirs]).args(programs).stream()?;
    cargo("build").args(["target/vda5050"]).args(programs).stream()?;
    let test = || cargo("test").args(["target/vda5050", "--test", "broker", TEST, "--", "--nocapture"]);
    let of_theirs = |program: &str| theirs.join("debug").join(program).to_string_lossy().into_owned();
    let gateway = of_theirs("cara-vda5050");
    test().env("CARA_TEST_OTHER_GATEWAY", &gateway).stream()?;
    let vehicle = of_theirs("examples/vehicle");
    test().env("CARA_TEST_OTHER_GATEWAY", &gateway).env("CARA_TEST_OTHER_VEHICLE", &vehicle).stream()
}

fn both_ways(theirs: &Path, name: &str) -> Result<()> {
    let ours = workspace::target().join("debug");
    println!("== a manager of this version, and AGVs of {name}");
    demo::between(&ours, theirs)?;
    println!("== a manager of {name}, and AGVs of this version");
    demo::between(theirs, &ours)
}
