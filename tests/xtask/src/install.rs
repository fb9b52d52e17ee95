//! Gets what a check needs and the machine lacks, without asking. What cannot be had is a reason to skip.

use std::path::PathBuf;

use crate::command::{Run, exists};
use crate::workspace;

/// A rustup target; `Err` is the reason why it cannot be had.
pub(crate) fn rust_target(target: &str) -> Result<(), String> {
    let listed = rustup(&["target", "list", "--installed"])?;
    if listed.lines().any(|line| line.trim() == target) {
        return Ok(());
    }
    rustup(&["target", "add", target]).map(drop)
}

/// A rustup component such as `clippy`, found by the program that it brings.
pub(crate) fn rust_component(component: &str, program: &str) -> Result<(), String> {
    if exists(program) && works(program) {
        return Ok(());
    }
    rustup(&["component", "add", component]).map(drop)
}

/// A program from crates.io, in a folder of the project's; the first time it is built, which takes minutes.
pub(crate) fn crate_program(name: &str, version: &str) -> Result<PathBuf, String> {
    let folder = workspace::target().join("tools");
    let package = format!("{name}@{version}");
    let install = Run::cargo().args(["install", "--quiet", "--locked", &package, "--root"]).args([&folder]);
    install.stream().map_err(|error| format!("{name} is missing: {error:#}"))?;
    Ok(folder.join("bin").join(name))
}

/// A program from a Debian package, installed only where this runs as root.
pub(crate) fn program(program: &str, package: &str) -> Result<(), String> {
    if exists(program) {
        return Ok(());
    }
    if !is_root() {
        return Err(format!("{program} is missing and only root can install it: apt-get install {package}"));
    }
    apt_install(package).map_err(|error| format!("{program} is missing: {error:#}"))?;
    if exists(program) { Ok(()) } else { Err(format!("package {package} did not bring {program}")) }
}

/// Tries the package lists as they are first: fetching them again is slow.
fn apt_install(package: &str) -> anyhow::Result<()> {
    // Another group may be installing something at the same time.
    let install = ["install", "-y", "-o", "DPkg::Lock::Timeout=300", package];
    let install = || Run::new("apt-get").args(install).env("DEBIAN_FRONTEND", "noninteractive").stream();
    if install().is_ok() {
        return Ok(());
    }
    Run::new("apt-get").args(["update"]).stream()?;
    install()
}

fn rustup(arguments: &[&str]) -> Result<String, String> {
    if !exists("rustup") {
        return Err("rustup is missing: see https://rustup.rs".into());
    }
    Run::new("rustup").args(arguments).text().map_err(|error| format!("{error:#}"))
}

/// rustup puts proxies for missing components in the path; they start and then fail.
fn works(program: &str) -> bool {
    Run::new(program).args(["--version"]).captured().is_ok_and(|(success, ..)| success)
}

fn is_root() -> bool {
    Run::new("id").args(["-u"]).text().is_ok_and(|id| id.trim() == "0")
}
