//! The size breakdown: flash and RAM of every firmware, and the part of it that is CARA's.

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use cara_processes::files;
use serde_json::{Value, json};

use super::boards::{self, Board, Chosen, Image, RADIO, RESOURCES};
use super::breakdown::Row;
use super::image::{Footprint, footprint};
use super::{NOT_ALLOWED, TESTED, tests};
use crate::command::Run;
use crate::figures::{Document, table};
use crate::groups::Outcome;
use crate::install;

/// Where the breakdown is committed.
const DOCUMENT: Document = Document { file: "docs/sizes.md", command: "cargo xtask sizes --write" };

/// Builds the firmware of one board or of all, prints what it takes, and writes the same as JSON or into the document.
pub(crate) fn sizes(board: Option<&str>, json: Option<&Path>, write: bool) -> Result<ExitCode> {
    json.map_or(Ok(()), files::can_write)?;
    let board = board.map(boards::find).transpose()?;
    let rows = board.map_or_else(|| measured(|_, _| true), |board| of_board(board, |_, _| true))?;
    println!("{}", table(&rows));
    println!("The stack is measured on emulated boards only; the others were linked, and not run.");
    if board.is_none() {
        print_resources()?;
    }
    if let Some(path) = json {
        let rows: Vec<Value> = rows.iter().map(to_json).collect();
        let written = std::fs::write(path, serde_json::to_string_pretty(&rows)? + "\n");
        written.with_context(|| format!("cannot write {}", path.display()))?;
    }
    match board {
        _ if !write => {}
        None => DOCUMENT.write(&rows)?,
        Some(board) => DOCUMENT.write_some(rows, |row| row.board == board.name)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Fails when a figure has grown by more than 2 % since the document was written.
pub(crate) fn check(of: Chosen) -> Outcome {
    match boards::with(of) {
        Err(reason) => Outcome::Skipped(reason),
        Ok(_) => measured(of).and_then(|rows| DOCUMENT.check(&rows)).into(),
    }
}

/// The same for one board.
pub(super) fn check_board(name: &str) -> Result<()> {
    DOCUMENT.check(&of_board(boards::find(name)?, |_, _| true)?)
}

fn measured(of: Chosen) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for board in boards::with(of).map_err(anyhow::Error::msg)? {
        if board.has_radio && std::env::var_os(RADIO).is_none() {
            println!("{} is left out: {RADIO} does not say where its radio's files are", board.name);
            continue;
        }
        rows.extend(of_board(board, of)?);
    }
    Ok(rows)
}

fn of_board(board: &'static Board, of: Chosen) -> Result<Vec<Row>> {
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    let mut found = Vec::new();
    for image in board.images.iter().filter(|image| of(board, image)) {
        let path = board.build(image)?;
        // A board tells by its logs how deep its stack has been. There is no load for a vehicle of the warehouse.
        let has_load = image.has_logs && image.program != boards::WAREHOUSE.program;
        let stack = if board.is_emulated() && has_load { stack(board, &path, image)? } else { None };
        found.push((image, footprint(&path)?, stack));
    }
    let row = |(image, footprint, stack): &(&Image, Footprint, Option<u64>)| {
        let bare = found.iter().find(|(other, ..)| other.is_bare() && other.has_logs == image.has_logs);
        let bare = bare.map_or_else(Footprint::default, |(_, bare, _)| *bare);
        Row {
            board: board.name.to_owned(),
            image: image.name.to_owned(),
            flash: footprint.flash,
            static_ram: footprint.static_ram,
            stack: *stack,
            cara_flash: footprint.flash.saturating_sub(bare.flash),
            cara_ram: footprint.static_ram.saturating_sub(bare.static_ram),
        }
    };
    Ok(found.iter().map(row).collect())
}

/// The deepest stack under load; none, with the reason printed, where nothing can be run.
fn stack(board: &Board, path: &Path, image: &Image) -> Result<Option<u64>> {
    if let Err(reason) = install::program("qemu-system-arm", "qemu-system-arm") {
        println!("warning: no stack is measured: {reason}");
        return Ok(None);
    }
    let insecure = (!image.is_secured).then_some("--insecure");
    let load = if image.name == boards::FIXED.name { image.name } else { image.program };
    let (code, output) = tests(board, path)?.args(insecure).args(["stack", load]).output()?;
    match code {
        Some(0) => {}
        Some(NOT_ALLOWED) => {
            println!("warning: no stack is measured: this user cannot make a network with virtual devices");
            return Ok(None);
        }
        code => bail!("the load ended with code {code:?}"),
    }
    let used = output.split_once("stack ").and_then(|(_, behind)| behind.split(' ').next());
    Ok(Some(used.context("the board says nothing of its stack")?.parse()?))
}

/// Prints what each capacity of `Resources` costs, as the board itself tells.
fn print_resources() -> Result<()> {
    let board = boards::find(TESTED)?;
    let image = board.build(&RESOURCES)?;
    if install::program("qemu-system-arm", "qemu-system-arm").is_err() {
        return Ok(());
    }
    let machine = ["-M", TESTED, "-display", "none", "-monitor", "none", "-serial", "none", "-nic", "none"];
    let semihosting = ["-semihosting-config", "enable=on,target=native", "-kernel"];
    let reported = Run::new("qemu-system-arm").args(machine).args(semihosting).args([image]).text()?;
    println!("\nBytes of static RAM, and what more of each capacity adds:\n{}", reported.trim());
    Ok(())
}

fn to_json(row: &Row) -> Value {
    let Row { board, image, flash, static_ram, stack, cara_flash, cara_ram } = row;
    json!({
        "board": board, "image": image, "flash": flash, "static_ram": static_ram, "stack": stack,
        "cara_flash": cara_flash, "cara_ram": cara_ram,
    })
}
