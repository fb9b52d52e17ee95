//! Why the board started (data sheet, System Control: RESC).

use cara_board::Reason;

use crate::register::{Register, SYSTEM};

const RESC: Register = SYSTEM.at(0x05C);
const EXTERNAL: u32 = 1;
const POWER_ON: u32 = 1 << 1;
const BROWN_OUT: u32 = 1 << 2;
const WATCHDOG: u32 = 1 << 3;
const SOFTWARE: u32 = 1 << 4;

/// The reason of this start, with the line of a panic or the address of a fault. Register and note are cleared: ask once.
pub fn reason() -> (Reason, u32) {
    let cause = RESC.read();
    RESC.write(0);
    let has = |bit| cause & bit != 0;
    cara_board::reason(match () {
        () if has(WATCHDOG) => Reason::Watchdog,
        () if has(SOFTWARE) => Reason::Program,
        () if has(BROWN_OUT) => Reason::BrownOut,
        () if has(POWER_ON) => Reason::PowerOn,
        () if has(EXTERNAL) => Reason::Pin,
        () => Reason::Unknown,
    })
}
