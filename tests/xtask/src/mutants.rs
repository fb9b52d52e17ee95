//! `cargo xtask mutants`: the mutants that [cargo-mutants](https://mutants.rs) lists, tried by `tests/mutants` in a clone of the last
//! commit. Its state is `target/mutants/state`: a run that is stopped goes on from there.

use std::fs;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, ensure};
use clap::Args;

use crate::command::Run;
use crate::paper::broken::Tree;
use crate::workspace;

/// Which to try.
#[derive(Args)]
pub(crate) struct Mutants {
    /// Files of the core; those that decide about motion and membership if not given.
    #[arg(value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Only every N-th mutant, from the I-th on.
    #[arg(long, value_name = "I/N", default_value = "0/1")]
    shard: String,
}

/// What decides about motion and membership.
const FILES: [&str; 15] = [
    "core/src/services/lease.rs",
    "core/src/distribution/latch.rs",
    "core/src/distribution/claim.rs",
    "core/src/services/session/granting.rs",
    "core/src/services/session/holding.rs",
    "core/src/services/session/permitting.rs",
    "core/src/services/session/obeying.rs",
    "core/src/services/session/renewing.rs",
    "core/src/services/heart.rs",
    "core/src/services/requests.rs",
    "core/src/distribution/connection_handler/claims.rs",
    "core/src/distribution/connection_handler/standby.rs",
    "core/src/distribution/connection_handler/admission.rs",
    "core/src/distribution/connection_handler/hand_over.rs",
    "core/src/time.rs",
];
const MANIFEST: &str = "tests/mutants/Cargo.toml";
const EQUIVALENT: &str = "tests/mutants/equivalent.txt";

pub(crate) fn run(mutants: &Mutants) -> Result<ExitCode> {
    let version = Run::cargo().args(["mutants", "--version"]).captured()?;
    ensure!(version.0, "cargo-mutants is missing: cargo install --locked cargo-mutants");
    let place = workspace::target().join("mutants");
    let tree = Tree::at(place.join("tree"))?;
    let files = match mutants.files.is_empty() {
        true => FILES.map(PathBuf::from).to_vec(),
        false => mutants.files.clone(),
    };
    let files = files.iter().flat_map(|file| ["--file".into(), file.clone()]);
    let list = Run::cargo().within(&tree.root).args(["mutants", "--list", "--json"]).args(files).text()?;
    let listed = place.join("list.json");
    fs::write(&listed, list)?;
    println!("at {}", tree.commit);
    let tool = Run::cargo().args(["run", "--quiet", "--locked", "--manifest-path", MANIFEST, "--target-dir"]);
    let tool = tool.args([&place.join("tool")]).args(["--"]).args([&tree.root, &listed, &place.join("state")]);
    // Debugging information takes a third of the build; judges run hundreds of times.
    let tool = tool.env("CARGO_TARGET_DIR", &place.join("build").to_string_lossy()).env("CARGO_PROFILE_DEV_DEBUG", "0");
    let tool = tool.env("CARGO_PROFILE_DEV_OPT_LEVEL", "1");
    let code = tool.args([EQUIVALENT, &mutants.shard]).code()?;
    Ok(if code == Some(0) { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
