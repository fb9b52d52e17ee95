//! The chip's peripherals.
#![allow(unsafe_code)]

use cara_emulated::register::Block;
pub(crate) use cara_emulated::register::{Register, unmask};

/// Those at an address of the data sheet's memory map.
const fn block(address: usize) -> Block {
    // SAFETY: called for the constants below only. Blocks whose clock is off fault, and their modules switch it on first; none of
    // them writes to memory by itself.
    unsafe { Block::new(address) }
}

/// Ethernet controller.
#[cfg(feature = "net")]
pub(crate) const ETHERNET: Block = block(0x4004_8000);
/// Serial line 0.
#[cfg(any(feature = "line", feature = "slip"))]
pub(crate) const UART_0: Block = block(0x4000_C000);
/// General-purpose inputs and outputs, port A.
#[cfg(any(feature = "line", feature = "slip"))]
pub(crate) const PORT_A: Block = block(0x4000_4000);
/// General-purpose timer 0.
pub(crate) const TIMER_0: Block = block(0x4003_0000);
/// General-purpose timer 1.
pub(crate) const TIMER_1: Block = block(0x4003_1000);
/// General-purpose inputs and outputs, port F.
pub(crate) const PORT_F: Block = block(0x4002_5000);
/// System control.
pub(crate) const SYSTEM: Block = block(0x400F_E000);
/// Watchdog timer.
pub(crate) const WATCHDOG: Block = block(0x4000_0000);
