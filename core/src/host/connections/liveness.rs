//! Whether the peer is still there, and over which path: the stream and the datagrams have separate signs of life.

use super::delivery::{Delivery, Report, is_long};
use crate::config::{LONGEST_KEEP_ALIVE, MISSED_KEEP_ALIVES, SHORTEST_KEEP_ALIVE, STREAM_ONLY_LOSS};
use crate::time::{Duration, Instant};

/// Pings per period while a keep-alive is missing. With 10 % loss, a live peer answers none of the eight pings before
/// the link is given up once in 600,000 times.
const QUESTIONS_PER_PERIOD: u64 = 4;

/// A path on which a keep-alive was missed counts as lossy for this long.
const LOSSY: Duration = Duration::from_secs(60);

/// Whether the peer is still there: any frame or datagram renews it, and each keep-alive period without one is counted.
///
/// A peer that has missed a keep-alive is pinged repeatedly until something of it arrives: a live peer is heard despite
/// lost frames, and a dead one is detected no later. While keep-alives arrive, no pings are sent.
///
/// Datagrams may not pass at all: after three keep-alives without one the link does without them. For the stream, the peer reports
/// how much of it arrives ([`Report`]).
///
/// At most one keep-alive counts as missed per poll, so that a suspended host or a jumped clock ends nothing by itself.
#[derive(Debug)]
pub struct Liveness {
    period: Duration,
    /// Of both ways together.
    silence: Silence,
    datagrams: Silence,
    /// When to ask again.
    next_question: Instant,
    /// The earliest of what is due, but for the end of `silence`, which each frame moves.
    due: Instant,
    /// Session datagrams of the peer arrive.
    hears: bool,
    /// Those of this unit arrive there.
    is_heard: bool,
    /// The peer misses a keep-alive of this unit.
    is_missed: bool,
    stream_heard: Instant,
    /// When a datagram was last missed.
    missed_at: Option<Instant>,
    delivery: Delivery,
}

/// Since when nothing has come on a way.
#[derive(Debug)]
struct Silence {
    next_check: Instant,
    missed: u8,
}

/// What is to be done about the peer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Look {
    /// One more keep-alive has been missed.
    pub missed: bool,
    /// Ask for a sign of life, in a datagram.
    pub ask: bool,
    /// Write something into the stream that is answered there.
    pub probe: bool,
    /// The peer's datagrams are found not to pass.
    pub deaf: bool,
    /// The peer is lost.
    pub lost: bool,
}

/// How long after a sign of life a keep-alive counts as missed.
fn missed_after(period: Duration) -> Duration {
    period + period.divided_by(2)
}

impl Silence {
    fn new(now: Instant, period: Duration) -> Self {
        Self { next_check: now + missed_after(period), missed: 0 }
    }

    /// Counts one missed keep-alive if the time for it has come.
    fn poll(&mut self, now: Instant, period: Duration) -> bool {
        let missed = now >= self.next_check;
        if missed {
            self.missed = self.missed.saturating_add(1);
            self.next_check = now + period;
        }
        missed
    }
}

impl Liveness {
    /// A peer that was heard just now and sends a keep-alive every `period`, which is clamped to the bounds: a peer
    /// that advertises 2^32-1 ms is lost 210 s after it vanished, not never.
    pub fn new(now: Instant, period: Duration) -> Self {
        let period = period.clamp(SHORTEST_KEEP_ALIVE, LONGEST_KEEP_ALIVE);
        let mut liveness = Self {
            period,
            silence: Silence::new(now, period),
            datagrams: Silence::new(now, period),
            next_question: Instant::FAR_FUTURE,
            due: now,
            hears: false,
            is_heard: false,
            is_missed: false,
            stream_heard: now,
            missed_at: None,
            delivery: Delivery::new(now),
        };
        liveness.note_due();
        liveness
    }

    /// Something arrived in the stream.
    #[inline]
    pub fn heard(&mut self, now: Instant) {
        self.silence = Silence::new(now, self.period);
        self.stream_heard = now;
    }

