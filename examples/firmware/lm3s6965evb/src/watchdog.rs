//! Starts the board again when nobody feeds it (data sheet, Watchdog Timer). A handler that hangs ends so.
//!
//! When it runs out for the first time its interrupt leaves a note in memory that a reset does not clear; when it runs
//! out for the second time, it resets. The note tells the next life why it began: the emulated chip's own register does
//! not.

use lm3s6965::{Interrupt, interrupt};

use crate::register::{Register, SYSTEM, WATCHDOG, unmask};

const RCGC0: Register = SYSTEM.at(0x100);
const RCGC0_WATCHDOG: u32 = 1 << 3;
const WDTLOAD: Register = WATCHDOG.at(0x000);
const WDTCTL: Register = WATCHDOG.at(0x008);
const WDTICR: Register = WATCHDOG.at(0x00C);
const WDTLOCK: Register = WATCHDOG.at(0xC00);
const UNLOCK: u32 = 0x1ACC_E551;
const LOCK: u32 = 0;
/// Count, and reset when it has run out twice.
const COUNT_AND_RESET: u32 = 0b11;

/// Cycles of the system clock in a millisecond.
const CYCLES: u32 = 12_500;

/// A watchdog that runs. It cannot be stopped.
pub struct Watchdog {
    load: u32,
}

impl Watchdog {
    /// Starts it: the board starts again when it has not been fed for `milliseconds`, at most 340,000.
    pub fn start(milliseconds: u32) -> Self {
        RCGC0.set(RCGC0_WATCHDOG);
        // It resets when it runs out for the second time.
        let load = milliseconds.saturating_mul(CYCLES) / 2;
        WDTLOCK.write(UNLOCK);
        WDTLOAD.write(load);
        WDTCTL.write(COUNT_AND_RESET);
        WDTLOCK.write(LOCK);
        unmask(Interrupt::WATCHDOG_TIMER_0);
        Self { load }
    }

    /// The program lives.
    pub fn feed(&mut self) {
        WDTLOCK.write(UNLOCK);
        WDTICR.write(1);
        WDTLOAD.write(self.load);
        WDTLOCK.write(LOCK);
    }
}

/// Whether the life before this one ended because nobody fed the watchdog. Asking clears the note.
pub(crate) fn has_reset() -> bool {
    note::take()
}

#[allow(unsafe_code)]
mod note {
    use super::*;
    use core::cell::UnsafeCell;
    use core::mem::MaybeUninit;

    struct Note(UnsafeCell<MaybeUninit<u32>>);

    // SAFETY: a word, written whole by the interrupt and read whole before the watchdog runs.
    unsafe impl Sync for Note {}

    /// Not touched when the program starts.
    #[unsafe(link_section = ".uninit.watchdog")]
    static NOTE: Note = Note(UnsafeCell::new(MaybeUninit::uninit()));
    /// What power leaves in memory is hardly this.
    const RAN_OUT: u32 = 0x0DD_F00D;

    pub(super) fn take() -> bool {
        let place = NOTE.0.get().cast::<u32>();
        // SAFETY: RAM that nobody else uses; volatile, so that whatever power has left there is read as it is.
        let found = unsafe { place.read_volatile() };
        unsafe { place.write_volatile(0) };
        found == RAN_OUT
    }

    #[interrupt]
    fn WATCHDOG_TIMER_0() {
        // SAFETY: as above. The interrupt stays pending: nothing but the reset is to come.
        unsafe { NOTE.0.get().cast::<u32>().write_volatile(RAN_OUT) };
    }
}
