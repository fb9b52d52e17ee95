//! One port of the switch: what is on its way to it, in the order of arrival.

use std::collections::BTreeMap;

use cara_core::time::{Duration, Instant};

use crate::{Faults, Mac};

/// Frames that may be on their way to one port; the next one is dropped and counted.
const QUEUE: usize = 4_096;

pub(crate) struct Port {
    pub(crate) mac: Mac,
    pub(crate) up: bool,
    /// Of the frames that it sends.
    pub(crate) faults: Faults,
    /// By arrival, and of one instant by the order of sending.
    arriving: BTreeMap<(Instant, u64), Vec<u8>>,
    /// The port has sent what it was given before by then.
    sent_at: Instant,
    /// What keeps the order arrives no earlier than this.
    in_order: Instant,
}

impl Port {
    pub(crate) fn new(mac: Mac, faults: Faults) -> Self {
        Self { mac, up: true, faults, arriving: BTreeMap::new(), sent_at: Instant::START, in_order: Instant::START }
    }

    /// When `bytes` that are sent at `now` are on the wire; later than `now` where the bandwidth is limited.
    pub(crate) fn transmit(&mut self, now: Instant, bytes: usize) -> Instant {
        if self.faults.bandwidth == 0 {
            return now;
        }
        let micros = (bytes as u64).saturating_mul(8_000_000) / self.faults.bandwidth;
        self.sent_at = self.sent_at.max(now) + Duration::from_micros(micros);
        self.sent_at
    }

    /// The arrival at `at` moved behind those before it.
    pub(crate) fn in_order(&mut self, at: Instant) -> Instant {
        self.in_order = self.in_order.max(at);
        self.in_order
    }

    /// `false` when the queue is full.
    pub(crate) fn arrive(&mut self, at: Instant, sequence: u64, frame: &[u8]) -> bool {
        let room = self.arriving.len() < QUEUE;
        if room {
            self.arriving.insert((at, sequence), frame.to_vec());
        }
        room
    }

    pub(crate) fn next_arrival(&self) -> Option<Instant> {
        self.arriving.keys().next().map(|(at, _)| *at)
    }

    pub(crate) fn take(&mut self, now: Instant) -> Option<Vec<u8>> {
        let first = self.arriving.first_entry()?;
        if first.key().0 > now { None } else { Some(first.remove()) }
    }

    /// Drops what is on its way; returns how many frames that were.
    pub(crate) fn clear(&mut self) -> usize {
        let dropped = self.arriving.len();
        self.arriving.clear();
        dropped
    }
}
