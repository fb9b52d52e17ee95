//! Time as the core sees it: microseconds, always passed in, never read from a clock.
//!
//! Both types are 64 bits of microseconds, so that they wrap after more than half a million years. A port whose own
//! clock is narrower widens it before it calls the core.

use core::ops::{Add, Sub};

/// A point in time, in microseconds since the port's arbitrary start. Comparable within one boot only.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Instant(u64);

/// A span of time in microseconds; never negative.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Duration(u64);

impl Instant {
    /// The start of the port's clock.
    pub const START: Self = Self(0);
    /// Later than every deadline: "nothing is due".
    pub const FAR_FUTURE: Self = Self(u64::MAX);

    /// The instant `micros` microseconds after the start of the clock.
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// Microseconds since the start of the clock.
    pub const fn as_micros(self) -> u64 {
        self.0
    }

    /// Time from `earlier` to `self`; zero if `earlier` is later.
    pub const fn since(self, earlier: Self) -> Duration {
        Duration(self.0.saturating_sub(earlier.0))
    }
}

impl Duration {
    /// Zero.
    pub const ZERO: Self = Self(0);
    /// Longer than any deadline.
    pub const MAX: Self = Self(u64::MAX);

    /// A span of `micros` microseconds.
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// A span of `millis` milliseconds; saturates.
    pub const fn from_millis(millis: u64) -> Self {
        Self(millis.saturating_mul(1_000))
    }

    /// A span of `secs` seconds; saturates.
    pub const fn from_secs(secs: u64) -> Self {
        Self(secs.saturating_mul(1_000_000))
    }

    /// The span in microseconds.
    pub const fn as_micros(self) -> u64 {
        self.0
    }

    /// The span in whole milliseconds, rounded down.
    pub const fn as_millis(self) -> u64 {
        self.0 / 1_000
    }

    /// The span in microseconds as 32 bits, saturating after 71 minutes, as encoded in a request.
    pub const fn as_wire(self) -> u32 {
        if self.0 > u32::MAX as u64 { u32::MAX } else { self.0 as u32 }
    }

    /// `self` times `factor`; saturates.
    pub const fn times(self, factor: u64) -> Self {
        Self(self.0.saturating_mul(factor))
    }

    /// `self` divided by `divisor`; `self` if the divisor is zero.
    pub const fn divided_by(self, divisor: u64) -> Self {
        match self.0.checked_div(divisor) {
            Some(quotient) => Self(quotient),
            None => self,
        }
    }
}

impl Add<Duration> for Instant {
    type Output = Self;
    #[cfg_attr(target_os = "none", inline(never))]
    fn add(self, span: Duration) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub<Duration> for Instant {
    type Output = Self;
    fn sub(self, span: Duration) -> Self {
        Self(self.0.saturating_sub(span.0))
    }
}

impl Add for Duration {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }
}

impl Sub for Duration {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }
}

impl From<core::time::Duration> for Duration {
    fn from(span: core::time::Duration) -> Self {
        Self(u64::try_from(span.as_micros()).unwrap_or(u64::MAX))
    }
}

impl From<Duration> for core::time::Duration {
    fn from(span: Duration) -> Self {
        Self::from_micros(span.0)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::arithmetic_side_effects)]
    use super::*;

    #[test]
    fn what_does_not_fit_into_a_request_is_the_longest_that_does() {
        let longest = u64::from(u32::MAX);
        let encoded = [0, 1, longest - 1, longest, longest + 1, u64::MAX].map(|it| Duration::from_micros(it).as_wire());
        assert_eq!(encoded, [0, 1, u32::MAX - 1, u32::MAX, u32::MAX, u32::MAX]);
    }

    #[test]
    fn spans_are_those_of_the_standard_library_and_end_at_the_longest() {
        let span = Duration::from_millis(2_500);
        assert_eq!(
            (span.as_micros(), span.as_millis(), span.times(3)),
            (2_500_000, 2_500, Duration::from_micros(7_500_000))
        );
        assert_eq!((span.divided_by(4), span.divided_by(0)), (Duration::from_micros(625_000), span));
        assert_eq!(Duration::from(core::time::Duration::from_micros(2_500_000)), span);
        assert_eq!(core::time::Duration::from(span), core::time::Duration::from_micros(2_500_000));
        assert_eq!(Duration::from(core::time::Duration::MAX), Duration::MAX);
        assert_eq!(Duration::from_secs(u64::MAX).times(2) + span, Duration::MAX);
    }

    #[test]
    fn nothing_is_before_the_start_or_shorter_than_nothing() {
        let (early, late) = (Instant::from_micros(1_000), Instant::from_micros(3_500));
        let between = Duration::from_micros(2_500);
        assert_eq!((late.since(early), early.since(late)), (between, Duration::ZERO));
        assert_eq!((early + between, late - between, early - between), (late, early, Instant::START));
        assert_eq!(
            (between - Duration::from_millis(1), Duration::from_millis(1) - between),
            (Duration::from_micros(1_500), Duration::ZERO)
        );
        assert_eq!(late + Duration::MAX, Instant::FAR_FUTURE);
    }
}
