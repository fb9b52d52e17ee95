//! Starts the board again when nobody feeds it (data sheet, Watchdog Timer). A handler that hangs ends so.
//!
//! When it runs out for the first time its interrupt leaves a note for the next life (`note.rs`); when it runs out
//! for the second time, it resets.

use lm3s6965::{Interrupt, interrupt};

use crate::note::{self, Note};
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

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    /// The interrupt stays pending: nothing but the reset is to come.
    #[interrupt]
    fn WATCHDOG_TIMER_0() {
        note::leave(Note::Watchdog);
    }
}
