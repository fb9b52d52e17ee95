//! Who reads a link: the pool through epoll, or one thread that has the lead and blocks in reading it.
//!
//! Two kinds of threads lead. A caller that waits for a reply takes the lead if nobody has it and reads its own reply.
//! A thread of the pool that has just served a link, quickly, stays on it and waits for the next call. A link that is
//! led is out of the pool's hands (disarmed); when the leader leaves, it passes the lead to a waiting caller, or gives
//! the link back to the pool (arms it). A thread of the pool that runs a handler while it leads can lose the lead: then
//! others read on.
//!
//! The decisions stand here, without any threads, so that they can be checked by a model: at every moment somebody reads
//! the link, or has been told to.

use cara_core::time::{Duration, Instant};

/// Who has the lead.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Reader {
    lead: Option<Lead>,
    /// A caller has been woken to take the lead and has not yet done so.
    passed: bool,
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
        self.lead.is_none() && !self.passed
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

    /// Takes the lead from a thread that has been busy for longer than `limit`; others read from here on.
    pub(crate) fn relieve(&mut self, now: Instant, limit: Duration, pass: impl FnOnce() -> bool) -> bool {
        let overdue = self.lead.and_then(|lead| lead.busy_since).is_some_and(|since| now >= since + limit);
        if overdue {
            self.lead = None;
            self.passed = pass();
        }
        overdue
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
