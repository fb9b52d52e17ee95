//! What flash keeps: the settings with the keys, and the count of the board's lives with the claim that it obeys.
#![allow(unsafe_code)]

use cara_settings::board;
use cara_settings::boots::Boots;
use cara_settings::page;
use embassy_rp::flash::{self, Blocking};
use embassy_rp::peripherals::FLASH;
use static_cell::StaticCell;

/// The build script chooses it by the feature.
const BOARD: board::Board = board::of_feature(env!("CARA_BOARD"));

#[cfg(not(feature = "pico2w"))]
const BYTES: usize = 2 * 1024 * 1024;
#[cfg(feature = "pico2w")]
const BYTES: usize = 4 * 1024 * 1024;

/// The driver.
pub type Flash = flash::Flash<'static, FLASH, Blocking, BYTES>;

/// Where flash begins; drivers count from there.
const START: u32 = 0x1000_0000;

/// The count of the board's lives.
pub type Lives = Boots<Flash>;

/// The two pages with settings and keys.
pub(crate) fn pages() -> [&'static [u8]; 2] {
    BOARD.pages.map(page)
}

/// The count of the board's lives, in pages of its own. Called once.
pub(crate) fn lives(flash: Flash) -> &'static mut Lives {
    static LIVES: StaticCell<Lives> = StaticCell::new();
    LIVES.init(Boots::new(flash, BOARD.boots.map(|address| address - START), BOARD.erase_bytes))
}

fn page(address: u32) -> &'static [u8] {
    // SAFETY: flash, mapped, in which the linker script puts nothing and which nothing here writes.
    unsafe { core::slice::from_raw_parts(address as *const u8, page::BYTES) }
}
