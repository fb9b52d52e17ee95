//! Where a panic or a fault ends: it says so, and the board starts again. [`crate::reset`] then tells "program".
#![allow(unsafe_code)]

use embassy_rp::peripherals::WATCHDOG;
use embassy_rp::watchdog::Watchdog;

/// Cycles for a debug probe to fetch the last line: some tens of milliseconds.
const TO_BE_READ: u32 = 10_000_000;

#[panic_handler]
fn panic(information: &core::panic::PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    match information.location() {
        Some(place) => defmt::error!("panic at {=str}:{=u32}", place.file(), place.line()),
        None => defmt::error!("panic"),
    }
    start_again()
}

#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &cortex_m_rt::ExceptionFrame) -> ! {
    defmt::error!("fault at {=u32:#x}, called from {=u32:#x}", frame.pc(), frame.lr());
    start_again()
}

/// Through the watchdog, whose register then tells that the program asked for it.
fn start_again() -> ! {
    cortex_m::asm::delay(TO_BE_READ);
    // SAFETY: nothing else runs any more.
    Watchdog::new(unsafe { WATCHDOG::steal() }).trigger_reset();
    loop {
        cortex_m::asm::nop();
    }
}
