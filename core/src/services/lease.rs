//! Leases: a motion goes on only while the caller renews it.
//!
//! [`Lease`] is what the application reads, from a motor's interrupt if it likes: two atomic loads say whether the
//! motion may go on. It is dead again when nobody polls, so a busy or hung executor cannot keep a vehicle moving.

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use crate::config::LEASES;
use crate::distribution::function_list::{Generation, Slot};
use crate::time::{Duration, Instant};

/// Says until when a leased service may act. Written by the unit, read anywhere.
///
/// Whoever reads it may be later than the unit, which renews it as of the time at which it began to look at a renewal: an
/// interrupt can fall between, and a thread can be held up there. So one that has been seen dead remembers it, and no
/// renewal revives it: only a new order does.
#[derive(Debug, Default)]
pub struct Lease {
    /// The end in milliseconds of the port's clock, wrapping, with the lowest bit set; 0 when there is none.
    end: AtomicU32,
    /// Somebody has been told that it has passed its end.
    seen_dead: AtomicBool,
}

impl Lease {
    /// A lease that nobody holds.
    pub const fn new() -> Self {
        Self { end: AtomicU32::new(0), seen_dead: AtomicBool::new(false) }
    }

    /// Whether the service may act at `now`, which is no time to come. Never later than what was granted: the end is
    /// rounded down. Once it has said no, it says so until the next order.
    pub fn is_live(&self, now: Instant) -> bool {
        if self.seen_dead.load(Ordering::Acquire) {
            return false;
        }
        let end = self.end.load(Ordering::Acquire);
        let live = is_before(now, end);
        if end != 0 && !live {
            self.seen_dead.store(true, Ordering::Release);
        }
        live
    }

    /// Whether it lasts beyond `at` as things are, for whoever measures: it is only looked at, so `at` may be to come.
    pub fn lasts_beyond(&self, at: Instant) -> bool {
        !self.seen_dead.load(Ordering::Acquire) && is_before(at, self.end.load(Ordering::Acquire))
    }

    /// Lets the service act for a new order, until [`Lease::seen_end`] of `end`.
    pub fn begin(&self, end: Instant) {
        self.end.store(odd_millis(end) as u32, Ordering::Release);
        // Last, so that nobody sees the old end as that of the new order.
        self.seen_dead.store(false, Ordering::Release);
    }

    /// Lets the service go on until [`Lease::seen_end`] of `end`: `false` when it has ended or been seen dead, and stays so.
    #[must_use]
    pub fn renew(&self, end: Instant) -> bool {
        if self.seen_dead.load(Ordering::Acquire) || self.end.load(Ordering::Acquire) == 0 {
            return false;
        }
        self.end.store(odd_millis(end) as u32, Ordering::Release);
        // It may have been seen in between.
        !self.seen_dead.load(Ordering::Acquire)
    }

    /// When a lease that is granted until `end` is seen to be dead: up to 2 ms earlier. The unit ends it at that moment
    /// too.
    pub fn seen_end(end: Instant) -> Instant {
        Instant::from_micros(odd_millis(end).saturating_mul(1_000))
    }

    /// Ends it now.
    pub fn end(&self) {
        self.end.store(0, Ordering::Release);
    }
}

/// Whether a time comes before the end of a lease, if there is one.
const fn is_before(time: Instant, end: u32) -> bool {
    let time = (time.as_micros() / 1_000) as u32;
    // A lease is far shorter than half of the range, so the sign of the difference tells the order.
    end != 0 && (end.wrapping_sub(time) as i32) > 0
}

/// The end in milliseconds, rounded down to an odd number, which is never the 0 of "no lease".
const fn odd_millis(end: Instant) -> u64 {
    let millis = end.as_micros() / 1_000;
    if millis & 1 == 0 { millis.saturating_sub(1) | 1 } else { millis }
}

/// What the core asks of a port's service: where its lease is, if it has one.
pub trait Service {
    /// The lease that the application reads.
    fn lease(&self) -> Option<&Lease> {
        None
    }
}

impl Service for () {}

/// A lease that the peer holds on a function of this unit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Granted {
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    pub(crate) length: Duration,
    pub(crate) end: Instant,
}

/// A lease that this unit holds on a function of the peer, and renews until it is released.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Held {
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    pub(crate) every: Duration,
    pub(crate) next: Instant,
}

pub(crate) type GrantedLeases = heapless::Vec<Granted, LEASES>;
pub(crate) type HeldLeases = heapless::Vec<Held, LEASES>;

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    #[test]
    fn a_lease_lives_until_its_end_and_not_longer() {
        let lease = Lease::new();
        assert!(!lease.is_live(Instant::START));
        lease.begin(at(500_000));
        assert!(lease.is_live(at(498_000)));
        assert!(lease.renew(at(501_000)));
        assert!(lease.is_live(at(500_000)));
        assert!(!lease.is_live(at(501_000)));
        lease.begin(at(500_000));
        assert!(!lease.is_live(at(500_000)));
        lease.begin(at(500_000));
        lease.end();
        assert!(!lease.is_live(Instant::START));
    }

    #[test]
    fn a_lease_survives_the_wrap_of_its_clock() {
        let wrap = u64::from(u32::MAX) * 1_000;
        let lease = Lease::new();
        lease.begin(at(wrap + 300_000));
        assert!(lease.is_live(at(wrap - 100_000)));
        assert!(lease.is_live(at(wrap + 200_000)));
        assert!(!lease.is_live(at(wrap + 300_000)));
    }

    #[test]
    fn looking_ahead_ends_nothing() {
        let lease = Lease::new();
        lease.begin(at(500_000));
        assert!(lease.lasts_beyond(at(498_000)) && !lease.lasts_beyond(at(500_000)));
        assert!(lease.is_live(at(498_000)) && lease.renew(at(600_000)));
        assert!(!lease.is_live(at(600_000)) && !lease.lasts_beyond(at(0)));
    }

    /// What befalls a lease whose reader's clock goes on by so much in between.
    #[derive(Clone, Copy, Debug)]
    enum Step {
        Look(u64),
        /// A renewal until so long behind a time that was read earlier.
        Renew(u64),
        Begin(u64),
        End,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            4 => (0..150_000_u64).prop_map(Step::Look),
            4 => (0..400_000_u64).prop_map(Step::Renew),
            1 => (0..400_000_u64).prop_map(Step::Begin),
            1 => Just(Step::End),
        ]
    }

    proptest! {
        #[test]
        fn what_was_seen_dead_lives_only_by_a_new_order(steps in prop::collection::vec(step(), 0..60)) {
            let lease = Lease::new();
            let (mut now, mut dead) = (0, true);
            for step in steps {
                match step {
                    Step::Look(later) => {
                        now += later;
                        let live = lease.is_live(at(now));
                        prop_assert!(!(live && dead), "it was seen dead, and lives at {now}");
                        dead = !live;
                    }
                    Step::Renew(length) if !dead => {
                        prop_assert!(lease.renew(at(now + length)));
                    }
                    Step::Renew(length) => {
                        let _ = lease.renew(at(now + length));
                    }
                    Step::Begin(length) => {
                        lease.begin(at(now + length));
                        dead = false;
                    }
                    Step::End => {
                        lease.end();
                        dead = true;
                    }
                }
            }
        }
    }
}
