//! Where a panic or a fault ends: the motors are cut off, the log says where it was, and the board starts again.
//! [`crate::reset`] then tells "program".
#![allow(unsafe_code)]

use cortex_m::peripheral::SCB;

use crate::motor;
use crate::note::{self, Note};

/// Exit code of a program that cannot start: starting again would not help.
pub const NOT_STARTED: i32 = 101;

#[panic_handler]
fn panic(information: &core::panic::PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    motor::cut_off();
    match information.location() {
        Some(place) => cara_vehicle::error!("panic at {=str}:{=u32}", place.file(), place.line()),
        None => cara_vehicle::error!("panic"),
    }
    start_again()
}

#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &cortex_m_rt::ExceptionFrame) -> ! {
    cortex_m::interrupt::disable();
    motor::cut_off();
    cara_vehicle::error!("fault at {=u32:#x}, called from {=u32:#x}", frame.pc(), frame.lr());
    start_again()
}

fn start_again() -> ! {
    note::leave(Note::Program);
    SCB::sys_reset()
}
