//! Whether what this end writes into the stream reaches the peer.
//!
//! The peer reports with each keep-alive how much of the stream has reached it. So each direction has a proof of its own, made by the
//! program at the other end: the peer's TCP, or a relay between the two, may acknowledge what never arrives, and bytes that
//! come say nothing of those that go.

use crate::config::{LOSSY_DEAD, ONE_WAY_DEAD, PROBE, SHORT_SEGMENT, STREAM_DEAD};
use crate::time::{Duration, Instant};

/// Reports without progress before the stream counts as dead, however much time has passed: after a suspension the first one may
/// be as old as that.
const STALE_REPORTS: u8 = 3;
/// A check may come early by this much, since it is made with a keep-alive, for which the unit wakes up anyway.
const SLACK: Duration = Duration::from_millis(100);

/// What a unit tells of the stream and the datagrams of its peer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// Bytes of the stream that have come, modulo 2^32.
    pub received: u32,
    /// The peer's datagrams come.
    pub hears: bool,
    /// More bytes of the stream are not read for now, since what came before them has no room: the unit is slow, not dead.
    pub holds: bool,
    /// The unit misses a keep-alive of the peer: nothing of it comes, neither in the stream nor as a datagram.
    pub misses: bool,
}

/// What became of the bytes that were written into the stream.
#[derive(Debug)]
pub(super) struct Delivery {
    /// What the peer told last.
    received: u32,
    /// Since this report bytes are missing there, and no more have come.
    stuck_since: Option<Instant>,
    stale: u8,
    last_report: Instant,
    next_probe: Instant,
    /// Bytes written at the last look.
    sent: u32,
}

/// What is to be done about the stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Probe {
    /// Nothing was written for a while: write something, so that a dead stream shows.
    pub(super) write: bool,
    /// Bytes are missing at the peer and its last report is old: ask for one.
    pub(super) ask: bool,
}

impl Delivery {
    pub(super) fn new(now: Instant) -> Self {
        Self { received: 0, stuck_since: None, stale: 0, last_report: now, next_probe: now + PROBE, sent: 0 }
    }

    pub(super) const fn deadline(&self) -> Instant {
        self.next_probe
    }

    pub(super) fn poll(&mut self, now: Instant, sent: u32) -> Probe {
        if now + SLACK < self.next_probe {
            return Probe::default();
        }
        let missing = sent != self.received;
        let pause = if missing { PROBE.divided_by(2) } else { PROBE };
        let ask = missing && now.since(self.last_report) + SLACK >= pause;
        // A little late, so that a keep-alive of a whole number of seconds comes first.
        self.next_probe = now + pause + SLACK.divided_by(2);
        Probe { write: core::mem::replace(&mut self.sent, sent) == sent, ask }
    }

    /// The peer reported how many bytes have arrived. `sent` bytes were written by then, something last came in the stream at
    /// `heard`, and `lossy` says whether the path loses datagrams. If the stream is dead: how many bytes are missing there.
    pub(super) fn reported(
        &mut self,
        now: Instant,
        sent: u32,
        report: Report,
        heard: Instant,
        lossy: bool,
    ) -> Option<u32> {
        let stands = core::mem::replace(&mut self.received, report.received) == report.received;
        self.last_report = now;
        // The peer cannot have received more than was sent: such a report is ignored.
        let missing = u32::try_from(sent.wrapping_sub(report.received) as i32).unwrap_or(0);
        match self.stuck_since.filter(|_| stands && !report.holds && missing > 0) {
            Some(since) => {
                self.stale = self.stale.saturating_add(1);
                // Progress of the other direction delays this, but not for ever: long packets may get lost in this direction alone.
                let is_dead = match lossy {
                    false => now >= since + ONE_WAY_DEAD || now >= since.max(heard) + STREAM_DEAD,
                    true => now >= since + LOSSY_DEAD,
                };
                (self.stale >= STALE_REPORTS && is_dead).then_some(missing)
            }
            None => {
                (self.stuck_since, self.stale) = ((missing > 0).then_some(now), 0);
                None
            }
        }
    }
}

