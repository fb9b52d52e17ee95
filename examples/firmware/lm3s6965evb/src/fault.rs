//! How this board does what [`cara_board`] decides, and where its panics and faults end.

use cara_board::{Place, Reason};
use cortex_m::peripheral::SCB;

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
            _ => cara_vehicle::error!("the stack has overflown"),
        }
    }

    fn reset() -> ! {
        SCB::sys_reset()
    }
}
