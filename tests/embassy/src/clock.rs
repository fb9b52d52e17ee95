//! The clock of a thread, which embassy-time reads: it stands still until it is moved.
//!
//! embassy's own mock clock is one for the whole process, so that tests could not run side by side.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::task::Waker;

use cara_core::time::{Duration, Instant};
use embassy_time_driver::Driver;

thread_local! {
    static NOW: Cell<u64> = const { Cell::new(0) };
    static TIMERS: RefCell<BTreeMap<(u64, u64), Waker>> = const { RefCell::new(BTreeMap::new()) };
    static SEQUENCE: Cell<u64> = const { Cell::new(0) };
}

struct VirtualClock;

impl Driver for VirtualClock {
    fn now(&self) -> u64 {
        NOW.get()
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        TIMERS.with_borrow_mut(|timers| {
            if !timers.range((at, 0)..=(at, u64::MAX)).any(|(_, other)| other.will_wake(waker)) {
                SEQUENCE.set(SEQUENCE.get() + 1);
                timers.insert((at, SEQUENCE.get()), waker.clone());
            }
        });
    }
}

#[allow(unsafe_code)]
mod symbols {
    use super::VirtualClock;

    embassy_time_driver::time_driver_impl!(static CLOCK: VirtualClock = VirtualClock);
}

/// The time of this thread's bench.
pub fn now() -> Instant {
    Instant::from_micros(NOW.get())
}

/// Restarts.
pub(crate) fn reset() {
    NOW.set(0);
    TIMERS.take();
}

/// Moves the clock, never back.
pub(crate) fn set(to: Instant) {
    NOW.set(NOW.get().max(to.as_micros()));
}

pub(crate) fn pass(span: Duration) {
    NOW.set(NOW.get() + span.as_micros());
}

/// Wakes the timers that are due.
pub(crate) fn wake_due() {
    while let Some(waker) = TIMERS.with_borrow_mut(|timers| {
        let first = timers.first_entry()?;
        (first.key().0 <= NOW.get()).then(|| first.remove())
    }) {
        waker.wake();
    }
}

/// When the next timer ends.
pub(crate) fn next_timer() -> Option<Instant> {
    TIMERS.with_borrow(|timers| timers.keys().next().map(|(at, _)| Instant::from_micros(*at)))
}
