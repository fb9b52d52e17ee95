//! The chip's peripherals.
#![allow(unsafe_code)]

use cara_emulated::register::Block;
pub(crate) use cara_emulated::register::{Register, unmask};

/// Those at an address of the board's memory map.
const fn block(address: usize) -> Block {
    // SAFETY: called for the constants below only, which are always mapped; none of them writes to memory by itself.
    unsafe { Block::new(address) }
}

/// Timer 0 (CMSDK, APB timer).
pub(crate) const TIMER_0: Block = block(0x4000_0000);
/// Timer 1.
pub(crate) const TIMER_1: Block = block(0x4000_1000);
/// Watchdog (CMSDK, APB watchdog).
pub(crate) const WATCHDOG: Block = block(0x4000_8000);
/// System controller (CMSDK).
pub(crate) const SYSTEM: Block = block(0x4001_F000);
/// LEDs and buttons (board, FPGA system control and I/O).
pub(crate) const FPGAIO: Block = block(0x4002_8000);
/// Ethernet controller.
pub(crate) const ETHERNET: Block = block(0x4020_0000);
