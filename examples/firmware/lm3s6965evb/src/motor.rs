//! The motors' enable, a pin, and the interrupt that decides about it each millisecond, as [`cara_board`] says (data sheet,
//! General-Purpose Input/Outputs; General-Purpose Timers).

use cara_emulated::{TICK, may_move};
use lm3s6965::{Interrupt, interrupt};

use crate::fault::Board;
use crate::register::{PORT_F, Register, SYSTEM, TIMER_1, unmask};

const RCGC1: Register = SYSTEM.at(0x104);
const RCGC1_TIMER_1: u32 = 1 << 17;
const RCGC2: Register = SYSTEM.at(0x108);
const RCGC2_PORT_F: u32 = 1 << 5;

const GPTMCFG: Register = TIMER_1.at(0x000);
const GPTMTAMR: Register = TIMER_1.at(0x004);
const GPTMCTL: Register = TIMER_1.at(0x00C);
const GPTMIMR: Register = TIMER_1.at(0x018);
const GPTMICR: Register = TIMER_1.at(0x024);
const GPTMTAILR: Register = TIMER_1.at(0x028);
const PERIODIC: u32 = 2;
const ENABLE: u32 = 1;
const TIMEOUT: u32 = 1;

/// The pin, PF0, at which the board has its LED; its data register reads and writes no other.
const PIN: u32 = 1;
const PIN_DATA: Register = PORT_F.at((PIN as usize) << 2);
const GPIODIR: Register = PORT_F.at(0x400);
const GPIODEN: Register = PORT_F.at(0x51C);

/// Cycles of the system clock in a microsecond, doubled.
const CYCLES_DOUBLED: u32 = 25;

/// Makes the pin an output that is off, and lets the interrupt look at the lease. Once, at the start; `true` if the pin
/// was on before, as nothing but a missing reset could have left it.
pub fn start() -> bool {
    RCGC1.set(RCGC1_TIMER_1);
    RCGC2.set(RCGC2_PORT_F);
    let was_on = is_on();
    PIN_DATA.write(0);
    GPIODIR.set(PIN);
    GPIODEN.set(PIN);
    GPTMCTL.write(0);
    GPTMCFG.write(0);
    GPTMTAMR.write(PERIODIC);
    GPTMTAILR.write(TICK.as_micros() as u32 * CYCLES_DOUBLED / 2 - 1);
    GPTMICR.write(u32::MAX);
    GPTMIMR.write(TIMEOUT);
    unmask(Interrupt::TIMER_1A);
    GPTMCTL.write(ENABLE);
    was_on
}

/// Whether the motors run.
pub fn is_on() -> bool {
    PIN_DATA.read() & PIN != 0
}

/// Switches them, once the pin is an output.
pub(crate) fn switch(on: bool) {
    // Without a clock its registers fault.
    if RCGC2.read() & RCGC2_PORT_F == 0 {
        return;
    }
    #[cfg(feature = "faults")]
    let before = is_on();
    PIN_DATA.write(if on { PIN } else { 0 });
    #[cfg(feature = "faults")]
    cara_emulated::faults::switched(before, on);
}

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    #[interrupt]
    fn TIMER_1A() {
        GPTMICR.write(TIMEOUT);
        #[cfg(feature = "faults")]
        cara_emulated::faults::tick();
        cara_board::tick::<Board>(may_move());
        #[cfg(feature = "faults")]
        cara_emulated::faults::ticked();
    }
}
