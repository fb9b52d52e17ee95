//! Where the project's files are.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde_json::Value;

use crate::command::Run;

/// The project's root directory.
pub(crate) fn root() -> &'static Path {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    here.parent().and_then(Path::parent).unwrap_or(here)
}

/// Where cargo puts what it builds.
pub(crate) fn target() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), Into::into)
}

/// The whole text of a file below the root.
pub(crate) fn read(path: &Path) -> Result<String> {
    let path = root().join(path);
    fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
}

/// All files of the project, relative to the root: tracked ones and new ones, but nothing that git ignores.
pub(crate) fn files() -> Result<Vec<PathBuf>> {
    let listed = Run::new("git").args(["ls-files", "--cached", "--others", "--exclude-standard"]).text()?;
    let mut files: Vec<PathBuf> =
        listed.lines().map(PathBuf::from).filter(|path| root().join(path).is_file()).collect();
    files.sort();
    files.dedup();
    Ok(files)
}

/// The project's files with the extension `extension`.
pub(crate) fn files_with(extension: &str) -> Result<Vec<PathBuf>> {
    let mut files = files()?;
    files.retain(|path| path.extension().is_some_and(|found| found == extension));
    Ok(files)
}

/// What cargo tells about all packages that the manifest's lock file names.
pub(crate) fn metadata(manifest: &Path) -> Result<Value> {
    let file = manifest.to_string_lossy();
    let arguments = ["metadata", "--format-version", "1", "--locked", "--manifest-path", &file];
    Ok(serde_json::from_str(&Run::cargo().args(arguments).text()?)?)
}
