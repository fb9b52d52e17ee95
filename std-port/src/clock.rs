//! The port's clock: monotonic, microseconds since the unit was made, those included during which the system was
//! suspended. Leases, ages and deadlines use it, so that none of them survives a longer suspension.

use cara_core::time::{Duration, Instant};
use rustix::time::{ClockId, clock_gettime};

/// What a new clock shows.
const FIRST: u64 = 1_000_000;

/// Tells the time to the core. Copies agree.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clock {
    /// Microseconds of the boot time.
    start: u64,
    /// By how much a test has moved it on.
    #[cfg(test)]
    ahead: Option<&'static std::sync::atomic::AtomicU64>,
}

impl Clock {
    /// A clock that starts a second after zero, so that no time of a running unit is [`Instant::START`].
    pub(crate) fn new() -> Self {
        Self {
            start: boot_time(),
            #[cfg(test)]
            ahead: None,
        }
    }

    /// A clock that goes on by so many microseconds at once, as after a suspension.
    #[cfg(test)]
    pub(crate) fn moved_by(ahead: &'static std::sync::atomic::AtomicU64) -> Self {
        Self { ahead: Some(ahead), ..Self::new() }
    }

    /// The time now.
    pub(crate) fn now(&self) -> Instant {
        let elapsed = boot_time().saturating_sub(self.start);
        #[cfg(test)]
        let elapsed = elapsed + self.ahead.map_or(0, |ahead| ahead.load(std::sync::atomic::Ordering::SeqCst));
        Instant::from_micros(elapsed.saturating_add(FIRST))
    }

    /// A time of this clock on the system's boot clock.
    pub(crate) fn boot_time_of(&self, time: Instant) -> Duration {
        Duration::from_micros(time.as_micros().saturating_sub(FIRST).saturating_add(self.start))
    }
}

/// Microseconds since the system has started, those included during which it was suspended.
fn boot_time() -> u64 {
    let now = clock_gettime(ClockId::Boottime);
    let (seconds, nanos) = (u64::try_from(now.tv_sec).unwrap_or(0), u64::try_from(now.tv_nsec).unwrap_or(0));
    seconds.saturating_mul(1_000_000).saturating_add(nanos / 1_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_goes_by_the_boot_time_of_the_system() {
        let (before, clock) = (boot_time(), Clock::new());
        let uptime = std::fs::read_to_string("/proc/uptime").unwrap();
        let uptime: f64 = uptime.split(' ').next().unwrap().parse().unwrap();
        // /proc/uptime tells it in hundredths of a second.
        assert!(uptime * 1e6 >= before as f64 - 20_000.0);
        assert!(clock.now() >= Instant::from_micros(1_000_000));
        let earlier = boot_time();
        let now = clock.boot_time_of(clock.now()).as_micros();
        assert!((earlier..=boot_time()).contains(&now));
    }
}