    /// A datagram of the session arrived; whether they have begun to pass.
    pub(crate) fn heard_datagram(&mut self, now: Instant) -> bool {
        self.silence = Silence::new(now, self.period);
        self.datagrams = Silence::new(now, self.period);
        self.next_question = Instant::FAR_FUTURE;
        self.note_due();
        !core::mem::replace(&mut self.hears, true)
    }

    /// The peer reported what it receives, when `sent` bytes had been written into the stream. If the stream is dead: whether more
    /// than one segment is missing there.
    pub(crate) fn reported(&mut self, now: Instant, sent: u32, report: Report) -> Option<bool> {
        (self.is_heard, self.is_missed) = (report.hears, report.misses);
        let lossy = self.missed_at.is_some_and(|at| now < at + LOSSY);
        self.delivery.reported(now, sent, report, self.stream_heard, lossy).map(is_long)
    }

    /// Whether datagrams of the peer come through.
    pub const fn hears(&self) -> bool {
        self.hears
    }

    /// Whether this unit's datagrams come through, as the peer told last.
    pub const fn is_heard(&self) -> bool {
        self.is_heard
    }

    /// For how long at least the peer has heard nothing of this unit, which sends keep-alives with this period; `None` if it hears it.
    pub(crate) fn missed_for(&self, period: Duration) -> Option<Duration> {
        self.is_missed.then(|| missed_after(period))
    }

    /// Whether datagrams of the peer were waited for in vain for three keep-alives.
    pub const fn is_deaf(&self) -> bool {
        self.datagrams.missed >= MISSED_KEEP_ALIVES
    }

    /// Whether a keep-alive was missed since the peer was last heard.
    pub const fn is_silent(&self) -> bool {
        self.silence.missed > 0
    }

    /// How long ago the peer was last heard. Late looks make it too short by as much as they were late.
    pub fn silent_for(&self, now: Instant) -> Duration {
        let missed = (0..self.silence.missed).fold(Duration::ZERO, |missed, _| missed + self.period);
        now.since(self.silence.next_check - missed - missed_after(self.period))
    }

    /// How long ago something came in the stream.
    pub fn stream_silent_for(&self, now: Instant) -> Duration {
        now.since(self.stream_heard)
    }

    /// When to look again.
    #[inline]
    pub fn deadline(&self) -> Instant {
        self.silence.next_check.min(self.due)
    }

    fn note_due(&mut self) {
        let datagrams = if self.is_deaf() { Instant::FAR_FUTURE } else { self.datagrams.next_check };
        self.due = datagrams.min(self.next_question).min(self.delivery.deadline());
    }

    /// Counts one missed keep-alive, asks and probes, if the time for it has come. `sent` bytes have been written into the stream.
    pub fn poll(&mut self, now: Instant, sent: u32) -> Look {
        if now < self.deadline() {
            return Look::default();
        }
        let silent = self.silence.poll(now, self.period);
        let lost = silent && self.silence.missed >= self.allowed();
        let no_datagram = !self.is_deaf() && self.datagrams.poll(now, self.period);
        let missed_datagram = no_datagram && self.hears;
        if missed_datagram {
            self.missed_at = Some(now);
        }
        let deaf = no_datagram && self.is_deaf();
        self.hears &= !deaf;
        let mut ask = self.hears && !lost && (missed_datagram || now >= self.next_question);
        self.next_question = match (ask, self.hears) {
            (true, _) => now + self.period.divided_by(QUESTIONS_PER_PERIOD).max(SHORTEST_KEEP_ALIVE),
            (_, true) => self.next_question,
            (_, false) => Instant::FAR_FUTURE,
        };
        let probe = self.delivery.poll(now, sent);
        ask |= self.hears && probe.ask;
        self.note_due();
        // Perhaps only datagrams have ceased to pass: so the peer is pinged in the stream as well, once for each miss.
        let probe = !lost && (silent || missed_datagram || probe.write);
        Look { missed: silent || missed_datagram, ask, probe, deaf, lost }
    }

