//! Leases: a motion goes on only while the caller renews it.
//!
//! [`Lease`] is what the application reads, from a motor's interrupt if it likes: one atomic load says whether the
//! motion may go on. It is dead again when nobody polls, so a busy or hung executor cannot keep a vehicle moving.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::config::LEASES;
use crate::distribution::function_list::{Generation, Slot};
use crate::time::{Duration, Instant};

/// Says until when a leased service may act. Written by the unit, read anywhere.
#[derive(Debug, Default)]
pub struct Lease {
    /// The end in milliseconds of the port's clock, wrapping, with the lowest bit set; 0 when there is none.
    end: AtomicU32,
}

impl Lease {
    /// A lease that nobody holds.
    pub const fn new() -> Self {
        Self { end: AtomicU32::new(0) }
    }

    /// Whether the service may act at `now`. Never later than what was granted: the end is rounded down.
    pub fn is_live(&self, now: Instant) -> bool {
        let end = self.end.load(Ordering::Acquire);
        let now = (now.as_micros() / 1_000) as u32;
        // A lease is far shorter than half of the range, so the sign of the difference tells the order.
        end != 0 && (end.wrapping_sub(now) as i32) > 0
    }

    /// Lets the service act until [`Lease::seen_end`] of `end`.
    pub fn renew(&self, end: Instant) {
        self.end.store(odd_millis(end) as u32, Ordering::Release);
    }

    /// When a lease that is granted until `end` is seen to be dead: up to 2 ms earlier. The unit ends it at that moment
    /// too, so that what has been seen dead is not renewed.
    pub fn seen_end(end: Instant) -> Instant {
        Instant::from_micros(odd_millis(end).saturating_mul(1_000))
    }

    /// Ends it now.
    pub fn end(&self) {
        self.end.store(0, Ordering::Release);
    }
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
mod tests {
    use super::*;

    #[test]
    fn a_lease_lives_until_its_end_and_not_longer() {
        let lease = Lease::new();
        assert!(!lease.is_live(Instant::START));
        lease.renew(Instant::from_micros(500_000));
        assert!(lease.is_live(Instant::from_micros(498_000)));
        assert!(!lease.is_live(Instant::from_micros(500_000)));
        lease.renew(Instant::from_micros(501_000));
        assert!(lease.is_live(Instant::from_micros(500_000)));
        assert!(!lease.is_live(Instant::from_micros(501_000)));
        lease.end();
        assert!(!lease.is_live(Instant::START));
    }

    #[test]
    fn a_lease_survives_the_wrap_of_its_clock() {
        let wrap = u64::from(u32::MAX) * 1_000;
        let lease = Lease::new();
        lease.renew(Instant::from_micros(wrap + 300_000));
        assert!(lease.is_live(Instant::from_micros(wrap - 100_000)));
        assert!(lease.is_live(Instant::from_micros(wrap + 200_000)));
        assert!(!lease.is_live(Instant::from_micros(wrap + 300_000)));
    }
}
