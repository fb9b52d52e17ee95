//! Whether the peer is still there.

use crate::config::{LONGEST_KEEP_ALIVE, MISSED_KEEP_ALIVES, SHORTEST_KEEP_ALIVE, TCP_ONLY_LOSS};
use crate::time::{Duration, Instant};

/// Pings per period while a keep-alive is missing. With 10 % loss, a live peer answers none of the eight pings before
/// the link is given up once in 600,000 times.
const QUESTIONS_PER_PERIOD: u64 = 4;

/// Whether the peer is still there: any frame renews it, and each keep-alive period without one is counted.
///
/// A peer that has missed a keep-alive is pinged repeatedly until a frame of it arrives: a live peer is heard despite
/// lost frames, and a dead one is detected no later. While keep-alives arrive, no pings are sent.
///
/// At most one keep-alive counts as missed per poll, so that a suspended host or a jumped clock ends nothing by itself.
#[derive(Debug)]
pub struct Liveness {
    period: Duration,
    next_check: Instant,
    /// When to ask again.
    next_question: Instant,
    missed: u8,
    /// Session datagrams of the peer arrive: their absence is the faster signal.
    datagrams_pass: bool,
}

/// What is to be done about the peer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Look {
    /// One more keep-alive has been missed.
    pub missed: bool,
    /// Ask for a sign of life, in a datagram.
    pub ask: bool,
    /// The peer is lost.
    pub lost: bool,
}

impl Liveness {
    /// A peer that was heard just now and sends a keep-alive every `period`, which is clamped to the bounds: a peer
    /// that advertises 2^32-1 ms is lost 210 s after it vanished, not never.
    pub fn new(now: Instant, period: Duration) -> Self {
        let period = period.clamp(SHORTEST_KEEP_ALIVE, LONGEST_KEEP_ALIVE);
        let next_check = now + period + period.divided_by(2);
        Self { period, next_check, next_question: Instant::FAR_FUTURE, missed: 0, datagrams_pass: false }
    }

    /// Something arrived in the stream.
    pub fn heard(&mut self, now: Instant) {
        self.missed = 0;
        self.next_question = Instant::FAR_FUTURE;
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

    /// How long ago the peer was last heard. Late looks make it too short by as much as they were late.
    pub fn silent_for(&self, now: Instant) -> Duration {
        let missed = (0..self.missed).fold(Duration::ZERO, |missed, _| missed + self.period);
        now.since(self.next_check - missed - self.period - self.period.divided_by(2))
    }

    /// When to look again.
    #[inline]
    pub fn deadline(&self) -> Instant {
        self.next_check.min(self.next_question)
    }

    /// Counts one missed keep-alive, and asks, if the time for it has come.
    pub fn poll(&mut self, now: Instant) -> Look {
        let missed = now >= self.next_check;
        if missed {
            self.missed = self.missed.saturating_add(1);
            self.next_check = now + self.period;
        }
        let lost = missed && self.missed >= self.allowed();
        // Where no datagram has passed, each keep-alive asks in the stream already.
        let ask = self.datagrams_pass && !lost && (missed || now >= self.next_question);
        if ask {
            self.next_question = now + self.period.divided_by(QUESTIONS_PER_PERIOD).max(SHORTEST_KEEP_ALIVE);
        }
        Look { missed, ask, lost }
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

    const MISSED: Look = Look { missed: true, ask: true, lost: false };
    const NOTHING: Look = Look { missed: false, ask: false, lost: false };

    /// Polls at each deadline; returns (keep-alives missed, questions, when the peer was found lost).
    fn until_lost(liveness: &mut Liveness) -> (u32, u32, Instant) {
        let (mut missed, mut asked) = (0, 0);
        for _ in 0..100 {
            let now = liveness.deadline();
            let look = liveness.poll(now);
            assert!(look.missed || look.ask, "a deadline for nothing");
            (missed, asked) = (missed + u32::from(look.missed), asked + u32::from(look.ask));
            if look.lost {
                return (missed, asked, now);
            }
        }
        unreachable!()
    }

    #[test]
    fn a_peer_that_tells_no_end_of_a_pause_is_lost_all_the_same() {
        let told = Duration::from_millis(u64::from(u32::MAX));
        let start = Instant::from_micros(1_000_000);
        for datagrams_pass in [true, false] {
            let mut liveness = Liveness::new(start, told);
            if datagrams_pass {
                liveness.heard_datagram(start);
            }
            let lost = (0..1_000).find_map(|_| {
                let now = liveness.deadline();
                liveness.poll(now).lost.then(|| now.since(start))
            });
            assert!(lost.is_some_and(|lost| lost <= Duration::from_secs(210)), "{lost:?}");
        }
    }

    #[test]
    fn a_silent_peer_is_lost_after_three_keep_alives_where_datagrams_pass() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        assert_eq!(until_lost(&mut liveness), (3, 8, at(3_500)));
    }

    #[test]
    fn a_silent_peer_is_lost_after_eight_seconds_where_only_the_stream_passes() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard(at(0));
        assert_eq!(until_lost(&mut liveness), (8, 0, at(8_500)));
        // However long the period: three are waited for.
        let mut slow = Liveness::new(at(0), Duration::from_secs(10));
        assert_eq!(until_lost(&mut slow), (3, 0, at(35_000)));
    }

    #[test]
    fn a_peer_that_is_heard_is_asked_nothing() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        for second in 0..100 {
            liveness.heard_datagram(at(second * 1_000));
            assert_eq!(liveness.deadline(), at(second * 1_000 + 1_500));
            assert_eq!(liveness.poll(at(second * 1_000 + 999)), NOTHING);
        }
    }

    #[test]
    fn the_time_since_the_last_sign_goes_on_while_keep_alives_are_missed() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard(at(1_000));
        assert_eq!(liveness.silent_for(at(1_200)), Duration::from_millis(200));
        assert!(liveness.poll(at(2_500)).missed);
        assert_eq!(liveness.silent_for(at(2_700)), Duration::from_millis(1_700));
        liveness.heard(at(3_000));
        assert_eq!(liveness.silent_for(at(3_000)), Duration::ZERO);
    }

    #[test]
    fn anything_heard_begins_anew() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        for second in 0..20 {
            assert_eq!(liveness.poll(at(second * 3_000 + 1_500)), MISSED);
            assert_eq!(liveness.poll(at(second * 3_000 + 2_500)), MISSED);
            liveness.heard(at(second * 3_000 + 3_000));
            assert_eq!(liveness.deadline(), at(second * 3_000 + 4_500));
        }
    }

    #[test]
    fn a_clock_that_jumps_by_weeks_misses_one() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        let jumped = at(0) + Duration::from_secs(49 * 24 * 3_600);
        assert_eq!(liveness.poll(jumped), MISSED);
        assert_eq!(liveness.poll(jumped), NOTHING);
        assert_eq!(liveness.deadline(), jumped + PERIOD.divided_by(QUESTIONS_PER_PERIOD));
    }

    #[test]
    fn a_clock_that_stands_still_misses_nothing() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        assert!((0..1_000).all(|_| liveness.poll(at(1_499)) == NOTHING));
    }

    #[test]
    fn no_period_at_all_is_a_millisecond() {
        let mut liveness = Liveness::new(at(0), Duration::ZERO);
        liveness.heard_datagram(at(0));
        assert!(liveness.deadline() > at(0));
        assert_eq!(until_lost(&mut liveness).0, 3);
    }
}
