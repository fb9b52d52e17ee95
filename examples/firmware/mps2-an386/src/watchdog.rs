//! Ends the program when it is not fed (CMSDK, APB watchdog). A handler that hangs ends so, also with interrupts masked.
//!
//! When it runs out, its interrupt, which is the processor's NMI, ends the program. If that hangs too, it runs out again and resets.

use cara_board::{Place, Reason};
use embassy_time::Duration;

use crate::fault::Board;
use crate::register::{Register, WATCHDOG};

const WDOGLOAD: Register = WATCHDOG.at(0x000);
const WDOGCONTROL: Register = WATCHDOG.at(0x008);
const WDOGINTCLR: Register = WATCHDOG.at(0x00C);
const WDOGLOCK: Register = WATCHDOG.at(0xC00);
const UNLOCK: u32 = 0x1ACC_E551;
const LOCK: u32 = 0;
const INTERRUPT_AND_RESET: u32 = 0b11;

/// A board that has not been fed for so long ends.
const HANGS: Duration = Duration::from_secs(4);
/// At 25 MHz.
const CYCLES: u32 = HANGS.as_micros() as u32 * 25;

/// Starts it, once. It cannot be stopped; [`cara_board::tick`] feeds it.
pub fn start() {
    WDOGLOCK.write(UNLOCK);
    WDOGLOAD.write(CYCLES);
    WDOGCONTROL.write(INTERRUPT_AND_RESET);
    WDOGLOCK.write(LOCK);
}

/// The board lives.
pub(crate) fn feed() {
    WDOGLOCK.write(UNLOCK);
    // It begins anew with what it was loaded with.
    WDOGINTCLR.write(1);
    WDOGLOCK.write(LOCK);
}

#[allow(unsafe_code)]
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() -> ! {
    cara_board::end::<Board>(Reason::Watchdog, Place::NOWHERE)
}
