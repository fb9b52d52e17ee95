//! The way to the board through `probe-rs`, as a program: it knows all probes, and is its own installation.

use std::io::ErrorKind;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use anyhow::Context;
use cara_settings::board::Board;
use cara_settings::page::BYTES;
use tempfile::TempDir;

use zeroize::Zeroizing;

use super::copy::{self, Content, Written};
use cara_tools::exit::Ended;

const PROGRAM: &str = "probe-rs";

/// Writes the next copies to the board on the probe, and starts the board again. Its pages may be such as cannot be read, as on an
/// STM32H7 whose power was cut while one was written.
pub(super) fn provision(board: &Board, content: &Content) -> anyhow::Result<[Written; 2]> {
    let folder = folder().context("cannot make a folder for the copies")?;
    let [first, second] = board.pages.map(|address| read(board, address, &folder.path().join("read.bin")));
    let written = match (first?, second?) {
        (Some(first), Some(second)) => copy::next(board, content, &first, &second)?,
        _ => copy::both(board, content)?,
    };
    for copy in &written {
        download(board, copy, &folder.path().join("settings.bin"))?;
    }
    succeeded(&["reset", "--chip", board.chip])?;
    Ok(written)
}

/// A folder for this user alone, since passwords and keys go through it; in memory where the system has such a place.
fn folder() -> std::io::Result<TempDir> {
    let in_memory = std::env::var_os("XDG_RUNTIME_DIR").and_then(|folder| TempDir::new_in(folder).ok());
    in_memory.map_or_else(TempDir::new, Ok)
}

/// What a page holds; `None` where the probe cannot read it.
fn read(board: &Board, address: u32, file: &Path) -> anyhow::Result<Option<Zeroizing<Vec<u8>>>> {
    let (address, bytes, path) = (format!("{address:#x}"), BYTES.to_string(), file.display().to_string());
    let output = ["--output", &path, "--format", "binary"];
    let ran = run(&[&["read", "--chip", board.chip], &output[..], &["b8", &address, &bytes]].concat())?;
    if !ran.status.success() {
        return Ok(None);
    }
    Ok(std::fs::read(file).ok().map(Zeroizing::new).filter(|page| page.len() >= BYTES))
}

fn download(board: &Board, copy: &Written, file: &Path) -> anyhow::Result<()> {
    std::fs::write(file, &copy.bytes).with_context(|| format!("cannot write {}", file.display()))?;
    let (address, path) = (format!("{:#x}", copy.address), file.display().to_string());
    succeeded(&["download", "--chip", board.chip, "--binary-format", "bin", "--base-address", &address, &path])
}

fn succeeded(arguments: &[&str]) -> anyhow::Result<()> {
    let ran = run(arguments)?;
    if ran.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&ran.stderr);
    let text = format!(
        "`{PROGRAM} {}` failed: {}. Is the board connected? `{PROGRAM} list` shows probes, and where there are several, \
         PROBE_RS_PROBE in the environment says which",
        arguments.join(" "),
        said.trim().trim_end_matches('.')
    );
    Err(Ended::failed("Probe", text))
}

fn run(arguments: &[&str]) -> anyhow::Result<Output> {
    let mut command = Command::new(PROGRAM);
    // With several probes it would prompt for one, on a terminal that is not there.
    command.args(arguments).env("PROBE_RS_NON_INTERACTIVE", "true").stdin(Stdio::null());
    command.output().map_err(|error| match error.kind() {
        ErrorKind::NotFound => Ended::failed(
            "NoProbe",
            format!(
                "{PROGRAM} is not installed: cargo install probe-rs-tools --locked, or see https://probe.rs; or give \
                 --output to write a file"
            ),
        ),
        _ => Ended::failed("Probe", format!("{PROGRAM} cannot be started: {error}")),
    })
}
