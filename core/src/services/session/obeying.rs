//! What the claim of a link's manager means for its calls: moving ones wait until it is stored, and the link ends when a manager
//! with a higher claim wants to command and nothing moves.

use super::{Phase, Session};
use crate::config::CHALLENGE_TIMEOUT;
use crate::distribution::claim::Claim;
use crate::distribution::hello::ClaimReport;
use crate::distribution::message::Control;
use crate::error::CloseReason;
use crate::services::lease::{Lease, Stage};
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// How often it is looked at what is waited for.
const LOOK: Duration = Duration::from_millis(20);

/// The peer's claim, as far as its calls have to do with it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Obedience {
    /// The hub lets moving calls begin under this claim: it need not be asked again.
    may_move: Option<Claim>,
    /// A moving call waits until the hub lets it begin.
    pub(super) waits: bool,
    /// A manager with a higher claim wants to command: until when the peer has to answer, and its orders go on.
    gives_way: Option<(Instant, Instant)>,
    pub(super) next: Instant,
    /// This unit's own claim was raised, which the peer has not been told.
    pub(super) has_news: bool,
}

impl Obedience {
    pub(super) const fn new() -> Self {
        Self { may_move: None, waits: false, gives_way: None, next: Instant::FAR_FUTURE, has_news: false }
    }

    pub(super) const fn gives_way(&self) -> bool {
        self.gives_way.is_some()
    }
}

impl<P: Port> Session<P> {
    /// This unit's claim is another one: the peer is told.
    pub fn announce_claim(&mut self, cx: &mut Context<'_, P>) {
        self.obedience.has_news = true;
        self.pump(cx);
    }

    pub(super) fn send_claim(&mut self, cx: &mut Context<'_, P>) {
        if !P::MANAGES || !self.obedience.has_news {
            return;
        }
        let (now, mut report) = (cx.now, None);
        cx.hub.enter(&mut |hub| report = hub.node.own_report(now));
        self.obedience.has_news = report.is_some_and(|report| !self.send_control(cx, &Control::Claimed { report }));
    }

    /// The peer has raised its claim.
    pub(super) fn claim_arrived(&mut self, cx: &mut Context<'_, P>, report: &ClaimReport) {
        let Some(peer) = self.remote.as_ref().map(|remote| &remote.hello.identity) else { return };
        let now = cx.now;
        cx.hub.enter(&mut |hub| hub.node.claim_raised(now, peer, report));
        self.obedience.may_move = None;
    }

    /// The claim under which a moving call of the peer may begin. Without one it waits, and the port is asked to store the peer's.
    pub(super) fn may_move(&mut self, cx: &mut Context<'_, P>) -> Option<Claim> {
        if self.obedience.may_move.is_none()
            && let Some(remote) = &self.remote
        {
            let (now, peer, mut may) = (cx.now, &remote.hello.identity, None);
            cx.hub.enter(&mut |hub| may = hub.node.may_move(now, peer).then(|| hub.node.obeyed(peer)));
            (self.obedience.may_move, self.obedience.waits) = (may, may.is_none());
            if may.is_none() {
                self.obedience.next = now + LOOK;
            }
        }
        self.obedience.may_move
    }

    /// A manager with a higher claim wants to command: the peer shows whether it is alive.
    pub(super) fn give_way(&mut self, cx: &mut Context<'_, P>) {
        if self.phase == Phase::Live && self.obedience.gives_way.is_none() {
            self.obedience.gives_way = Some((cx.now + CHALLENGE_TIMEOUT, cx.now + self.constraints.handover));
            self.obedience.next = cx.now + LOOK;
            self.challenge(cx);
        }
    }

    /// Ends a link that gives way when nothing of it moves; whether it has.
    pub(super) fn has_given_way(&mut self, cx: &mut Context<'_, P>) -> bool {
        let ends = self.obedience.gives_way() && self.is_quiet(cx);
        if ends {
            self.close(cx, CloseReason::PeerRestarted);
        }
        ends
    }

    pub(super) fn poll_obedience(&mut self, cx: &mut Context<'_, P>) {
        if cx.now < self.obedience.next {
            return;
        }
        self.obedience.next = Instant::FAR_FUTURE;
        if self.obedience.waits {
            self.may_move(cx);
        }
        let Some((silent_at, until)) = self.obedience.gives_way else { return };
        self.obedience.next = cx.now + LOOK;
        if self.challenged {
            if cx.now >= silent_at {
                self.close(cx, CloseReason::PeerRestarted);
            }
        } else if !self.has_given_way(cx) && cx.now >= until {
            (0..self.granted.len()).for_each(|index| self.cut_lease(cx, index));
        }
    }

    /// No order of the peer is live, nothing is stopping, and no hook is due.
    fn is_quiet(&self, cx: &Context<'_, P>) -> bool {
        let is_busy = |lease: &Lease| lease.awaits_hook() || lease.stage(cx.now) == Stage::Stopping;
        let functions = self.publishing.all_slots().filter_map(|slot| cx.functions.function(slot));
        self.granted.is_empty() && !functions.filter_map(|function| function.handler.lease()).any(is_busy)
    }
}
