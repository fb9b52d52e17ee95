//! The motors' enable, which is LED 0, and the interrupt that decides about it each millisecond, as [`cara_board`] says (board, FPGA
//! system control and I/O; CMSDK, APB timer).

use cara_emulated::{TICK, may_move};

use crate::clock::ENABLE_AND_INTERRUPT;
use crate::fault::Board;
use crate::interrupt::Interrupt;
use crate::register::{FPGAIO, Register, TIMER_1, unmask};

const LEDS: Register = FPGAIO.at(0x000);
const LED_0: u32 = 1;

const CTRL: Register = TIMER_1.at(0x000);
const VALUE: Register = TIMER_1.at(0x004);
const RELOAD: Register = TIMER_1.at(0x008);
const INTCLEAR: Register = TIMER_1.at(0x00C);

/// Cycles of the timer's clock, 25 MHz, from one look to the next.
const CYCLES: u32 = TICK.as_micros() as u32 * 25;

/// Switches them off, and lets the interrupt look at the lease. Once, at the start; `true` if they were on before, as nothing but a
/// missing reset could have left them.
pub fn start() -> bool {
    let was_on = is_on();
    LEDS.write(0);
    RELOAD.write(CYCLES - 1);
    VALUE.write(CYCLES - 1);
    INTCLEAR.write(1);
    unmask(Interrupt::Timer1);
    CTRL.write(ENABLE_AND_INTERRUPT);
    was_on
}

fn is_on() -> bool {
    LEDS.read() & LED_0 != 0
}

/// Switches them.
pub(crate) fn switch(on: bool) {
    #[cfg(feature = "faults")]
    let before = is_on();
    LEDS.write(if on { LED_0 } else { 0 });
    #[cfg(feature = "faults")]
    cara_emulated::faults::switched(before, on);
}

/// Timer 1's interrupt.
pub(crate) extern "C" fn tick() {
    INTCLEAR.write(1);
    #[cfg(feature = "faults")]
    cara_emulated::faults::tick();
    cara_board::tick::<Board>(may_move());
    #[cfg(feature = "faults")]
    cara_emulated::faults::ticked();
}
