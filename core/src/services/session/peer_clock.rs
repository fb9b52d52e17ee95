//! The peer's clock, from which the age of what it sends is bounded.

use crate::time::{Duration, Instant};

/// The peer's clock as last received: sent back with requests, it lets the peer bound their age without synchronised clocks.
#[derive(Clone, Copy, Debug)]
pub(super) struct PeerClock {
    stamp: u64,
    /// When the stamp arrived; in the far future before the first.
    heard: Instant,
}

/// How long a sample is preferred to later ones that were delayed more.
const SAMPLE_LIFE: Duration = Duration::from_secs(10);
/// Assumed drift between both clocks: one part in this many.
const DRIFT: u64 = 1_000;

impl PeerClock {
    pub(super) const fn new() -> Self {
        Self { stamp: 0, heard: Instant::FAR_FUTURE }
    }

    /// Takes a sample of the peer's clock. A delayed sample would make all requests look older than they are, so it is ignored
    /// while a better one is fresh.
    pub(super) fn hear(&mut self, now: Instant, stamp: u64) {
        // `elapsed` and `stamp` are 0 before the first sample, which is therefore taken.
        let elapsed = now.since(self.heard);
        let expected = Duration::from_micros(self.stamp) + elapsed - elapsed.divided_by(DRIFT);
        if Duration::from_micros(stamp) >= expected || elapsed >= SAMPLE_LIFE {
            *self = Self { stamp: stamp.max(self.stamp), heard: now };
        }
    }

    /// The last stamp, and the time since it arrived.
    pub(super) fn stamp(&self, now: Instant) -> (u64, Duration) {
        (self.stamp, now.since(self.heard))
    }
}

/// The earliest time at which the peer can have sent something with this stamp; `None` if this clock has not reached it yet.
pub(super) fn sent_at_earliest(now: Instant, stamp: u64, since: Duration) -> Option<Instant> {
    let sent_at = Instant::from_micros(stamp) + since;
    // If the sum lies ahead, the clocks have drifted: take it as now.
    if Instant::from_micros(stamp) > now { None } else { Some(sent_at.min(now)) }
}
