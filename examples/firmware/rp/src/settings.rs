//! The settings in flash.
#![allow(unsafe_code)]

use cara_settings::Settings;
use cara_settings::board;
use cara_settings::page::{self, PageError};

#[cfg(feature = "rp2040")]
const BOARD: board::Board = board::RP2040_W5500;
#[cfg(feature = "rp2350")]
const BOARD: board::Board = board::RP2350_W5500;
#[cfg(feature = "pico2w")]
const BOARD: board::Board = board::PICO2W;

/// The newest sound copy.
pub(crate) fn read() -> Result<Settings, PageError> {
    let [first, second] = BOARD.pages.map(page);
    page::newest(first, second)
}

fn page(address: u32) -> &'static [u8] {
    // SAFETY: flash, mapped, in which the linker script puts nothing and which nothing here writes.
    unsafe { core::slice::from_raw_parts(address as *const u8, page::BYTES) }
}
