//! Where a panic or a fault ends: it says so, and the emulator exits with a code that tells which it was. On a vehicle
//! the watchdog would start the board again, and [`crate::reset`] would tell why.
#![allow(unsafe_code)]

/// Exit code of a panic.
pub const PANICKED: i32 = 101;
/// Exit code of a fault.
pub const FAULTED: i32 = 102;

#[panic_handler]
fn panic(information: &core::panic::PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    match information.location() {
        Some(place) => cara_vehicle::error!("panic at {=str}:{=u32}", place.file(), place.line()),
        None => cara_vehicle::error!("panic"),
    }
    semihosting::process::exit(PANICKED)
}

#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &cortex_m_rt::ExceptionFrame) -> ! {
    cara_vehicle::error!("fault at {=u32:#x}, called from {=u32:#x}", frame.pc(), frame.lr());
    semihosting::process::exit(FAULTED)
}
