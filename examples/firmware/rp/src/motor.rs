//! The motors' enable, and how these boards do what [`cara_board`] decides. The pin is GP15.
#![allow(unsafe_code)]

use cara_board::{Place, Reason};
use embassy_rp::clocks::clk_sys_freq;
use embassy_rp::gpio::{Level, Output};
use embassy_rp::peripherals::{PIN_15, WATCHDOG};
use embassy_rp::watchdog::Watchdog;
use embassy_rp::{Peri, pac};

use crate::parts::HANGS;

const PIN: u32 = 1 << 15;
const HERTZ_OF_TICKS: u32 = 1_000;

/// This board.
struct Board;

cara_board::guard!(Board);
cara_board::tick_by_systick!(Board, cara_vehicle::may_move);

/// Makes the pin an output that is off, and lets the interrupt look.
pub(crate) fn start(pin: Peri<'static, PIN_15>) {
    // Dropping it would make the pin an input.
    core::mem::forget(Output::new(pin, Level::Low));
    cara_board::start_systick(clk_sys_freq() / HERTZ_OF_TICKS);
}

/// The watchdog, which is fed and triggered from interrupts and from programs that have failed.
fn watchdog() -> Watchdog {
    // SAFETY: single writes to its registers, besides its start, which comes before.
    Watchdog::new(unsafe { WATCHDOG::steal() })
}

impl cara_board::Board for Board {
    fn motors(on: bool) {
        let output = pac::SIO.gpio_out(0);
        let register = if on { output.value_set() } else { output.value_clr() };
        register.write_value(PIN);
    }

    fn feed() {
        watchdog().feed(HANGS);
    }

    fn ended(reason: Reason, place: Place<'_>) {
        defmt::error!("{} at {=str}:{=u32:#x}", reason, place.file, place.at);
    }

    /// Through the watchdog, which resets all of the chip, pins included.
    fn reset() -> ! {
        watchdog().trigger_reset();
        loop {
            cortex_m::asm::nop();
        }
    }
}
