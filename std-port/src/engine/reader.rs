//! Who reads a link: the pool through epoll, or one thread that has the lead and blocks in reading it.
//!
//! Two kinds of threads lead. A caller that waits for a reply takes the lead if nobody has it and reads its own reply.
//! A thread of the pool that has just served a link, quickly, stays on it and waits for the next call. A link that is
//! led is out of the pool's hands (disarmed); when the leader leaves, it passes the lead to a waiting caller, or gives
//! the link back to the pool (arms it). A caller whose calls follow each other at once does neither: it keeps the link,
//! until the clock finds that no further call has come. A thread of the pool that runs a handler while it leads can lose
//! the lead: then others read on.
//!
//! The decisions stand here, without any threads, so that they can be checked by a model: at every moment somebody reads
//! the link, has been told to, or is expected back under the eyes of the clock.

use cara_core::time::{Duration, Instant};

/// Who has the lead.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Reader {
    lead: Option<Lead>,
    /// A caller has been woken to take the lead and has not yet done so.
    passed: bool,
    /// The last leader is expected back at once; if it does not come, the clock gives the link to the pool.
    kept: bool,
    turns: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Lead {
    turn: Turn,
    /// Runs a handler since then, and does not read meanwhile.
    busy_since: Option<Instant>,
}

/// Proves that a thread has taken the lead; whether it still has it, [`Reader::is_leader`] tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Turn(u32);

impl Reader {
    /// A thread reads the link, or is about to: the pool keeps off.
    pub(crate) const fn is_led(self) -> bool {
        self.lead.is_some()
    }

    /// The pool is to be told when there is something to read.
    pub(crate) const fn pool_reads(self) -> bool {
        self.lead.is_none() && !self.passed && !self.kept
    }

    /// Asks for the lead.
    pub(crate) fn take_lead(&mut self) -> Option<Turn> {
        if self.lead.is_some() {
            return None;
        }
        self.turns = self.turns.wrapping_add(1);
        let turn = Turn(self.turns);
        self.lead = Some(Lead { turn, busy_since: None });
        self.passed = false;
        self.kept = false;
        Some(turn)
    }

    /// Whether the lead is still that of `turn`.
    pub(crate) fn is_leader(self, turn: Turn) -> bool {
        self.lead.is_some_and(|lead| lead.turn == turn)
    }

    /// The leader does not read from `since` on, until it says `None`.
    pub(crate) fn set_busy(&mut self, turn: Turn, since: Option<Instant>) {
        if let Some(lead) = self.lead.as_mut().filter(|lead| lead.turn == turn) {
            lead.busy_since = since;
        }
    }

    /// The leader runs a handler.
    pub(crate) fn is_busy(self) -> bool {
        self.lead.is_some_and(|lead| lead.busy_since.is_some())
    }

    /// Takes the lead from a thread that has been busy for longer than `limit`; others read from here on.
    pub(crate) fn relieve(&mut self, now: Instant, limit: Duration, pass: impl FnOnce() -> bool) -> bool {
        let overdue = self.lead.and_then(|lead| lead.busy_since).is_some_and(|since| now >= since + limit);
        if overdue {
            self.lead = None;
            self.passed = pass();
        }
        overdue
    }

    /// The leader leaves and comes back at once, unless somebody else waits for the lead.
    pub(crate) fn keep(&mut self, turn: Turn, pass: impl FnOnce() -> bool) {
        self.kept = self.is_leader(turn);
        self.leave(Some(turn), pass);
        self.kept &= !self.passed;
    }

    /// Whether the link is kept for its last leader.
    pub(crate) const fn is_kept(self) -> bool {
        self.kept
    }

    /// The last leader has not come back, or somebody waits who does not read: the pool reads.
    pub(crate) fn give_up_keeping(&mut self) {
        self.kept = false;
    }