    fn allowed(&self) -> u8 {
        // Where nothing has come in the stream either since datagrams ceased to pass, it is the peer that is silent.
        let is_silent = self.is_deaf() && self.missed_at.is_some_and(|at| self.stream_heard < at);
        if self.hears || is_silent {
            return MISSED_KEEP_ALIVES;
        }
        let periods = STREAM_ONLY_LOSS.as_micros().checked_div(self.period.as_micros()).unwrap_or(0);
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

    const NOTHING: Look = Look { missed: false, ask: false, probe: false, deaf: false, lost: false };
    const MISSED: Look = Look { missed: true, ask: true, probe: true, ..NOTHING };

    /// What one poll says of a stream into which something is always written, and arrives.
    fn poll(liveness: &mut Liveness, now: Instant) -> Look {
        let sent = now.as_micros() as u32;
        liveness.delivery.reported(now, sent, Report { received: sent, ..Report::default() }, now, false);
        liveness.poll(now, sent)
    }

    /// Polls at each deadline; returns (keep-alives missed, questions, when the peer was found lost).
    fn until_lost(liveness: &mut Liveness) -> (u32, u32, Instant) {
        let (mut missed, mut asked) = (0, 0);
        for _ in 0..100 {
            let now = liveness.deadline();
            let look = poll(liveness, now);
            (missed, asked) = (missed + u32::from(look.missed), asked + u32::from(look.ask));
            if look.lost {
                return (missed, asked, now);
            }
        }
        unreachable!()
    }

    #[test]
    fn a_peer_that_tells_no_end_of_a_pause_is_lost_all_the_same() {
        let reported = Duration::from_millis(u64::from(u32::MAX));
        let start = Instant::from_micros(1_000_000);
        for datagrams_pass in [true, false] {
            let mut liveness = Liveness::new(start, reported);
            if datagrams_pass {
                liveness.heard_datagram(start);
            }
            let lost = (0..1_000).find_map(|_| {
                let now = liveness.deadline();
                poll(&mut liveness, now).lost.then(|| now.since(start))
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
    fn a_silent_peer_is_lost_as_soon_where_only_the_stream_passes() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard(at(0));
        assert_eq!(until_lost(&mut liveness), (3, 0, at(3_500)));
        let mut slow = Liveness::new(at(0), Duration::from_secs(10));
        assert_eq!(until_lost(&mut slow).2, at(35_000));
        // A retransmission takes its time, however short the period.
        let mut fast = Liveness::new(at(0), Duration::from_millis(100));
        assert_eq!(until_lost(&mut fast), (30, 0, at(3_050)));
    }

    #[test]
    fn a_peer_whose_last_sign_came_in_the_stream_is_lost_as_soon() {
        let mut liveness = Liveness::new(at(0), Duration::from_millis(700));
        liveness.heard_datagram(at(0));
        liveness.heard(at(300));
        assert_eq!(until_lost(&mut liveness).2, at(300 + 2_450));
        // Only the stream passes.
        let mut liveness = Liveness::new(at(0), Duration::from_millis(700));
        liveness.heard_datagram(at(0));
        for now in (0..10_000).step_by(100) {
            liveness.heard(at(now));
            assert!(!poll(&mut liveness, at(now)).lost);
        }
        assert_eq!(until_lost(&mut liveness).2, at(9_900 + 3_150));
    }

    #[test]
    fn datagrams_that_fail_to_come_for_three_keep_alives_do_not_pass() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        assert!(liveness.heard_datagram(at(0)) && !liveness.heard_datagram(at(500)));
        let mut deaf_at = None;
        for millis in (1_000..20_000).step_by(10) {
            if millis % 1_000 == 0 {
                liveness.heard(at(millis));
            }
            let look = poll(&mut liveness, at(millis));
            assert!(!look.lost && (!look.ask || deaf_at.is_none()), "{millis} ms: {look:?}");
            if look.deaf {
                assert!(deaf_at.replace(millis).is_none(), "it is found once");
            }
        }
        assert_eq!(deaf_at, Some(4_000));
        assert!(liveness.is_deaf() && !liveness.hears());
        assert!(liveness.heard_datagram(at(20_000)) && liveness.hears() && !liveness.is_deaf());
    }

    #[test]
    fn datagrams_that_never_came_are_not_missed() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        for second in 0..20 {
            liveness.heard(at(second * 1_000));
            let look = poll(&mut liveness, at(second * 1_000 + 600));
            assert!(!look.missed && !look.ask && look.deaf == (second == 3), "{second}: {look:?}");
        }
    }

    #[test]
    fn a_peer_that_is_heard_is_asked_nothing() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        for second in 0..100 {
            liveness.heard_datagram(at(second * 1_000));
            assert_eq!(liveness.silence.next_check, at(second * 1_000 + 1_500));
            let look = poll(&mut liveness, at(second * 1_000 + 999));
            assert_eq!(look, NOTHING, "{second}");
        }
    }

    #[test]
    fn the_time_since_the_last_sign_goes_on_while_keep_alives_are_missed() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard(at(1_000));
        assert_eq!(liveness.silent_for(at(1_200)), Duration::from_millis(200));
        assert!(poll(&mut liveness, at(2_500)).missed);
        assert_eq!(liveness.silent_for(at(2_700)), Duration::from_millis(1_700));
        liveness.heard(at(3_000));
        assert_eq!(liveness.silent_for(at(3_000)), Duration::ZERO);
    }

