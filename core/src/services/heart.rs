//! Hearts: orders are renewed only while the loop that wants them runs.
//!
//! That a process is alive does not show that its planning loop is. So that loop beats a [`Heart`] in each round, and renewals of
//! orders that name it count from its last beat: a loop that hangs ends its own motions within their lease, and other loops are
//! not affected.

use core::sync::atomic::{AtomicU32, Ordering};

use super::lease::odd_millis;
use crate::time::{Duration, Instant};

/// A beat may be up to this many milliseconds newer than the time at which it is checked.
const NEWER: u32 = 60_000;

/// Shows that a loop runs. The loop beats it; the sessions that renew its orders read it.
///
/// After 49 days without a beat the clock has wrapped, and the heart seems to beat again for the length of one lease.
#[derive(Debug)]
pub struct Heart {
    /// Time of the last beat in milliseconds of the port's clock, modulo 2^32, with the lowest bit set; 0 if it is stopped.
    beaten: AtomicU32,
    /// Increases at each stop, so that beats of a later owner do not renew earlier orders.
    life: AtomicU32,
    /// Longest time between two beats, in microseconds.
    period: AtomicU32,
}

/// A heart as an order names it: [`Heart::beats`].
#[derive(Clone, Copy, Debug)]
pub struct Beats {
    heart: &'static Heart,
    life: u32,
}

impl Heart {
    /// A heart that beats at least once in `period`, from its first [`beat`](Self::beat) on.
    pub const fn new(period: Duration) -> Self {
        Self { beaten: AtomicU32::new(0), life: AtomicU32::new(0), period: AtomicU32::new(period.as_wire()) }
    }

    /// Beats: the loop has come round at `now`.
    pub fn beat(&self, now: Instant) {
        // Rounded down, so that no lease is prolonged beyond its length.
        self.beaten.store(odd_millis(now) as u32, Ordering::Release);
    }

    /// Stops the heart: orders that name it are no longer renewed, even if it beats again.
    pub fn stop(&self) {
        self.life.store(self.life.load(Ordering::Acquire).wrapping_add(1), Ordering::Release);
        self.beaten.store(0, Ordering::Release);
    }

    /// Sets the period of a stopped heart, for its next owner.
    pub fn set_period(&self, period: Duration) {
        self.period.store(period.as_wire(), Ordering::Release);
    }

    /// The value for [`Renew::Heart`].
    pub fn beats(&'static self) -> Beats {
        Beats { heart: self, life: self.life.load(Ordering::Acquire) }
    }
}

impl Beats {
    /// How long ago the heart last beat; `None` if it was stopped or has not begun.
    pub(crate) fn age(&self, now: Instant) -> Option<Duration> {
        let beaten = self.heart.beaten.load(Ordering::Acquire);
        let is_same = self.heart.life.load(Ordering::Acquire) == self.life;
        let age = ((now.as_micros() / 1_000) as u32).wrapping_sub(beaten);
        // A beat may be a little newer than the session's `now`.
        let age = if (age as i32) < 0 && age > u32::MAX - NEWER { 0 } else { age };
        (beaten != 0 && is_same).then(|| Duration::from_millis(age.saturating_add(1).into()))
    }

    /// Longest time between two beats.
    pub(crate) fn period(&self) -> Duration {
        Duration::from_micros(self.heart.period.load(Ordering::Acquire).into())
    }
}

/// Equal if both name the same heart between the same two stops.
impl PartialEq for Beats {
    fn eq(&self, other: &Self) -> bool {
        core::ptr::eq(self.heart, other.heart) && self.life == other.life
    }
}

impl Eq for Beats {}

/// How long a call renews its lease, if its function has one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Renew {
    /// Not at all: the motion lasts one lease.
    #[default]
    Never,
    /// While this heart beats, until the call is released.
    Heart(Beats),
    /// While the process lives, until the call is released. For programs without a loop only: one that hangs lets vehicles drive.
    Process,
}

impl Renew {
    /// How old the evidence in a renewal at `now` is; `None` if there is none to send.
    pub(crate) fn age(&self, now: Instant) -> Option<Duration> {
        match self {
            Self::Never => None,
            Self::Heart(beats) => beats.age(now),
            Self::Process => Some(Duration::ZERO),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::arithmetic_side_effects)]
    use std::boxed::Box;

    use super::*;

    const fn at(millis: u64) -> Instant {
        Instant::from_micros(millis * 1_000)
    }

    fn heart() -> &'static Heart {
        Box::leak(Box::new(Heart::new(Duration::from_millis(100))))
    }

    fn age(heart: &'static Heart, millis: u64) -> Option<u64> {
        heart.beats().age(at(millis)).map(Duration::as_millis)
    }

    #[test]
    fn it_has_no_age_before_its_first_beat_and_behind_its_stop() {
        let heart = heart();
        assert_eq!(age(heart, 1), None);
        heart.beat(at(10));
        assert!(age(heart, 10).is_some());
        let before = heart.beats();
        heart.stop();
        assert_eq!((before.age(at(11)), age(heart, 11)), (None, None));
        heart.beat(at(12));
        assert!(before.age(at(12)).is_none() && age(heart, 12).is_some());
    }

    #[test]
    fn its_age_is_never_too_small_and_too_large_by_two_milliseconds_at_most() {
        let heart = heart();
        let wrap = 1_u64 << 32;
        for beaten in [1, 2, 1_001, wrap - 1, wrap, wrap + 1, 3 * wrap + 500] {
            heart.beat(at(beaten));
            for later in [0, 1, 399, 400, 1_000_000] {
                let reported = age(heart, beaten + later);
                assert!(reported >= Some(later), "{beaten} {later}: {reported:?}");
                assert!(reported <= Some(later + 2), "{beaten} {later}: {reported:?}");
            }
        }
    }

    #[test]
    fn a_beat_that_is_newer_than_the_look_is_new() {
        let heart = heart();
        heart.beat(at(500));
        assert_eq!(age(heart, 490), Some(1));
        heart.beat(at(100_001));
        assert_eq!(age(heart, 40_001), Some(1), "by the most that is allowed");
        assert!(age(heart, 40_000) > Some(60_000), "by more");
    }

    #[test]
    fn a_loop_that_has_hung_for_weeks_has_no_new_beat() {
        let heart = heart();
        heart.beat(at(1_000));
        for days in [1, 24, 25, 26, 40, 49] {
            let hung = days * 86_400_000;
            assert!(age(heart, 1_000 + hung) >= Some(hung), "{days}");
        }
    }
}
