//! Calls that a handler makes and waits for, on the thread that runs it: they end at the deadline of the call that the handler serves.

use std::cell::Cell;

use cara_core::time::{Duration, Instant};

use crate::clock::Clock;

thread_local! {
    /// When the caller of this thread's handler waits no longer, on the system's boot clock: units have clocks of their own.
    static END: Cell<Option<Duration>> = const { Cell::new(None) };
}

/// Runs a handler whose caller waits until `end`; it must not panic, or the end would stay. `None` where no caller waits for an answer.
pub(super) fn until<R>(end: Option<Duration>, run: impl FnOnce() -> R) -> R {
    let outer = END.replace(end);
    let result = run();
    END.set(outer);
    result
}

/// How long the caller of this thread's handler waits; `None` where no handler runs here for one that waits.
pub(super) fn left(clock: Clock, now: Instant) -> Option<Duration> {
    END.get().map(|end| end - clock.boot_time_of(now))
}
