//! `cargo xtask firmware` and `cargo xtask sizes`: what runs on boards is built, measured and run in an emulator.

mod abilities;
mod boards;
mod breakdown;
mod faults;
mod flash;
mod image;
mod session;
mod sizes;
mod uf2;

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail};

use crate::binaries;
use crate::command::Run;
use crate::groups::Outcome;
use crate::{install, msrv, workspace};
pub(crate) use abilities::{abilities, targets};
use boards::{BOARDS, Board, Chosen, Image};
pub(crate) use boards::{built, each_time, find, image_build};
pub(crate) use faults::{Faults, check as check_faults, faults};
pub(crate) use flash::flash;
use image::{Footprint, footprint};
pub(crate) use session::{SessionOptions, session};
pub(crate) use sizes::{check as check_sizes, sizes};

/// Builds the images of one board, or of all of them, with the files that are flashed beside them.
pub(crate) fn build(name: Option<&str>) -> Result<ExitCode> {
    for board in chosen(name)? {
        build_images(board, |_, _| true)?;
    }
    Ok(ExitCode::SUCCESS)
}

fn build_images(board: &Board, of: Chosen) -> Result<()> {
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    for image in board.images.iter().filter(|image| of(board, image)) {
        let elf = board.build(image)?;
        println!("{}", elf.display());
        if let Some(place) = cara_settings::board::find(board.name) {
            println!("{}", uf2::write_beside(&elf, place)?.display());
        }
    }
    Ok(())
}

/// Builds and links images of boards, with a Rust as old as promised as far as their dependencies say.
pub(crate) fn link(of: Chosen) -> Outcome {
    match boards::with(of) {
        Err(reason) => Outcome::Skipped(reason),
        Ok(boards) => boards
            .into_iter()
            .try_for_each(|board| build_images(board, of))
            .and_then(|()| msrv::check_firmware())
            .into(),
    }
}

/// Links the firmware of every board, then compares what it takes.
pub(crate) fn check_all_boards() -> Outcome {
    match link(|_, _| true) {
        Outcome::Passed => check_sizes(|_, _| true),
        other => other,
    }
}

/// The emulated board whose firmware is tested, measured and attacked each time.
pub(crate) const TESTED: &str = "lm3s6965evb";
/// The other emulated board.
const SECOND: &str = "mps2-an386";
/// Exit code of a test that the system does not allow.
pub(crate) const NOT_ALLOWED: i32 = 77;

/// Runs the emulated board's firmware against the Linux manager.
pub(crate) fn test() -> Outcome {
    emulated(|| {
        let board = boards::find(TESTED)?;
        let checked = checked(board)?;
        if checked != Some(0) {
            return Ok(checked);
        }
        tests(board, &board.build(&boards::SLIP)?)?.args(["serial"]).code()
    })
}

/// The same on the other emulated board, which has no driver of a serial line; and makes it fail, and looks at its sizes.
pub(crate) fn test_second() -> Outcome {
    emulated(|| {
        let checked = checked(boards::find(SECOND)?)?;
        if checked != Some(0) {
            return Ok(checked);
        }
        sizes::check_board(SECOND)?;
        faults::injected(&Faults::checked(SECOND), &["--busy-host"])
    })
}

/// What came of a test on the emulated board, which ends with an exit code.
pub(crate) fn emulated(test: impl FnOnce() -> Result<Option<i32>>) -> Outcome {
    ended(install::program("qemu-system-arm", "qemu-system-arm"), test)
}

fn ended(emulator: Result<(), String>, test: impl FnOnce() -> Result<Option<i32>>) -> Outcome {
    if let Err(reason) = emulator {
        return Outcome::Skipped(reason);
    }
    match test() {
        Ok(Some(NOT_ALLOWED)) => Outcome::Skipped("this user cannot make a network with virtual devices".into()),
        Ok(Some(0)) => Outcome::Passed,
        Ok(code) => Outcome::Failed(format!("exit code {code:?}")),
        Err(error) => Outcome::Failed(format!("{error:#}")),
    }
}

/// Runs an RP2040's firmware in rp2040js against the Linux manager.
pub(crate) fn test_rp2040() -> Outcome {
    let node = install::program("node", "nodejs").and_then(|()| install::program("npm", "npm"));
    ended(node, || {
        let board = boards::find("rp2040")?;
        install::rust_target(board.target).map_err(anyhow::Error::msg)?;
        let image = board.build(&boards::AGV)?;
        uf2::write_beside(&image, cara_settings::board::find(board.name).context("it has no pages for settings")?)?;
        let scripts = workspace::root().join("tests/rp2040");
        Run::new("npm").args(["ci", "--silent", "--prefix"]).args([&scripts]).stream()?;
        let plain = tests(board, &image)?.args(["--insecure", "--restarts", "12", "rp2040"]).code()?;
        if plain != Some(0) {
            return Ok(plain);
        }
        tests(board, &image)?.args(["rp2040"]).code()
    })
}

