//! Hearts: what a unit renews for a loop only as long as that loop runs.
//!
//! A process that is alive does not show that the part of it which wants a motion is. So the loop that wants it beats a
//! [`Heart`] each time round, and renewals of the orders that name it count from its last beat: a loop that hangs ends its
//! motions within their lease, and those of other loops go on.

use core::sync::atomic::{AtomicU32, Ordering};

use super::lease::odd_millis;
use crate::time::{Duration, Instant};

/// A beat is at most so many milliseconds newer than the time at which it is looked at.
const NEWER: u32 = 60_000;

/// Shows that one loop runs. Beaten by that loop, read by the sessions that renew what it has started.
///
/// A heart that has not been beaten for 49 days seems to beat again for the length of one lease.
#[derive(Debug)]
pub struct Heart {
    /// When it last beat, in milliseconds of the port's clock, wrapping, with the lowest bit set; 0 while it does not.
    beaten: AtomicU32,
    /// Rises when it stops, so that what named it before is not renewed by beats of a later owner.
    life: AtomicU32,
    /// At most so long between two beats, in microseconds.
    period: AtomicU32,
}

/// A heart that an order names: [`Heart::beats`].
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

    /// The loop has come round, at `now`.
    pub fn beat(&self, now: Instant) {
        // Rounded down, so that nothing is renewed for longer than it may.
        self.beaten.store(odd_millis(now) as u32, Ordering::Release);
    }

    /// The loop has ended: nothing that names this heart until now is renewed any more.
    pub fn stop(&self) {
        self.life.store(self.life.load(Ordering::Acquire).wrapping_add(1), Ordering::Release);
        self.beaten.store(0, Ordering::Release);
    }

    /// Gives a heart that was stopped another period, for its next owner.
    pub fn set_period(&self, period: Duration) {
        self.period.store(period.as_wire(), Ordering::Release);
    }

    /// For the [`Renew::Heart`] of requests.
    pub fn beats(&'static self) -> Beats {
        Beats { heart: self, life: self.life.load(Ordering::Acquire) }
    }
}

impl Beats {
    /// How long ago it last beat; `None` where it does not beat, or was stopped.
    pub(crate) fn age(&self, now: Instant) -> Option<Duration> {
        let beaten = self.heart.beaten.load(Ordering::Acquire);
        let is_same = self.heart.life.load(Ordering::Acquire) == self.life;
        let age = ((now.as_micros() / 1_000) as u32).wrapping_sub(beaten);
        // A beat may be a little newer than the `now` of a session that looks at it.
        let age = if (age as i32) < 0 && age > u32::MAX - NEWER { 0 } else { age };
        (beaten != 0 && is_same).then(|| Duration::from_millis(age.saturating_add(1).into()))
    }

    /// At most so long between two beats.
    pub(crate) fn period(&self) -> Duration {
        Duration::from_micros(self.heart.period.load(Ordering::Acquire).into())
    }
}

/// Whether two name the same heart in the same life of it.
impl PartialEq for Beats {
    fn eq(&self, other: &Self) -> bool {
        core::ptr::eq(self.heart, other.heart) && self.life == other.life
    }
}

impl Eq for Beats {}

/// How long a call wants what it starts, if its function has a lease.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Renew {
    /// For the length of the lease.
    #[default]
    Never,
    /// While this heart beats, until the call is released.
    Heart(Beats),
    /// While the process lives, until the call is released. A loop that hangs lets its vehicles drive on: for programs that
    /// have none.
    Process,
}

impl Renew {
    /// How old a renewal made at `now` is; `None` where none is to be made.
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
    }
}
