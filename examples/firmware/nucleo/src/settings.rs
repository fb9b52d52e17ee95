//! The settings in flash.
#![allow(unsafe_code)]

use cara_settings::Settings;
use cara_settings::board;
use cara_settings::page::{self, PageError};

#[cfg(feature = "f767zi")]
const BOARD: board::Board = board::NUCLEO_F767ZI;
#[cfg(feature = "h743zi")]
const BOARD: board::Board = board::NUCLEO_H743ZI;

/// The newest sound copy.
pub(crate) fn read() -> Result<Settings, PageError> {
    let [first, second] = BOARD.pages.map(page);
    page::newest(first, second)
}

fn page(address: u32) -> &'static [u8] {
    // SAFETY: flash of the chip, in which the linker script puts nothing and which nothing here writes.
    unsafe { core::slice::from_raw_parts(address as *const u8, page::BYTES) }
}
