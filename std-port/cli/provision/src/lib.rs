//! `cara provision`: gives a board its identity. One image serves all boards of a kind; what differs is written to two
//! pages of the board's flash.
//!
//! `given` makes settings of the command line and `secrets` keys of a node's file, `copy` the bytes of the next copy and
//! `probe` brings them to the board. `show` reads what a page says.

mod copy;
mod given;
mod probe;
mod secrets;
mod show;
mod text;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use cara_settings::board::{BOARDS, Board, find};
use cara_settings::page::{BYTES, PageError, decode};
use cara_std::keys::{Owner, check_replaceable, full_name, write_private};
use serde_json::json;

use cara_tools::exit::{Ended, Exit};
use cara_tools::files;
use cara_tools::global::Global;
use cara_tools::output;

use zeroize::Zeroizing;

use self::copy::{Content, Written};
use self::secrets::Secrets;

/// Writes a board's identity, manager and network settings to its flash.
///
/// Without --output it goes to the board on this computer's debug probe, through probe-rs, which must be installed; the
/// board then starts again. The board keeps two copies: the newest one is overwritten behind the other one.
#[derive(clap::Args)]
#[command(after_help = "\
cara provision nucleo-f767zi --keys ~/.config/cara/keys/agv-17-17-s_unit-7.keys
cara provision rp2040 --name agv-18 --id 18 --manager depot/1 --address 10.0.0.18/24 --uf2 --output settings.uf2
cara provision --read settings.uf2")]
pub struct Arguments {
    /// The kind of board; --list shows them.
    #[arg(required_unless_present_any = ["list", "read"])]
    board: Option<String>,
    #[command(flatten)]
    given: given::Given,
    /// The file with the board's keys, as `cara keys` makes it. It tells name, id, fleet and manager where these are not
    /// given. Without it, keys that the board has stay, where its pages can be read.
    #[arg(long, value_name = "FILE", requires = "board")]
    keys: Option<PathBuf>,
    /// Write a file instead of the board.
    #[arg(long, value_name = "FILE", requires = "board")]
    output: Option<PathBuf>,
    /// The file is for the drive of a Raspberry Pi chip's boot loader. It holds both copies.
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

/// Does what the command line asks, and prints it.
pub fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
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
    let name = arguments.board.as_deref().unwrap_or_default();
    let board = text::EMULATED.iter().find(|board| board.name == name).map_or_else(|| known(name), Ok)?;
    if arguments.uf2 && board.uf2.is_none() {
        let text = format!("{} has no boot loader that takes UF2: leave --uf2 away", board.name);
        return Err(Ended::usage(text));
    }
    let ring = arguments.keys.as_deref().map(secrets::load).transpose()?;
    let settings = arguments.given.settings(board, global, ring.as_ref())?;
    let managers = arguments.given.managers(ring.as_ref())?;
    let secrets = ring.as_ref().map(|ring| Secrets::draw(ring, &managers)).transpose()?;
    let content = Content { settings, secrets };
    match &arguments.output {
        _ if text::EMULATED.contains(board) => text::write(name, &content, arguments.output.as_deref(), global),
        Some(file) => write_file(arguments, board, &content, file, global),
        None => report(board, &probe::provision(board, &content)?, None, &content, global),
    }
}

fn known(name: &str) -> anyhow::Result<&'static Board> {
    find(name).ok_or_else(|| {
        let names = BOARDS.iter().chain(&text::EMULATED).map(|board| board.name);
        let names = names.collect::<Vec<_>>().join(", ");
        Ended::usage(format!("there is no board {name}; there are: {names}"))
    })
}

fn write_file(
    arguments: &Arguments,
    board: &Board,
    content: &Content,
    file: &Path,
    global: &Global,
) -> anyhow::Result<()> {
    let previous = arguments.previous.as_deref().map(|files| pages(files, board)).transpose()?;
    let both = match &previous {
        Some([first, second]) => copy::next(board, content, first, second)?,
        // Whatever the pages hold, these are newer than nothing.
        None => copy::both(board, content)?,
    };
    let [next, other] = &both;
    let (written, bytes) = match board.uf2.filter(|_| arguments.uf2) {
        Some(families) => (&both[..], copy::uf2(&both, families.data)),
        None => (core::slice::from_ref(next), next.bytes.clone()),
    };
    let has_keys = written.iter().any(|copy| copy.has_keys);
    let is_secret = has_keys || content.settings.wifi.is_some();
    store(file, &bytes, is_secret)?;
    report(board, written, Some(file), content, global)?;
    if previous.is_none() && arguments.uf2 && !has_keys && !global.json {
        output::line("keys that the board has are gone with it: give --keys if it is to keep any")?;
    }
    if arguments.uf2 || global.json {
        return Ok(());
    }
    let second = other.address;
    match &previous {
        None => output::line(format_args!(
            "an older copy at {second:#x} would count as newer: erase that page, or give --previous"
        ))?,
        Some(pages) if copy::is_held(board, pages, second) => output::line(format_args!(
            "behind it, erase the page at {second:#x}: what it holds would count again if the new copy were damaged"
        ))?,
        Some(_) => {}
    }
    Ok(())
}

