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
        let elapsed = self.start.elapsed();
        let micros = elapsed.as_secs().saturating_mul(1_000_000).saturating_add(elapsed.subsec_micros().into());
        Instant::from_micros(micros.saturating_add(1_000_000))
    }
}
