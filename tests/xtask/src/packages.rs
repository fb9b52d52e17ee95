//! The crates as their users get them: each is packaged, each package builds by itself, and so does a program that has nothing but the
//! packages. Then the oldest versions of dependencies that the manifests allow, and the guide with the build that it begins with.

use std::fs;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, ensure};

use crate::command::Run;
use crate::{binaries, workspace};

/// What the program of a user prints.
const ANSWER: &str = "80 %";

pub(crate) fn check() -> Result<()> {
    let names = published()?;
    println!("{} crates to publish: {}", names.len(), names.join(", "));
    let named: Vec<&str> = names.iter().flat_map(|name| ["--package", name]).collect();
    Run::cargo().args(["package", "--locked"]).args(&named).stream()?;
    build_program(&names)?;
    check_oldest(&named)?;
    binaries::debug("cara-guide")?.args(["docs/guide.md"]).stream()
}

/// The crates that are not marked otherwise.
fn published() -> Result<Vec<String>> {
    let root = workspace::metadata(Path::new("Cargo.toml"))?;
    let (packages, members) = (root["packages"].as_array(), root["workspace_members"].as_array());
    let (packages, members) = (packages.context("no packages")?, members.context("no members")?);
    let ours = packages.iter().filter(|package| members.contains(&package["id"]) && package["publish"].is_null());
    ours.map(|package| Ok(package["name"].as_str().context("a package without a name")?.to_owned())).collect()
}

/// Builds and runs a program in a workspace of its own, whose dependencies are the packages' contents.
fn build_program(names: &[String]) -> Result<()> {
    let folder = workspace::target().join("packages");
    match fs::remove_dir_all(&folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error.into()),
        _ => fs::create_dir_all(folder.join("program/src"))?,
    }
    let mut manifest = String::from(
        "[package]\nname = \"program\"\nversion = \"0.0.0\"\nedition = \"2024\"\n\n[workspace]\n\n[dependencies]\ncara-std = \"0.1\"\n\n[patch.crates-io]\n",
    );
    for name in names {
        let package = workspace::target().join(format!("package/{name}-{}.crate", env!("CARGO_PKG_VERSION")));
        Run::new("tar").args(["-xzf", &package.to_string_lossy(), "-C", &folder.to_string_lossy()]).stream()?;
        manifest.push_str(&format!("{name} = {{ path = \"../{name}-{}\" }}\n", env!("CARGO_PKG_VERSION")));
    }
    let program = folder.join("program");
    fs::write(program.join("Cargo.toml"), manifest)?;
    fs::write(program.join("src/main.rs"), workspace::read(Path::new("tests/packages/main.rs"))?)?;
    // The versions of others' crates are those that the project is tested with.
    fs::copy(workspace::root().join("Cargo.lock"), program.join("Cargo.lock"))?;
    let target = folder.join("target");
    let start = Instant::now();
    let printed = Run::cargo().args(["run", "--quiet"]).env("CARGO_TARGET_DIR", &target.to_string_lossy());
    let printed = printed.within(&program).text()?;
    ensure!(printed.trim() == ANSWER, "the program printed {printed:?}");
    println!(
        "a program of the packages alone printed {ANSWER}, {:.0} s after `cargo run`",
        start.elapsed().as_secs_f64()
    );
    Ok(())
}

/// Checks the libraries against the oldest direct dependencies that their manifests allow, in a clone, since the lock file changes.
fn check_oldest(named: &[&str]) -> Result<()> {
    let clone = workspace::target().join("packages/oldest");
    Run::new("git")
        .args(["clone", "--quiet", "--depth=1"])
        .args([&format!("file://{}", workspace::root().display())])
        .args([&clone])
        .stream()?;
    let arguments = ["run", "nightly", "cargo", "check", "--quiet", "-Z", "direct-minimal-versions"];
    let target = workspace::target().join("packages/target");
    Run::new("rustup")
        .args(arguments)
        .args(named)
        .env("CARGO_TARGET_DIR", &target.to_string_lossy())
        .within(&clone)
        .stream()
}
