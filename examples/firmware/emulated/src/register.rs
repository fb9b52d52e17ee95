//! Registers of peripherals: the one place that reads and writes addresses. A board names its blocks.
#![allow(unsafe_code)]

use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::NVIC;

/// A register of 32 bits.
#[derive(Clone, Copy)]
pub struct Register(*mut u32);

// SAFETY: every context sees the same register, and each access is volatile; the peripheral's module decides which
// context accesses it when.
unsafe impl Sync for Register {}

/// The registers of a peripheral.
#[derive(Clone, Copy)]
pub struct Block(usize);

impl Block {
    /// The registers from this address on.
    ///
    /// # Safety
    /// From there on lie 4 KiB of a peripheral which is always mapped, or whose owner sees to that, and does not write to memory
    /// by itself.
    pub const unsafe fn new(address: usize) -> Self {
        Self(address)
    }

    /// The register at an offset in bytes. An offset beyond the block's 4 KiB does not compile.
    pub const fn at(self, offset: usize) -> Register {
        assert!(offset < 0x1000 && offset.is_multiple_of(4));
        Register((self.0 + offset) as *mut u32)
    }
}

impl Register {
    /// Reads it.
    pub fn read(self) -> u32 {
        // SAFETY: `Block::at` makes aligned addresses within a peripheral.
        unsafe { self.0.read_volatile() }
    }

    /// Writes it.
    pub fn write(self, value: u32) {
        // SAFETY: as for `read`.
        unsafe { self.0.write_volatile(value) }
    }

    /// Sets bits, and leaves the others. Not for registers that an interrupt changes, unless interrupts are off.
    pub fn set(self, bits: u32) {
        self.write(self.read() | bits);
    }
}

/// Lets an interrupt through.
pub fn unmask(interrupt: impl InterruptNumber) {
    // SAFETY: no critical section here is built on masked interrupts; they disable all of them.
    unsafe { NVIC::unmask(interrupt) }
}