    #[test]
    fn anything_heard_begins_anew() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        for second in 0..20 {
            assert_eq!(poll(&mut liveness, at(second * 3_000 + 1_500)), MISSED);
            assert_eq!(poll(&mut liveness, at(second * 3_000 + 2_500)), MISSED);
            liveness.heard_datagram(at(second * 3_000 + 3_000));
            assert_eq!(liveness.silence.next_check, at(second * 3_000 + 4_500));
        }
    }

    #[test]
    fn a_clock_that_jumps_by_weeks_misses_one() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        liveness.heard_datagram(at(0));
        let jumped = at(0) + Duration::from_secs(49 * 24 * 3_600);
        assert_eq!(poll(&mut liveness, jumped), MISSED);
        assert_eq!(poll(&mut liveness, jumped), NOTHING);
        assert_eq!(liveness.deadline(), jumped + PERIOD.divided_by(QUESTIONS_PER_PERIOD));
    }

    #[test]
    fn a_clock_that_stands_still_misses_nothing() {
        let mut liveness = Liveness::new(at(0), PERIOD);
        assert!((0..1_000).all(|_| poll(&mut liveness, at(1_499)) == NOTHING));
    }

    #[test]
    fn a_coarse_clock_loses_nobody_and_finds_who_is_silent_three_ticks_later_at_most() {
        for tick in [10, 100, 250, 333, 500, 900] {
            let mut liveness = Liveness::new(at(0), PERIOD);
            let coarse = |millis: u64| at(millis - millis % tick);
            for millis in (0..60_000).step_by(10) {
                if millis % 1_000 == 0 {
                    liveness.heard_datagram(coarse(millis));
                }
                assert!(!poll(&mut liveness, coarse(millis)).lost, "ticks of {tick} ms, at {millis}");
            }
            let lost = (60_000..80_000).step_by(10).find(|millis| poll(&mut liveness, coarse(*millis)).lost);
            let bound = 62_500..=62_510 + 3 * tick;
            assert!(lost.is_some_and(|lost| bound.contains(&lost)), "ticks of {tick} ms: {lost:?}");
        }
    }

    #[test]
    fn no_period_at_all_is_a_millisecond() {
        let mut liveness = Liveness::new(at(0), Duration::ZERO);
        liveness.heard_datagram(at(0));
        assert!(liveness.deadline() > at(0));
        assert_eq!(until_lost(&mut liveness).0, 3);
    }
}