fn checked(board: &Board) -> Result<Option<i32>> {
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    let [image, constant] = [board.build(&boards::AGV)?, board.build(&boards::CONSTANT)?];
    let checked = tests(board, &image)?.args(["--constant".as_ref(), constant.as_os_str()]).code()?;
    if checked != Some(0) {
        return Ok(checked);
    }
    tests(board, &board.build(&boards::STREAMS)?)?.args(["streams", "--rounds", "1"]).code()
}

/// Flash of the least unit on a line without IP, at most: 90 KiB.
const LEAST_ON_LINE: u64 = 90 * 1024;

/// Runs the emulated board on a serial line without IP, and looks how small a unit is there.
pub(crate) fn line() -> Outcome {
    emulated(|| {
        let board = boards::find(TESTED)?;
        install::rust_target(board.target).map_err(anyhow::Error::msg)?;
        let Footprint { flash, static_ram } = footprint(&board.build(&boards::UNIT_LINE)?)?;
        println!("{}: flash {flash}, static RAM {static_ram}", boards::UNIT_LINE.name);
        if flash > LEAST_ON_LINE {
            bail!("that is more than {LEAST_ON_LINE}");
        }
        tests(board, &board.build(&boards::LINE)?)?.args(["serial", "--native"]).code()
    })
}

/// Shows and records the emulated board's log, by a `cara` that reads defmt.
pub(crate) fn logs() -> Outcome {
    emulated(|| {
        let board = boards::find(TESTED)?;
        install::rust_target(board.target).map_err(anyhow::Error::msg)?;
        let tests = tests(board, &board.build(&boards::LOGGED)?)?;
        // Behind the builds of the `cara` without: the last one lies beside the tests.
        binaries::debug_build(&["cara"]).args(["--features", "cara-cli/defmt"]).stream()?;
        tests.args(["logs"]).code()
    })
}

/// Hands the emulated board over between two Linux managers, then takes its manager away, which has a standby.
pub(crate) fn hand_over() -> Outcome {
    emulated(|| {
        let board = boards::find(TESTED)?;
        install::rust_target(board.target).map_err(anyhow::Error::msg)?;
        let image = board.build(&boards::HANDED)?;
        let handed = tests(board, &image)?.args(["hand-over"]).code()?;
        if handed != Some(0) {
            return Ok(handed);
        }
        tests(board, &image)?.args(["standby"]).code()
    })
}

/// The emulated board's firmware of other sources beside this version's manager, and the other way round; the programs of the
/// other version are in a folder.
pub(crate) fn beside(sources: &Path, theirs: &Path) -> Outcome {
    emulated(|| {
        let board = boards::find(TESTED)?;
        install::rust_target(board.target).map_err(anyhow::Error::msg)?;
        let image = board.build_of(sources, &boards::AGV, theirs)?;
        let restarts = ["--restarts", "3"];
        let checked = tests(board, &image)?.args(restarts).code()?;
        if checked != Some(0) {
            return Ok(checked);
        }
        let image = board.build(&boards::AGV)?;
        let tests = Run::new(&theirs.join("cara-firmware-tests").to_string_lossy()).args(["--board", board.name]);
        tests.args(["--image".as_ref(), image.as_os_str()]).args(restarts).code()
    })
}

/// Attacks the emulated board and writes the figures to a file; why not, where it cannot be.
pub(crate) fn attack(figures: &Path) -> Result<Option<String>> {
    attacked(&["security".as_ref(), "--json".as_ref(), figures.as_os_str()])
}

/// Starts emulated boards beside recorded and forged discovery; why not, where it cannot be.
pub(crate) fn kept_away(starts: &str) -> Result<Option<String>> {
    attacked(&["kept-away".as_ref(), "--starts".as_ref(), starts.as_ref()])
}

fn attacked(arguments: &[&OsStr]) -> Result<Option<String>> {
    let attacked = || tests(boards::find(TESTED)?, &emulated_image(&boards::AGV)?)?.args(arguments).code();
    match emulated(attacked) {
        Outcome::Passed => Ok(None),
        Outcome::Skipped(reason) => Ok(Some(reason)),
        Outcome::Failed(why) => bail!("attacks on a board: {why}"),
    }
}

/// The image of a vehicle of the warehouse.
pub(crate) fn warehouse_image() -> Result<PathBuf> {
    emulated_image(&boards::WAREHOUSE)
}

/// Builds an image of the emulated board.
fn emulated_image(image: &Image) -> Result<PathBuf> {
    let board = boards::find(TESTED)?;
    install::rust_target(board.target).map_err(anyhow::Error::msg)?;
    board.build(image)
}

/// The program that runs images, about to be run with one of a board. It uses the `cara` command beside it.
pub(crate) fn tests(board: &Board, image: &Path) -> Result<Run> {
    binaries::build(&["cara"])?;
    let tests = binaries::debug("cara-firmware-tests")?.args(["--board", board.name]);
    Ok(tests.args(["--image".as_ref(), image.as_os_str()]))
}

fn chosen(name: Option<&str>) -> Result<Vec<&'static Board>> {
    match name {
        None => Ok(BOARDS.iter().collect()),
        Some(name) => Ok(vec![boards::find(name)?]),
    }
}
