//! Round trips of the protocol itself, which involve no function.

use super::Phase;
use super::wire::Wire;
use crate::error::{Error, Limit};
use crate::host::frame::Frame;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// Pings have no number; their answers come in order. An unanswered ping older than this is taken as never sent: with a peer
/// silent for so long the link would have ended.
const FORGOTTEN: Duration = Duration::from_secs(10);

/// Pings in the stream that wait for their answers.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pings {
    unanswered: u16,
    last: Instant,
    own: Own,
}

/// The ping that the application asked for.
#[derive(Clone, Copy, Debug)]
enum Own {
    None,
    /// Its answer is the `behind`th from now.
    Sent {
        at: Instant,
        behind: u16,
    },
    Answered {
        took: Duration,
    },
}

impl Pings {
    pub(super) const fn new() -> Self {
        Self { unanswered: 0, last: Instant::START, own: Own::None }
    }

    fn sent(&mut self, now: Instant) {
        if now >= self.last + FORGOTTEN {
            self.unanswered = 0;
        }
        self.unanswered = self.unanswered.saturating_add(1);
        self.last = now;
    }

    /// Counts an answer; returns whether it is the one that the application waits for.
    pub(super) fn answered(&mut self, now: Instant) -> bool {
        self.unanswered = self.unanswered.saturating_sub(1);
        let Own::Sent { at, behind } = self.own else { return false };
        let is_own = behind <= 1;
        self.own = match is_own {
            true => Own::Answered { took: now.since(at) },
            false => Own::Sent { at, behind: behind.saturating_sub(1) },
        };
        is_own
    }

    /// Replaces an earlier ping that is still unanswered.
    pub(super) fn ping<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Result<(), Error> {
        if wire.phase != Phase::Live {
            return Err(Error::NotConnected);
        }
        self.own = Own::None;
        if !self.send(wire, cx.now) {
            return Err(Error::Full(Limit::SendQueue));
        }
        self.own = Own::Sent { at: cx.now, behind: self.unanswered };
        wire.flush(cx);
        Ok(())
    }

    /// The round trip of the last ping that the application asked for, once it is answered.
    pub(super) fn round_trip(&self) -> Option<Duration> {
        match self.own {
            Own::Answered { took } => Some(took),
            Own::None | Own::Sent { .. } => None,
        }
    }

    /// Puts a ping into the stream; `false` if there is no capacity.
    pub(super) fn send<P: Port>(&mut self, wire: &mut Wire<P>, now: Instant) -> bool {
        let accepted = wire.link.send_frame(&Frame::Ping);
        if accepted {
            self.sent(now);
        }
        accepted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn at(millis: u64) -> Instant {
        Instant::START + Duration::from_millis(millis)
    }

    fn ping(pings: &mut Pings, now: Instant) {
        pings.sent(now);
        pings.own = Own::Sent { at: now, behind: pings.unanswered };
    }

    fn took(pings: &Pings) -> Option<Duration> {
        pings.round_trip()
    }

    #[test]
    fn answers_to_earlier_pings_are_not_taken_for_the_own_one() {
        let mut pings = Pings::new();
        pings.sent(at(20_000));
        pings.sent(at(21_000));
        ping(&mut pings, at(21_500));
        assert!(!pings.answered(at(21_600)) && !pings.answered(at(21_700)));
        assert_eq!(took(&pings), None);
        assert!(pings.answered(at(22_500)));
        assert_eq!(took(&pings), Some(SECOND));
        assert!(!pings.answered(at(30_000)), "it is answered once");
        assert_eq!(took(&pings), Some(SECOND));
    }

    #[test]
    fn the_answer_to_one_that_was_given_up_does_not_answer_the_next() {
        let mut pings = Pings::new();
        ping(&mut pings, at(20_000));
        ping(&mut pings, at(21_000));
        assert!(!pings.answered(at(21_001)), "this is the answer to the first");
        assert!(pings.answered(at(22_000)));
        assert_eq!(took(&pings), Some(SECOND));
    }

    #[test]
    fn an_answer_that_never_came_does_not_shift_the_later_ones() {
        let mut pings = Pings::new();
        ping(&mut pings, at(20_000));
        ping(&mut pings, at(30_000));
        assert!(pings.answered(at(31_000)));
        assert_eq!(took(&pings), Some(SECOND));
    }
}
