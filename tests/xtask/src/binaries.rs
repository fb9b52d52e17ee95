//! Binaries of the workspace that the checks run.
//!
//! Cargo builds a crate once for each set of features that is asked of it, and which features a dependency has follows from
//! everything that is built with it. So binaries are built as members of the whole workspace, and those that are not
//! optimised as if its tests were built too, as they are in CI: otherwise the same crates are compiled again for each of them.

use std::fs::{self, Permissions};
use std::io::IsTerminal;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::Result;

use crate::command::Run;
use crate::paper::broken::Tree;
use crate::workspace;

/// Features that nothing in the workspace asks for, and whose code is checked and tested all the same.
pub(crate) const FEATURES: &str = "cara-std/async";
/// A small test. With one in the build, dependencies have the features that tests want of them.
const TEST: [&str; 2] = ["--test", "smoke"];

/// Builds one and says how to run it.
pub(crate) fn debug(name: &str) -> Result<Run> {
    build(&[name])?;
    Ok(Run::new(&workspace::target().join("debug").join(name).to_string_lossy()))
}

/// As [`debug`], optimised.
pub(crate) fn release(name: &str) -> Result<Run> {
    workspace_build(&[name]).args(["--release"]).stream()?;
    Ok(Run::new(&workspace::target().join("release").join(name).to_string_lossy()))
}

/// Builds several.
pub(crate) fn build(names: &[&str]) -> Result<()> {
    debug_build(names).stream()
}

/// The command that builds them.
pub(crate) fn debug_build(names: &[&str]) -> Run {
    workspace_build(names).args(TEST)
}

fn workspace_build(names: &[&str]) -> Run {
    let build = Run::cargo().args(["build", "--workspace", "--features", FEATURES]);
    // On a terminal the first build of a demonstration shows how far it is.
    let build = if std::io::stderr().is_terminal() { build } else { build.args(["--quiet"]) };
    names.iter().fold(build, |build, name| build.args(["--bin", name]))
}

/// `cargo test` of the whole workspace.
pub(crate) fn tests() -> Run {
    Run::cargo().args(["test", "--workspace", "--features", FEATURES])
}

/// The patches that [`changed`] applies.
pub(crate) const VARIANTS: &str = "tests/variants";

/// The same build, of a clone of the last commit that a patch of `tests/variants` changes.
pub(crate) fn changed(build: Run, patch: &str) -> Result<Run> {
    let folder = changed_folder(patch);
    Tree::at(folder.join("tree"))?.apply(&Path::new(VARIANTS).join(patch).with_extension("patch"))?;
    of_another_tree(build, &folder)
}

/// The same build, of the `tree` in a folder. What it depends on is that of every other build, so what it makes itself goes to
/// that folder; cargo tells both apart by the path of the wrapper.
pub(crate) fn of_another_tree(build: Run, folder: &Path) -> Result<Run> {
    let wrapper = folder.join("rustc");
    fs::write(&wrapper, "#!/bin/sh\nexec \"$@\"\n")?;
    fs::set_permissions(&wrapper, Permissions::from_mode(0o755))?;
    Ok(build
        .within(&folder.join("tree"))
        .env("RUSTC_WORKSPACE_WRAPPER", &wrapper.to_string_lossy())
        .env("CARGO_BUILD_BUILD_DIR", &workspace::target().to_string_lossy())
        .env("CARGO_TARGET_DIR", &folder.to_string_lossy()))
}

/// Where [`changed`] puts what it makes.
pub(crate) fn changed_folder(patch: &str) -> PathBuf {
    workspace::target().join("variants").join(patch)
}
