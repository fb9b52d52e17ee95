//! Units of this version beside units of a later one.
//!
//! A build with the cfg `cara_later`, which nothing else sets, speaks one version more and says what this one does not know
//! wherever the wire format has room for it: items, capabilities, suites, frames, session bodies, flags, and longer headers
//! and bodies of every kind.

use std::path::PathBuf;

use anyhow::{Result, ensure};

use crate::command::Run;
use crate::{binaries, demo, planted, workspace};

/// Every scenario between later units, and the demonstration between both versions, either way round.
pub(crate) fn check() -> Result<()> {
    binaries::build(&demo::PROGRAMS)?;
    let builds = [&demo::PROGRAMS[..], &["seeds"]].concat();
    binaries::with_cfg(binaries::debug_build(&builds), &folder(), "cara_later")?.stream()?;
    let seeds = folder().join("debug/seeds");
    // That so few seeds reach all that a scenario is to reach is not asked here.
    let (_, output, errors) = Run::new(&seeds.to_string_lossy()).args(["--seeds", "50"]).captured()?;
    let failed = planted::failed(&output);
    ensure!(failed.is_empty(), "between later units {} fail: {output}{errors}", failed.join(", "));
    for counted in [", items skipped ", "datagram items skipped "] {
        ensure!(output.contains(counted), "nothing was passed over as {counted:?}: {output}");
    }
    let (ours, later) = (workspace::target().join("debug"), folder().join("debug"));
    println!("== a manager of this version, and AGVs of a later one");
    demo::between(&ours, &later)?;
    println!("== a manager of a later version, and AGVs of this one");
    demo::between(&later, &ours)
}

fn folder() -> PathBuf {
    workspace::target().join("later")
}
