//! embassy's time: SysTick, and timer 0 for alarms (CMSDK, APB timer).

use cara_emulated::clock::{Alarm, Clock};
use cortex_m::peripheral::SYST;

use crate::interrupt::Interrupt;
use crate::register::{Register, TIMER_0, unmask};

const CTRL: Register = TIMER_0.at(0x000);
const VALUE: Register = TIMER_0.at(0x004);
const RELOAD: Register = TIMER_0.at(0x008);
const INTCLEAR: Register = TIMER_0.at(0x00C);
pub(crate) const ENABLE_AND_INTERRUPT: u32 = 1 | 1 << 3;

struct Timer0;

impl Alarm for Timer0 {
    /// Of 25 MHz.
    const CYCLES: u64 = 50;

    fn set(cycles: u32) {
        // It begins anew by itself, and is set anew, or stopped, when it has fired.
        RELOAD.write(cycles);
        VALUE.write(cycles);
        CTRL.write(ENABLE_AND_INTERRUPT);
    }

    fn stop() {
        CTRL.write(0);
    }
}

embassy_time_driver::time_driver_impl!(static CLOCK: Clock<Timer0> = Clock::new());

/// Starts the clock at zero.
pub(crate) fn start(systick: &mut SYST) {
    Timer0::stop();
    INTCLEAR.write(1);
    unmask(Interrupt::Timer0);
    CLOCK.start(systick);
}

/// Timer 0's interrupt.
pub(crate) extern "C" fn alarm() {
    INTCLEAR.write(1);
    CLOCK.alarmed();
}

#[allow(unsafe_code)]
#[cortex_m_rt::exception]
fn SysTick() {
    CLOCK.wrapped();
}
