//! The oldest Rust that the project builds with: one version for all crates, and no dependency asks for a newer one. That our
//! own code keeps to it is checked by clippy's `incompatible_msrv`, which the group `clippy` denies.

use std::path::Path;

use anyhow::{Context, Result, bail};
use serde_json::Value;

use crate::{manifests, workspace};

/// Fails where a crate of the project names another version, and where a dependency of the host workspace asks for a newer one.
pub(crate) fn check() -> Result<()> {
    let ours = ours()?;
    let manifests = manifests::all()?;
    let other = manifests.iter().filter(|manifest| manifest.rust_version().is_some_and(|version| version != ours));
    let mut wrong: Vec<String> =
        other.map(|manifest| format!("{}: its rust-version is not {ours}", manifest.file.display())).collect();
    wrong.extend(newer(&workspace::metadata(Path::new("Cargo.toml"))?, &ours)?);
    finish(wrong, &ours)
}

/// Fails where a dependency of firmware asks for a newer version. Apart from the rest, since it downloads what boards need.
pub(crate) fn check_firmware() -> Result<()> {
    let ours = ours()?;
    let mut wrong = Vec::new();
    for manifest in manifests::all()? {
        if manifest.is_workspace() && manifest.file.starts_with("examples") {
            wrong.extend(newer(&workspace::metadata(&manifest.file)?, &ours)?);
        }
    }
    finish(wrong, &ours)
}

fn finish(wrong: Vec<String>, ours: &str) -> Result<()> {
    if wrong.is_empty() {
        println!("no dependency needs more than Rust {ours}");
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} crates and Rust {ours}, which Cargo.toml promises, do not fit", wrong.len())
}

/// What the root's manifest promises.
fn ours() -> Result<String> {
    let root: toml::Table = workspace::read(Path::new("Cargo.toml"))?.parse()?;
    let version = root.get("workspace").and_then(|root| root.get("package")?.get("rust-version")?.as_str());
    version.map(str::to_owned).context("Cargo.toml has no rust-version")
}

/// The packages that need a newer Rust than `ours`.
fn newer(metadata: &Value, ours: &str) -> Result<Vec<String>> {
    let limit = numbers(ours)?;
    let mut found = Vec::new();
    for package in metadata["packages"].as_array().context("cargo metadata names no packages")? {
        let text = |key: &str| package[key].as_str();
        if let Some(needed) = text("rust_version")
            && numbers(needed)? > limit
        {
            let (name, version) = (text("name").unwrap_or("?"), text("version").unwrap_or("?"));
            found.push(format!("{name} {version}: needs Rust {needed}"));
        }
    }
    Ok(found)
}

/// `1.91` is `1.91.0`.
fn numbers(version: &str) -> Result<[u32; 3]> {
    let mut numbers = [0; 3];
    for (number, text) in numbers.iter_mut().zip(version.split('.')) {
        *number = text.parse().with_context(|| format!("`{version}` is no version of Rust"))?;
    }
    Ok(numbers)
}

#[cfg(test)]
mod tests {
    use super::{newer, numbers};
    use serde_json::json;

    #[test]
    fn a_dependency_that_needs_a_newer_rust_is_found() {
        let needing = |version: Option<&str>| {
            let metadata = json!({"packages": [{"name": "a", "version": "1.0.0", "rust_version": version}]});
            newer(&metadata, "1.91").unwrap().len()
        };
        assert_eq!([None, Some("1.9"), Some("1.91"), Some("1.91.0")].map(needing), [0; 4]);
        assert_eq!([Some("1.91.1"), Some("1.92"), Some("2")].map(needing), [1; 3]);
        assert!(newer(&json!({}), "1.91").is_err() && numbers("stable").is_err());
    }

    #[test]
    fn no_crate_and_no_dependency_needs_more() {
        super::check().unwrap();
    }
}
