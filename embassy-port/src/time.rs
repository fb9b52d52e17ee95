//! The clock: embassy-time's, in the core's types.

use cara_core::time::Instant;
use embassy_time::{TICK_HZ, Timer};

/// Microseconds of one tick of the clock, rounded up; deadlines are moved by as much, so that no timer ends too early.
const TICK_MICROS: u64 = 1_000_000_u64.div_ceil(TICK_HZ).saturating_sub(1);

/// The time now, as leases and deadlines count it. Can be called from an interrupt.
pub fn now() -> Instant {
    Instant::from_micros(embassy_time::Instant::now().as_micros())
}

/// Ends at `at`.
pub(crate) fn timer(at: Instant) -> Timer {
    Timer::at(embassy_time::Instant::from_micros(at.as_micros().saturating_add(TICK_MICROS)))
}