/// Writes a file; one with keys or a password for its owner alone, whatever stood there before.
fn store(file: &Path, bytes: &[u8], is_secret: bool) -> anyhow::Result<()> {
    check_replaceable(file).map_err(|error| Ended::usage(format!("--output: {error}")))?;
    if is_secret {
        return write_private(file, bytes).map_err(|error| Ended::failed("Failed", format!("cannot write {error}")));
    }
    std::fs::write(file, bytes).with_context(|| format!("cannot write {}", file.display()))
}

/// Longest file that is read: the pages of any board as UF2 are far shorter.
const LONGEST_FILE: u64 = 1 << 20;

/// A file with pages of a board.
fn read_whole(file: &Path) -> anyhow::Result<Zeroizing<Vec<u8>>> {
    let read = files::read(file, LONGEST_FILE);
    let (bytes, is_longer) = read.with_context(|| format!("cannot read {}", file.display()))?;
    if is_longer {
        let text = format!("{} has more than {LONGEST_FILE} bytes: it holds no pages of a board", file.display());
        return Err(Ended::usage(text));
    }
    Ok(bytes)
}

/// What the two files hold.
fn pages(files: &[PathBuf], board: &Board) -> anyhow::Result<[Zeroizing<Vec<u8>>; 2]> {
    let [first, second] = files else { return Err(Ended::usage("--previous takes two files")) };
    let pages = [page(first, board)?, page(second, board)?];
    // A copy gets the next generation of the other one.
    match pages.each_ref().map(|page| decode(page)) {
        [Ok((_, one)), Ok((_, other))] if one == other => {
            Err(Ended::usage(format!("--previous: both files hold one page, that of generation {one}")))
        }
        _ => Ok(pages),
    }
}

/// A page with a copy, a damaged one included, or an erased page.
fn page(file: &Path, board: &Board) -> anyhow::Result<Zeroizing<Vec<u8>>> {
    let page = read_whole(file)?;
    let is_erased = page.len() >= BYTES && page.iter().all(|byte| *byte == 0xFF);
    if decode(&page).is_err_and(|error| error == PageError::Absent) && !is_erased {
        let ([first, second], name) = (board.pages, file.display());
        let text = format!(
            "--previous: {name} is neither a copy of settings nor an erased page: read the pages of the board at {first:#x} and \
             {second:#x}, {BYTES} bytes each, and erase what holds something else"
        );
        return Err(Ended::usage(text));
    }
    Ok(page)
}

fn report(
    board: &Board,
    written: &[Written],
    file: Option<&Path>,
    content: &Content,
    global: &Global,
) -> anyhow::Result<()> {
    for copy in written {
        let Written { address, generation, has_keys, left, .. } = copy;
        let place = file.map_or_else(|| "the board".to_owned(), |file| file.display().to_string());
        let keys = secrets::given(&copy.bytes).ok().flatten().map(|keys| keys.generations);
        match global.json {
            true => output::object(&json!({
                "board": board.name, "file": file, "address": address, "generation": generation, "keys": keys,
            }))?,
            false => {
                let what = match (has_keys, content.settings.insecure) {
                    (true, _) => "settings and keys",
                    (false, true) => "settings for plain mode, INSECURE,",
                    (false, false) => "settings without keys, with which it joins no manager,",
                };
                let name = board.name;
                output::line(format_args!("{place}: {what} for {name} at {address:#x}, generation {generation}"))?;
                left.as_ref().map_or(Ok(()), |owner| keys_are_left(owner, content))?;
            }
        }
    }
    Ok(())
}

/// Why a copy does not have the keys that the board had.
fn keys_are_left(owner: &Owner, Content { settings, .. }: &Content) -> std::io::Result<()> {
    let why = match settings.insecure {
        true => "a board in plain mode has no keys".to_owned(),
        false => format!(
            "this is {} in fleet {}: tell it the same name, id, manager and --fleet, or give --keys",
            full_name(&settings.identity),
            settings.fleet.0,
        ),
    };
    output::line(format_args!("the keys of {owner} that the board had are not kept: {why}"))
}
