//! Round trips of the protocol itself, with no function involved.

use super::{Event, Phase, Session};
use crate::error::{Error, Limit};
use crate::host::frame::Frame;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// Answers come in the order of the pings. One that has not come after this was never sent: a link whose peer is silent
/// for so long has ended.
const FORGOTTEN: Duration = Duration::from_secs(10);

/// Pings in the stream and their answers, which carry no number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pings {
    unanswered: u16,
    last: Instant,
    own: Option<Own>,
}

/// The ping that somebody asked for.
#[derive(Clone, Copy, Debug)]
struct Own {
    sent: Instant,
    /// Answers up to its own.
    behind: u16,
    took: Option<Duration>,
}

impl Pings {
    pub(super) const fn new() -> Self {
        Self { unanswered: 0, last: Instant::START, own: None }
    }

    fn sent(&mut self, now: Instant) {
        if now >= self.last + FORGOTTEN {
            self.unanswered = 0;
        }
        self.unanswered = self.unanswered.saturating_add(1);
        self.last = now;
    }

    /// An answer has come; whether it is the one that somebody waits for.
    fn answered(&mut self, now: Instant) -> bool {
        self.unanswered = self.unanswered.saturating_sub(1);
        let Some(own) = self.own.as_mut().filter(|own| own.took.is_none()) else { return false };
        own.behind = own.behind.saturating_sub(1);
        if own.behind == 0 {
            own.took = Some(now.since(own.sent));
        }
        own.behind == 0
    }
}

impl<P: Port> Session<P> {
    /// Asks the peer for a sign of life and measures how long it takes: [`Event::Answered`] comes with it, and
    /// [`round_trip`](Self::round_trip) tells. A ping before it that has not been answered is given up.
    ///
    /// [`Error::NotConnected`] on a link that is not live, [`Error::Full`] where the stream has no room.
    pub fn ping(&mut self, cx: &mut Context<'_, P>) -> Result<(), Error> {
        if self.phase != Phase::Live {
            return Err(Error::NotConnected);
        }
        self.pings.own = None;
        if !self.send_ping(cx.now) {
            return Err(Error::Full(Limit::SendQueue));
        }
        self.pings.own = Some(Own { sent: cx.now, behind: self.pings.unanswered, took: None });
        self.flush(cx);
        Ok(())
    }

    /// How long the answer to the last [`ping`](Self::ping) took, once it has come.
    pub fn round_trip(&self) -> Option<Duration> {
        self.pings.own.and_then(|own| own.took)
    }

    /// Puts a ping into the stream; `false` where there is no room.
    pub(super) fn send_ping(&mut self, now: Instant) -> bool {
        let accepted = self.link.send_frame(&Frame::Ping);
        if accepted {
            self.pings.sent(now);
        }
        accepted
    }

    pub(super) fn pong_arrived(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        self.show_life(cx);
        if self.pings.answered(cx.now) { Some(Event::Answered) } else { None }
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
        pings.own = Some(Own { sent: now, behind: pings.unanswered, took: None });
    }

    fn took(pings: &Pings) -> Option<Duration> {
        pings.own.and_then(|own| own.took)
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
