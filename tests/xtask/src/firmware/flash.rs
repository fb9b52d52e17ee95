//! `cargo xtask firmware BOARD --flash`: puts the vehicle's image on a board that hangs on a debug probe.

use std::process::ExitCode;

use anyhow::{Result, bail};

use super::boards::{self, RADIO};
use super::uf2;
use crate::command::{Run, exists};
use crate::install;

/// Builds, flashes and starts the first image of a board.
pub(crate) fn flash(name: &str) -> Result<ExitCode> {
    let board = boards::find(name)?;
    let Some(place) = cara_settings::board::find(name) else {
        bail!("{name} is emulated and has nothing to flash");
    };
    if board.has_radio && std::env::var_os(RADIO).is_none() {
        bail!("{name} does nothing without its radio's files: set {RADIO} to their folder, see docs/boards.md");
    }
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    let Some(image) = board.images.first() else { bail!("{name} has no image") };
    let elf = board.build(image)?;
    let file = uf2::write_beside(&elf, place)?;
    if !exists("probe-rs") {
        bail!("{}", without_probe(&file.display().to_string(), place.uf2.is_some()));
    }
    let path = elf.display().to_string();
    probe().args(["download", "--chip", place.chip, &path]).stream()?;
    probe().args(["reset", "--chip", place.chip]).stream()?;
    println!("{name} runs; its log: probe-rs attach --chip {} {path}", place.chip);
    println!("it does nothing until it is provisioned: cara provision {name} --help");
    Ok(ExitCode::SUCCESS)
}

/// With several probes it would prompt for one, where no answer is possible; `PROBE_RS_PROBE` selects it.
fn probe() -> Run {
    Run::new("probe-rs").env("PROBE_RS_NON_INTERACTIVE", "true")
}

/// What to do where `probe-rs` is not installed.
fn without_probe(file: &str, takes_uf2: bool) -> String {
    let drive = match takes_uf2 {
        true => "hold BOOTSEL while you connect the board",
        false => "connect the board's debug probe",
    };
    format!(
        "probe-rs is not installed: cargo install probe-rs-tools --locked (or see https://probe.rs); or without it: {drive}, \
         and copy {file} to the drive that appears"
    )
}

#[cfg(test)]
mod tests {
    use super::{flash, without_probe};

    #[test]
    fn what_cannot_be_flashed_is_told() {
        assert!(flash("lm3s6965evb").unwrap_err().to_string().contains("emulated"));
        assert!(flash("toaster").unwrap_err().to_string().contains("there are: lm3s6965evb"));
    }

    #[test]
    fn the_way_without_a_probe_is_told() {
        assert!(without_probe("agv.uf2", true).contains("BOOTSEL"));
        assert!(without_probe("agv.bin", false).contains("agv.bin"));
    }
}
