//! How this board does what [`cara_board`] decides, and where its panics and faults end.

use cara_board::{Place, Reason};
use cortex_m::peripheral::{MPU, SCB};

use crate::{motor, watchdog};

/// This board.
pub(crate) struct Board;

cara_board::guard!(Board);

impl cara_board::Board for Board {
    fn motors(on: bool) {
        motor::switch(on);
    }

    fn feed() {
        watchdog::feed();
    }

    fn ended(reason: Reason, place: Place<'_>) {
        #[cfg(feature = "faults")]
        cara_emulated::faults::ended(reason);
        match reason {
            Reason::Panic => cara_vehicle::error!("panic at {=str}:{=u32}", place.file, place.at),
            Reason::Fault => cara_vehicle::error!("fault at {=u32:#x}", place.at),
            Reason::Watchdog => cara_vehicle::error!("the watchdog has run out"),
            _ => cara_vehicle::error!("the stack has overflown"),
        }
    }

    fn reset() -> ! {
        SCB::sys_reset()
    }
}

/// Where the stack ends.
const STACK_END: u32 = 0x2000_0000;
/// Bytes below it that nobody may touch, as a power of two: a frame that is larger, and not touched from its end on, goes unnoticed.
const GUARDED: u32 = 16;
const NOT_EXECUTED: u32 = 1 << 28;
const ENABLE: u32 = 1;
/// All other memory is as without the unit.
const DEFAULT_ELSEWHERE: u32 = 1 << 2;

/// Makes what lies below the stack fault: there the emulator takes writes and forgets them (Armv7-M Architecture Reference Manual,
/// Protected Memory System Architecture).
#[allow(unsafe_code)]
pub(crate) fn guard_stack(mpu: &mut MPU) {
    // SAFETY: takes accesses away, of memory in which nothing lies.
    unsafe {
        mpu.rnr.write(0);
        mpu.rbar.write(STACK_END - (1 << GUARDED));
        mpu.rasr.write(NOT_EXECUTED | (GUARDED - 1) << 1 | ENABLE);
        mpu.ctrl.write(DEFAULT_ELSEWHERE | ENABLE);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}
