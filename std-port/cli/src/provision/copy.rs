//! The bytes of a copy, and where it goes.

use cara_settings::Settings;
use cara_settings::board::Board;
use cara_settings::page::{BYTES, Copy, encode, replaced};
use cara_settings::uf2::{Place, block};

use crate::exit::Ended;

/// A copy to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Written {
    /// Where it goes.
    pub(super) address: u32,
    pub(super) generation: u32,
    pub(super) bytes: [u8; BYTES],
}

/// The copy that comes after those on the board; it replaces the older one.
pub(super) fn next(board: &Board, settings: &Settings, first: &[u8], second: &[u8]) -> anyhow::Result<Written> {
    let [one, two] = board.pages;
    let (copy, generation) = replaced(first, second);
    let address = match copy {
        Copy::First => one,
        Copy::Second => two,
    };
    written(settings, address, generation)
}

/// Both copies, for a board of which nobody knows what it holds.
pub(super) fn both(board: &Board, settings: &Settings) -> anyhow::Result<Vec<Written>> {
    (1..).zip(board.pages).map(|(generation, address)| written(settings, address, generation)).collect()
}

fn written(settings: &Settings, address: u32, generation: u32) -> anyhow::Result<Written> {
    // What is not written stays as erased flash is.
    let mut bytes = [0xFF; BYTES];
    match encode(settings, generation, &mut bytes) {
        Some(_) => Ok(Written { address, generation, bytes }),
        None => Err(Ended::usage("the settings are longer than a page")),
    }
}

/// The same as a UF2 file.
pub(super) fn uf2(written: &[Written], family: u32) -> Vec<u8> {
    let total = written.len() as u32;
    let place = |number, address| Place { address, number, total, family };
    (0..).zip(written).flat_map(|(number, copy)| block(place(number, copy.address), &copy.bytes)).collect()
}
