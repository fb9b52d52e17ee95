//! The port's clock: monotonic, microseconds since the unit was made.

use cara_core::time::Instant;

/// Tells the time to the core. Copies agree.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clock {
    start: std::time::Instant,
}

impl Clock {
    /// A clock that starts a second after zero, so that no time of a running unit is [`Instant::START`].
    pub(crate) fn new() -> Self {
        Self { start: std::time::Instant::now() }
    }

    /// The time now.
    pub(crate) fn now(&self) -> Instant {
        let micros = u64::try_from(self.start.elapsed().as_micros()).unwrap_or(u64::MAX);
        Instant::from_micros(micros.saturating_add(1_000_000))
    }
}
