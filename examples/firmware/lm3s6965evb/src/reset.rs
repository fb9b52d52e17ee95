//! Why the board started (data sheet, System Control: RESC).

use cara_vehicle::reset::Reason;

use crate::note::{self, Note};
use crate::register::{Register, SYSTEM};

const RESC: Register = SYSTEM.at(0x05C);
const EXTERNAL: u32 = 1;
const POWER_ON: u32 = 1 << 1;
const BROWN_OUT: u32 = 1 << 2;
const WATCHDOG: u32 = 1 << 3;
const SOFTWARE: u32 = 1 << 4;

/// The reason of this start. The register keeps reasons until they are cleared, which this does: ask once.
pub fn reason() -> Reason {
    let cause = RESC.read();
    RESC.write(0);
    let has = |bit| cause & bit != 0;
    let note = note::take();
    match () {
        () if has(WATCHDOG) || note == Some(Note::Watchdog) => Reason::Watchdog,
        () if has(SOFTWARE) || note == Some(Note::Program) => Reason::Program,
        () if has(BROWN_OUT) => Reason::BrownOut,
        () if has(POWER_ON) => Reason::PowerOn,
        () if has(EXTERNAL) => Reason::Pin,
        () => Reason::Unknown,
    }
}
