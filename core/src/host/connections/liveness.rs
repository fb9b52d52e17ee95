//! Whether the peer is still there.

use crate::config::{MISSED_KEEP_ALIVES, TCP_ONLY_LOSS};
use crate::time::{Duration, Instant};

/// Whether the peer is still there: any frame renews it, and each keep-alive period without one is counted.
///
/// At most one keep-alive counts as missed per poll, so that a suspended host or a jumped clock ends nothing by itself.
#[derive(Debug)]
pub struct Liveness {
    period: Duration,
    next_check: Instant,
    missed: u8,
    /// Session datagrams of the peer arrive: their absence is the faster signal.
    datagrams_pass: bool,
}

impl Liveness {
    /// A peer that was heard just now and sends a keep-alive every `period`.
    pub fn new(now: Instant, period: Duration) -> Self {
        let period = period.max(Duration::from_millis(1));
        Self { period, next_check: now + period + period.divided_by(2), missed: 0, datagrams_pass: false }
    }

    /// Something arrived in the stream.
    pub fn heard(&mut self, now: Instant) {
        self.missed = 0;
        self.next_check = now + self.period + self.period.divided_by(2);
    }

    /// A datagram of the session arrived.
    pub fn heard_datagram(&mut self, now: Instant) {
        self.datagrams_pass = true;
        self.heard(now);
    }

    /// Whether datagrams of the peer have come through.
    pub const fn datagrams_pass(&self) -> bool {
        self.datagrams_pass
    }

    /// When to look again.
    pub const fn deadline(&self) -> Instant {
        self.next_check
    }

    /// Counts one missed keep-alive if its time has come; returns (missed now, lost).
    pub fn poll(&mut self, now: Instant) -> (bool, bool) {
        if now < self.next_check {
            return (false, false);
        }
        self.missed = self.missed.saturating_add(1);
        self.next_check = now + self.period;
        (true, self.missed >= self.allowed())
    }

    fn allowed(&self) -> u8 {
        if self.datagrams_pass {
            return MISSED_KEEP_ALIVES;
        }
        let periods = TCP_ONLY_LOSS.as_micros().checked_div(self.period.as_micros()).unwrap_or(8);
        u8::try_from(periods).unwrap_or(u8::MAX).max(MISSED_KEEP_ALIVES)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::arithmetic_side_effects)]
    use super::*;

    const PERIOD: Duration = Duration::from_secs(1);

    fn at(millis: u64) -> Instant {
        Instant::START + Duration::from_millis(millis)
    }

    /// Polls at each deadline; returns (keep-alives missed, when the peer was found lost).
    fn until_lost(liveness: &mut Liveness) -> (u32, Instant) {
        for missed in 1.. {
            let now = liveness.deadline();
            let (counted, lost) = liveness.poll(now);
            assert!(counted);
            if lost {
                return (missed, now);
            }
        }
        unreachable!()
    }

    #[test]
    fn a_silent_peer_is_lost_after_three_keep_alives_where_datagrams_pass() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        assert_eq!(until_lost(&mut liveness), (3, at(3_500)));
    }

    #[test]
    fn a_silent_peer_is_lost_after_eight_seconds_where_only_the_stream_passes() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard(at(0));
        assert_eq!(until_lost(&mut liveness), (8, at(8_500)));
        // However long the period: three are waited for.
        let mut slow = Liveness::new(at(0), Duration::from_secs(10));
        assert_eq!(until_lost(&mut slow), (3, at(35_000)));
    }

    #[test]
    fn anything_heard_begins_anew() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        for second in 0..20 {
            assert_eq!(liveness.poll(at(second * 3_000 + 1_500)), (true, false));
            assert_eq!(liveness.poll(at(second * 3_000 + 2_500)), (true, false));
            liveness.heard(at(second * 3_000 + 3_000));
        }
    }

    #[test]
    fn a_clock_that_jumps_by_weeks_misses_one() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        let jumped = at(0) + Duration::from_secs(49 * 24 * 3_600);
        assert_eq!(liveness.poll(jumped), (true, false));
        assert_eq!(liveness.poll(jumped), (false, false));
        assert_eq!(liveness.deadline(), jumped + PERIOD);
    }

    #[test]
    fn a_clock_that_stands_still_misses_nothing() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        assert!((0..1_000).all(|_| liveness.poll(at(1_499)) == (false, false)));
    }

    #[test]
    fn no_period_at_all_is_a_millisecond() {
        let mut liveness = Liveness::new(at(0), Duration::ZERO);
        liveness.heard_datagram(at(0));
        assert!(liveness.deadline() > at(0));
        assert_eq!(until_lost(&mut liveness).0, 3);
    }
}
