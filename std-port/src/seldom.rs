//! Lines of the log that others can cause: a repeated one comes at most once a second, with how many were left out.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Between two of the same line.
const PERIOD_MILLIS: u64 = 1_000;

/// When a line was logged last. One for each place that logs.
#[derive(Debug)]
pub(crate) struct Seldom {
    /// Milliseconds since [`epoch`] of the next one.
    next: AtomicU64,
    left_out: AtomicU64,
}

impl Seldom {
    pub(crate) const fn new() -> Self {
        Self { next: AtomicU64::new(0), left_out: AtomicU64::new(0) }
    }

    /// Whether a line may be logged now: then how many were left out before it.
    pub(crate) fn admits(&self) -> Option<u64> {
        self.admits_at(epoch().elapsed().as_millis() as u64)
    }

    fn admits_at(&self, now: u64) -> Option<u64> {
        let next = self.next.load(Ordering::Relaxed);
        let later = now.saturating_add(PERIOD_MILLIS);
        let is_due =
            now >= next && self.next.compare_exchange(next, later, Ordering::Relaxed, Ordering::Relaxed).is_ok();
        if is_due {
            return Some(self.left_out.swap(0, Ordering::Relaxed));
        }
        self.left_out.fetch_add(1, Ordering::Relaxed);
        None
    }
}

fn epoch() -> Instant {
    static EPOCH: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    *EPOCH.get_or_init(Instant::now)
}

/// A warning that comes at most once a second from its place, with how many were `left_out`.
macro_rules! warn_seldom {
    ($($line:tt)+) => {{
        static LINE: $crate::seldom::Seldom = $crate::seldom::Seldom::new();
        if let Some(left_out) = LINE.admits() {
            tracing::warn!(left_out, $($line)+);
        }
    }};
}

pub(crate) use warn_seldom;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_comes_once_a_second_with_how_many_were_left_out() {
        let line = Seldom::new();
        assert_eq!(line.admits_at(5), Some(0));
        assert!((0..300).all(|ms| line.admits_at(5 + ms).is_none()));
        assert_eq!(line.admits_at(1_004), None);
        assert_eq!((line.admits_at(1_005), line.admits_at(2_005)), (Some(301), Some(0)));
    }
}
