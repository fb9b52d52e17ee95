//! Why the board started (CMSDK, system controller: RSTINFO).

use cara_board::Reason;

use crate::register::{Register, SYSTEM};

const RSTINFO: Register = SYSTEM.at(0x010);
const SYSRESETREQ: u32 = 1;
const WDOGRESETREQ: u32 = 1 << 1;

/// The reason of this start, with the line of a panic or the address of a fault. Register and note are cleared: ask once.
pub fn reason() -> (Reason, u32) {
    let cause = RSTINFO.read();
    RSTINFO.write(cause);
    cara_board::reason(match () {
        () if cause & WDOGRESETREQ != 0 => Reason::Watchdog,
        () if cause & SYSRESETREQ != 0 => Reason::Program,
        // QEMU does not have the register, which reads as zero.
        () => Reason::PowerOn,
    })
}
