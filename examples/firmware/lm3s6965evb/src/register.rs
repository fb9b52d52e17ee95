//! Registers of the chip's peripherals: the one place that reads and writes addresses.
#![allow(unsafe_code)]

use cortex_m::peripheral::NVIC;
use lm3s6965::Interrupt;

/// A register of 32 bits.
#[derive(Clone, Copy)]
pub(crate) struct Register(*mut u32);

// SAFETY: every context sees the same register, and each access is volatile; the peripheral's module decides which
// context accesses it when.
unsafe impl Sync for Register {}

/// The registers of a peripheral.
#[derive(Clone, Copy)]
pub(crate) struct Block(usize);

/// Ethernet controller.
#[cfg(feature = "net")]
pub(crate) const ETHERNET: Block = Block(0x4004_8000);
/// Serial line 0.
#[cfg(any(feature = "line", feature = "slip"))]
pub(crate) const UART_0: Block = Block(0x4000_C000);
/// General-purpose inputs and outputs, port A.
#[cfg(any(feature = "line", feature = "slip"))]
pub(crate) const PORT_A: Block = Block(0x4000_4000);
/// General-purpose timer 0.
pub(crate) const TIMER_0: Block = Block(0x4003_0000);
/// General-purpose timer 1.
pub(crate) const TIMER_1: Block = Block(0x4003_1000);
/// General-purpose inputs and outputs, port F.
pub(crate) const PORT_F: Block = Block(0x4002_5000);
/// System control.
pub(crate) const SYSTEM: Block = Block(0x400F_E000);
/// Watchdog timer.
pub(crate) const WATCHDOG: Block = Block(0x4000_0000);

impl Block {
    /// The register at an offset in bytes. An offset beyond the block's 4 KiB does not compile.
    pub(crate) const fn at(self, offset: usize) -> Register {
        assert!(offset < 0x1000 && offset.is_multiple_of(4));
        Register((self.0 + offset) as *mut u32)
    }
}

impl Register {
    /// Reads it.
    pub(crate) fn read(self) -> u32 {
        // SAFETY: `Block::at` makes aligned addresses within the peripherals of this chip, which are always mapped.
        unsafe { self.0.read_volatile() }
    }

    /// Writes it.
    pub(crate) fn write(self, value: u32) {
        // SAFETY: as for `read`; no peripheral named here writes to memory by itself.
        unsafe { self.0.write_volatile(value) }
    }

    /// Sets bits, and leaves the others. Not for registers that an interrupt changes, unless interrupts are off.
    pub(crate) fn set(self, bits: u32) {
        self.write(self.read() | bits);
    }
}

/// Lets an interrupt through.
pub(crate) fn unmask(interrupt: Interrupt) {
    // SAFETY: no critical section here is built on masked interrupts; they disable all of them.
    unsafe { NVIC::unmask(interrupt) }
}
