//! embassy's time: SysTick, and general-purpose timer 0 for alarms (data sheet: System Timer; General-Purpose Timers).

use cara_emulated::clock::{Alarm, Clock};
use cortex_m::peripheral::SYST;
use lm3s6965::{Interrupt, interrupt};

use crate::register::{Register, SYSTEM, TIMER_0, unmask};

const RCGC1: Register = SYSTEM.at(0x104);
const RCGC1_TIMER_0: u32 = 1 << 16;

const GPTMCFG: Register = TIMER_0.at(0x000);
const GPTMTAMR: Register = TIMER_0.at(0x004);
const GPTMCTL: Register = TIMER_0.at(0x00C);
const GPTMIMR: Register = TIMER_0.at(0x018);
const GPTMICR: Register = TIMER_0.at(0x024);
const GPTMTAILR: Register = TIMER_0.at(0x028);
const ONE_SHOT: u32 = 1;
const ENABLE: u32 = 1;
const TIMEOUT: u32 = 1;

struct Timer0;

impl Alarm for Timer0 {
    /// QEMU's board runs at 12.5 MHz after reset.
    const CYCLES: u64 = 25;

    fn set(cycles: u32) {
        GPTMTAILR.write(cycles);
        GPTMCTL.write(ENABLE);
    }

    fn stop() {
        GPTMCTL.write(0);
    }
}

embassy_time_driver::time_driver_impl!(static CLOCK: Clock<Timer0> = Clock::new());

/// Starts the clock at zero.
pub(crate) fn start(systick: &mut SYST) {
    RCGC1.set(RCGC1_TIMER_0);
    GPTMCTL.write(0);
    GPTMCFG.write(0);
    GPTMTAMR.write(ONE_SHOT);
    GPTMICR.write(u32::MAX);
    GPTMIMR.write(TIMEOUT);
    unmask(Interrupt::TIMER_0A);
    CLOCK.start(systick);
}

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    #[cortex_m_rt::exception]
    fn SysTick() {
        CLOCK.wrapped();
    }

    #[interrupt]
    fn TIMER_0A() {
        GPTMICR.write(TIMEOUT);
        CLOCK.alarmed();
    }
}
