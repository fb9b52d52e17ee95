//! `cara provision`: tells a board who it is. One image serves all boards of a kind; what differs is written to two pages
//! of the board's flash.
//!
//! [`told`] makes settings of the command line, [`copy`] the bytes of the next copy and [`probe`] brings them to the
//! board. [`show`] reads what a page says.

mod copy;
mod probe;
mod show;
mod told;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use cara_settings::Settings;
use cara_settings::board::{BOARDS, Board, find};
use serde_json::json;

use crate::exit::{Ended, Exit};
use crate::global::Global;
use crate::output;

use self::copy::Written;

/// Writes to a board's flash who it is, whom it belongs to and how it gets its address.
///
/// Without --output it goes to the board on this computer's debug probe, through probe-rs, which must be installed; the
/// board then starts again. The board keeps two copies, and the newest one is never overwritten.
#[derive(clap::Args)]
#[command(after_help = "\
cara provision nucleo-f767zi --name agv-17 --id 17 --manager depot/1 --fleet 7
cara provision rp2040 --name agv-18 --id 18 --manager depot/1 --address 10.0.0.18/24 --uf2 --output settings.uf2
cara provision --read settings.uf2")]
pub(crate) struct Arguments {
    /// The kind of board; --list shows them.
    #[arg(required_unless_present_any = ["list", "read"])]
    board: Option<String>,
    #[command(flatten)]
    told: told::Told,
    /// Write a file instead of the board.
    #[arg(long, value_name = "FILE", requires = "board")]
    output: Option<PathBuf>,
    /// The file is for the drive of a Raspberry Pi chip's boot loader. Unless --previous is given it holds both copies.
    #[arg(long, requires = "output")]
    uf2: bool,
    /// With --output: what the board's two pages hold now, read from it before.
    #[arg(long, num_args = 2, value_names = ["FIRST", "SECOND"], requires = "output")]
    previous: Option<Vec<PathBuf>>,
    /// Show what a file says that was read from a page, or written here.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["board", "list"])]
    read: Option<PathBuf>,
    /// List the boards and the addresses of their pages.
    #[arg(long, conflicts_with = "board")]
    list: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    if arguments.list {
        show::boards(global)?;
    } else if let Some(file) = &arguments.read {
        show::file(file, global)?;
    } else {
        write(&arguments, global)?;
    }
    Ok(Exit::Done.into())
}

fn write(arguments: &Arguments, global: &Global) -> anyhow::Result<()> {
    let board = known(arguments.board.as_deref().unwrap_or_default())?;
    if arguments.uf2 && board.uf2.is_none() {
        let text = format!("{} has no boot loader that takes UF2: leave --uf2 away", board.name);
        return Err(Ended::usage(text));
    }
    let settings = arguments.told.settings(board, global.fleet.unwrap_or(0))?;
    match &arguments.output {
        Some(file) => write_file(arguments, board, &settings, file, global),
        None => report(board, &probe::provision(board, &settings)?, None, global),
    }
}

fn known(name: &str) -> anyhow::Result<&'static Board> {
    find(name).ok_or_else(|| {
        let names = BOARDS.map(|board| board.name).join(", ");
        let text = match name {
            "lm3s6965evb" => "lm3s6965evb is emulated: it is told as an argument of QEMU, not in flash".to_owned(),
            _ => format!("there is no board {name}; there are: {names}"),
        };
        Ended::usage(text)
    })
}

fn write_file(
    arguments: &Arguments,
    board: &Board,
    settings: &Settings,
    file: &Path,
    global: &Global,
) -> anyhow::Result<()> {
    let previous = arguments.previous.as_deref().map(pages).transpose()?;
    let written = match (&previous, arguments.uf2) {
        (Some([first, second]), _) => vec![copy::next(board, settings, first, second)?],
        // Whatever the pages hold, these are newer than nothing.
        (None, true) => copy::both(board, settings)?,
        (None, false) => vec![copy::next(board, settings, &[], &[])?],
    };
    let bytes = match board.uf2.filter(|_| arguments.uf2) {
        Some(families) => copy::uf2(&written, families.data),
        None => written.iter().flat_map(|copy| copy.bytes).collect(),
    };
    std::fs::write(file, bytes).with_context(|| format!("cannot write {}", file.display()))?;
    report(board, &written, Some(file), global)?;
    if previous.is_none() && !arguments.uf2 && !global.json {
        let [_, second] = board.pages;
        output::line(format_args!(
            "an older copy at {second:#x} would count as newer: erase that page, or give --previous"
        ))?;
    }
    Ok(())
}

/// What the two files hold.
fn pages(files: &[PathBuf]) -> anyhow::Result<[Vec<u8>; 2]> {
    let read = |file: &PathBuf| std::fs::read(file).with_context(|| format!("cannot read {}", file.display()));
    match files {
        [first, second] => Ok([read(first)?, read(second)?]),
        _ => Err(Ended::usage("--previous takes two files")),
    }
}

fn report(board: &Board, written: &[Written], file: Option<&Path>, global: &Global) -> anyhow::Result<()> {
    for Written { address, generation, .. } in written {
        let place = file.map_or_else(|| "the board".to_owned(), |file| file.display().to_string());
        match global.json {
            true => output::object(&json!({
                "board": board.name, "file": file, "address": address, "generation": generation,
            }))?,
            false => output::line(format_args!(
                "{place}: settings for {} at {address:#x}, generation {generation}",
                board.name
            ))?,
        }
    }
    Ok(())
}
