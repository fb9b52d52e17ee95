//! How far a node's clock is from the unit's, in the control socket's form.

use serde::{Deserialize, Serialize};

use crate::ClockOffset;

/// What an offset may be besides its error before it is a trouble, in microseconds.
const TOLERATED_US: u64 = 100_000;

/// How far a node's clock is from the unit's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockInfo {
    /// The node's time minus the unit's, in microseconds: positive where the node is ahead.
    pub offset_us: i64,
    /// The offset is off by this at most.
    pub error_us: u64,
    /// How long ago it was measured.
    pub age_ms: u64,
}

impl ClockInfo {
    pub(super) const fn of(ClockOffset { offset_us, error, age }: ClockOffset) -> Self {
        Self { offset_us, error_us: error.as_micros(), age_ms: age.as_millis() }
    }

    /// By how much the clock is wrong, where it is by more than the error and 100 ms.
    pub fn trouble(&self) -> Option<String> {
        let is_wrong = self.offset_us.unsigned_abs() > self.error_us.saturating_add(TOLERATED_US);
        let side = if self.offset_us > 0 { "ahead" } else { "behind" };
        is_wrong.then(|| format!("clock {:.3} s {side}", self.offset_us.unsigned_abs() as f64 / 1e6))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_is_wrong_by_more_than_the_error_and_a_tenth_of_a_second() {
        let trouble = |offset_us, error_us| ClockInfo { offset_us, error_us, age_ms: 0 }.trouble();
        assert_eq!(trouble(100_050, 50), None);
        assert_eq!(trouble(100_051, 50).as_deref(), Some("clock 0.100 s ahead"));
        assert_eq!(trouble(-2_300_000, 50).as_deref(), Some("clock 2.300 s behind"));
        assert_eq!(trouble(-2_300_000, u64::MAX), None);
        assert!(trouble(i64::MIN, 0).is_some());
    }
}