    /// A thread leaves. If it led, or if the lead was passed on and not taken yet, `pass` wakes the next waiting caller
    /// and tells whether there is one; otherwise the pool reads.
    pub(crate) fn leave(&mut self, turn: Option<Turn>, pass: impl FnOnce() -> bool) {
        let led = turn.is_some_and(|turn| self.is_leader(turn));
        if led {
            self.lead = None;
        }
        if led || (self.lead.is_none() && self.passed) {
            // The planted bug forgets to wake anybody, and believes it has.
            self.passed = if cfg!(cara_planted = "lost_wakeup") { led } else { pass() };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    /// For `leave` where nobody must be asked.
    fn nobody_asked() -> bool {
        panic!("nobody is to be woken")
    }

    #[test]
    fn the_pool_reads_unless_somebody_leads() {
        let mut reader = Reader::default();
        assert!(reader.pool_reads() && !reader.is_led());
        let turn = reader.take_lead().unwrap();
        assert!(!reader.pool_reads() && reader.is_led() && reader.is_leader(turn));
        assert_eq!(reader.take_lead(), None);
        reader.leave(Some(turn), || false);
        assert!(reader.pool_reads());
        assert_ne!(reader.take_lead(), Some(turn), "each turn is another one");
    }

    #[test]
    fn a_lead_that_was_passed_keeps_the_pool_off_until_it_is_taken() {
        let mut reader = Reader::default();
        let turn = reader.take_lead().unwrap();
        reader.leave(Some(turn), || true);
        assert!(!reader.pool_reads() && !reader.is_led());
        let next = reader.take_lead().unwrap();
        reader.leave(Some(next), || false);
        assert!(reader.pool_reads());
    }

    /// Whoever was woken may have its reply by then, or give up: it passes the lead on.
    #[test]
    fn who_was_woken_and_leaves_passes_the_lead_on() {
        let mut reader = Reader::default();
        let turn = reader.take_lead().unwrap();
        reader.leave(Some(turn), || true);
        let mut asked = 0;
        reader.leave(None, || {
            asked += 1;
            true
        });
        assert_eq!(asked, 1);
        assert!(!reader.pool_reads());
        reader.leave(None, || false);
        assert!(reader.pool_reads());
    }

    #[test]
    fn who_leaves_without_the_lead_changes_nothing() {
        let mut reader = Reader::default();
        reader.leave(None, nobody_asked);
        let turn = reader.take_lead().unwrap();
        reader.leave(None, nobody_asked);
        assert!(reader.is_leader(turn));
    }

    #[test]
    fn only_a_busy_leader_is_relieved_and_only_after_the_limit() {
        let mut reader = Reader::default();
        let limit = Duration::from_micros(10);
        assert!(!reader.relieve(at(1_000), limit, nobody_asked));
        let turn = reader.take_lead().unwrap();
        assert!(!reader.relieve(at(1_000), limit, nobody_asked), "it reads");
        reader.set_busy(turn, Some(at(100)));
        assert!(!reader.relieve(at(109), limit, nobody_asked));
        reader.set_busy(turn, None);
        assert!(!reader.relieve(at(1_000), limit, nobody_asked), "it reads again");
        reader.set_busy(turn, Some(at(2_000)));
        assert!(reader.relieve(at(2_010), limit, || false));
        assert!(reader.pool_reads() && !reader.is_leader(turn));
    }

    #[test]
    fn a_link_is_kept_until_its_leader_is_back_or_the_clock_gives_up() {
        let mut reader = Reader::default();
        let turn = reader.take_lead().unwrap();
        reader.keep(turn, || false);
        assert!(reader.is_kept() && !reader.pool_reads() && !reader.is_led());
        let turn = reader.take_lead().unwrap();
        assert!(!reader.is_kept());
        reader.keep(turn, || true);
        assert!(!reader.is_kept(), "somebody else has the lead");
        let next = reader.take_lead().unwrap();
        reader.keep(turn, nobody_asked);
        assert!(!reader.is_kept() && reader.is_leader(next), "only the leader keeps");
        reader.keep(next, || false);
        reader.give_up_keeping();
        assert!(reader.pool_reads());
    }

    #[test]
    fn who_was_relieved_disturbs_the_next_leader_no_more() {
        let mut reader = Reader::default();
        let old = reader.take_lead().unwrap();
        reader.set_busy(old, Some(at(1)));
        assert!(reader.relieve(at(1), Duration::ZERO, || false));
        let new = reader.take_lead().unwrap();
        reader.set_busy(old, Some(at(2)));
        assert!(!reader.relieve(at(5), Duration::ZERO, nobody_asked), "the new one is not busy");
        reader.leave(Some(old), nobody_asked);
        assert!(reader.is_leader(new));
    }
}
