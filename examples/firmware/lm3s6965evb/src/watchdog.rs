//! Starts the board again when it is not fed (data sheet, Watchdog Timer). A handler that hangs ends so.
//!
//! When it runs out for the first time its interrupt leaves a note for the next life, because the emulated chip's register
//! does not tell; when it runs out for the second time, it resets.

use cara_board::Reason;
use embassy_time::Duration;
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

/// A board that has not been fed for so long starts again.
const HANGS: Duration = Duration::from_secs(4);
/// Cycles of the system clock in a millisecond.
const CYCLES: u32 = 12_500;

/// Cycles from feeding until it runs out for the first time: it resets when it runs out for the second time.
const LOAD: u32 = HANGS.as_millis() as u32 * CYCLES / 2;

/// Starts it, once. It cannot be stopped; [`cara_board::tick`] feeds it.
pub fn start() {
    RCGC0.set(RCGC0_WATCHDOG);
    WDTLOCK.write(UNLOCK);
    WDTLOAD.write(LOAD);
    WDTCTL.write(COUNT_AND_RESET);
    WDTLOCK.write(LOCK);
    unmask(Interrupt::WATCHDOG_TIMER_0);
}

/// The board lives.
pub(crate) fn feed() {
    // Without a clock its registers fault.
    if RCGC0.read() & RCGC0_WATCHDOG == 0 {
        return;
    }
    WDTLOCK.write(UNLOCK);
    WDTICR.write(1);
    WDTLOAD.write(LOAD);
    WDTLOCK.write(LOCK);
}

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    /// The interrupt stays pending: nothing but the reset is to come.
    #[interrupt]
    fn WATCHDOG_TIMER_0() {
        cara_board::leave(Reason::Watchdog, 0);
    }
}
