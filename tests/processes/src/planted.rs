//! Builds with a bug that is planted behind the test-only cfg `cara_planted`.

use std::fs::{self, Permissions};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// Writes a wrapper of the compiler that plants the bug, for `RUSTC_WORKSPACE_WRAPPER`: the cfg reaches the crates of the
/// workspace alone, and what they depend on is that of every other build. Cargo tells builds apart by its path, so that no
/// other build sees what it compiles.
pub fn wrapper(root: &Path, bug: &str) -> io::Result<PathBuf> {
    let folder = root.join("target/planted").join(bug);
    fs::create_dir_all(&folder)?;
    let file = folder.join("rustc-with-bug");
    fs::write(&file, format!("#!/bin/sh\nexec \"$@\" --cfg 'cara_planted=\"{bug}\"'\n"))?;
    fs::set_permissions(&file, Permissions::from_mode(0o755))?;
    Ok(file)
}
