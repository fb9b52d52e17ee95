//! Why the board started (data sheets: RP2040, CHIP_RESET; RP2350, POWMAN CHIP_RESET; both, WATCHDOG REASON).

use cara_board::Reason;
use embassy_rp::pac;
use embassy_rp::watchdog::{ResetReason, Watchdog};

/// What the registers tell of this start.
pub(crate) fn reason(watchdog: &Watchdog) -> Reason {
    match watchdog.reset_reason() {
        Some(ResetReason::TimedOut) => Reason::Watchdog,
        Some(ResetReason::Forced) => Reason::Program,
        None => of_chip(),
    }
}

#[cfg(feature = "rp2040")]
fn of_chip() -> Reason {
    let cause = pac::VREG_AND_CHIP_RESET.chip_reset().read();
    match () {
        () if cause.had_run() => Reason::Pin,
        // A brown-out is told as this.
        () if cause.had_por() => Reason::PowerOn,
        () => Reason::Unknown,
    }
}

#[cfg(not(feature = "rp2040"))]
fn of_chip() -> Reason {
    let cause = pac::POWMAN.chip_reset().read();
    match () {
        () if cause.had_run_low() => Reason::Pin,
        () if cause.had_bor() => Reason::BrownOut,
        () if cause.had_por() => Reason::PowerOn,
        () => Reason::Unknown,
    }
}
