//! How this board does what [`cara_board`] decides, and where its panics and faults end.

use cara_board::{Place, Reason};
use cortex_m::peripheral::SCB;

use crate::{motor, watchdog};

/// Exit code of a program that cannot start: starting again would not help.
pub const NOT_STARTED: i32 = 101;

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
        crate::faults::ended(reason);
        match reason {
            Reason::Panic => cara_vehicle::error!("panic at {=str}:{=u32}", place.file, place.at),
            Reason::Fault => cara_vehicle::error!("fault at {=u32:#x}", place.at),
            _ => cara_vehicle::error!("the stack has overflown"),
        }
    }

    fn reset() -> ! {
        SCB::sys_reset()
    }
}
