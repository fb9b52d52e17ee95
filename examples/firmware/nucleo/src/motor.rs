//! The motors' enable, and how this board does what [`cara_board`] decides. The pin is PF13, D7 on connector CN10.

use cara_board::{Place, Reason};
use cortex_m::peripheral::SCB;
use embassy_stm32::Peri;
use embassy_stm32::gpio::{Level, Output, Speed};
use embassy_stm32::pac::GPIOF;
#[cfg(feature = "f7")]
use embassy_stm32::pac::IWDG;
#[cfg(feature = "h7")]
use embassy_stm32::pac::IWDG1 as IWDG;
use embassy_stm32::pac::iwdg::vals::Key;
use embassy_stm32::peripherals::PF13;

use crate::clocks;

const PIN: usize = 13;

/// This board.
struct Board;

cara_board::guard!(Board);
cara_board::tick_by_systick!(Board, cara_vehicle::may_move);

/// Makes the pin an output that is off, and lets the interrupt look.
pub(crate) fn start(pin: Peri<'static, PF13>) {
    // Dropping it would make the pin an input.
    core::mem::forget(Output::new(pin, Level::Low, Speed::Low));
    cara_board::start_systick(clocks::CYCLES);
}

impl cara_board::Board for Board {
    fn motors(on: bool) {
        GPIOF.bsrr().write(|register| match on {
            true => register.set_bs(PIN, true),
            false => register.set_br(PIN, true),
        });
    }

    fn feed() {
        IWDG.kr().write(|register| register.set_key(Key::RESET));
    }

    fn ended(reason: Reason, place: Place<'_>) {
        defmt::error!("{} at {=str}:{=u32:#x}", reason, place.file, place.at);
    }

    fn reset() -> ! {
        SCB::sys_reset()
    }
}