/// Whether so many missing bytes are more than one segment of a size that every path carries.
pub(super) const fn is_long(missing: u32) -> bool {
    missing > SHORT_SEGMENT as u32
}

#[cfg(test)]
mod tests {
    #![allow(clippy::arithmetic_side_effects)]
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::START + Duration::from_millis(millis)
    }

    fn reported(received: u32) -> Report {
        Report { received, hears: true, ..Report::default() }
    }

    /// When a stream is found dead to which the peer reports so at each second.
    fn dead_at(seconds: impl IntoIterator<Item = (u64, u32, Report)>) -> Option<u64> {
        let mut delivery = Delivery::new(at(0));
        seconds.into_iter().find_map(|(second, sent, report)| {
            delivery.reported(at(second * 1_000), sent, report, at(0), false).map(|_| second)
        })
    }

    #[test]
    fn bytes_that_do_not_arrive_for_eight_seconds_end_the_stream() {
        assert_eq!(dead_at((1..60).map(|second| (second, 100, reported(90)))), Some(9));
        assert_eq!(dead_at((1..60).map(|second| (second, 100, reported(100)))), None);
    }

    #[test]
    fn any_progress_is_a_sign_of_life() {
        // One byte a second of a megabyte.
        assert_eq!(dead_at((1..600).map(|second| (second, 1 << 20, reported(second as u32)))), None);
        // All has arrived at times, and something new was written just before each report.
        assert_eq!(
            dead_at((1..600).map(|second| (second, 10 * second as u32, reported(10 * second as u32 - 1)))),
            None
        );
    }

    #[test]
    fn progress_the_other_way_puts_the_end_off_and_does_not_prevent_it() {
        for (lossy, expected) in [(false, 17), (true, 61)] {
            let mut delivery = Delivery::new(at(0));
            let dead = (1..90).find(|second| {
                let now = at(second * 1_000);
                delivery.reported(now, 100, reported(90), now, lossy).is_some()
            });
            assert_eq!(dead, Some(expected));
        }
    }

    #[test]
    fn a_peer_that_holds_reading_back_is_slow() {
        let held = Report { holds: true, ..reported(90) };
        assert_eq!(dead_at((1..600).map(|second| (second, 100, held))), None);
        // Its time begins when it reads again.
        let later = (1..60).map(|second| (second, 100, if second < 30 { held } else { reported(90) }));
        assert_eq!(dead_at(later), Some(37));
    }

    #[test]
    fn one_report_after_a_suspension_ends_nothing() {
        let mut delivery = Delivery::new(at(0));
        assert_eq!(delivery.reported(at(1_000), 100, reported(90), at(0), false), None);
        assert_eq!(delivery.reported(at(3_600_000), 100, reported(90), at(0), false), None);
        assert_eq!(delivery.reported(at(3_600_100), 100, reported(100), at(0), false), None);
    }

    #[test]
    fn counts_may_wrap() {
        let sent = |second: u64| u32::MAX.wrapping_sub(50).wrapping_add(10 * second as u32);
        assert_eq!(dead_at((1..60).map(|second| (second, sent(second), reported(sent(second).wrapping_sub(5))))), None);
        assert_eq!(dead_at((1..60).map(|second| (second, sent(9), reported(sent(8))))), Some(9));
    }

    #[test]
    fn a_stream_that_carries_nothing_is_probed_every_four_seconds_and_no_other() {
        let mut delivery = Delivery::new(at(0));
        let mut probes = 0;
        for _ in 0..10 {
            let now = delivery.deadline();
            let probe = delivery.poll(now, 7);
            delivery.reported(now, 7, reported(7), now, false);
            assert!(delivery.deadline() <= now + PROBE + SLACK);
            probes += u32::from(probe.write);
        }
        assert_eq!(probes, 9, "seven bytes had been written before the first look");
        let mut busy = Delivery::new(at(0));
        assert!(
            (1..100).all(|sent| busy.poll(busy.deadline(), sent) == Probe { write: false, ask: busy.received != sent })
        );
    }
}
