//! What the claim of a link's manager means for its calls (docs/concepts.md, "Two managers of one identity"): moving calls wait
//! until it is stored, and the link ends for a manager with a higher claim once nothing moves.

use super::Phase;
use super::due::Part;
use super::wire::Wire;
use crate::config::CHALLENGE_TIMEOUT;
use crate::distribution::claim::Claim;
use crate::distribution::connection_handler::MayMove;
use crate::distribution::hello::ClaimReport;
use crate::distribution::message::Control;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// Polling interval while waiting.
const LOOK: Duration = Duration::from_millis(20);

/// The peer's claim, as far as its calls depend on it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Obedience {
    /// The hub has allowed moving calls under this claim, so need not be asked again.
    may_move: Option<Claim>,
    /// A moving call waits for the hub's permission.
    pub(super) waits: bool,
    /// For a manager with a higher claim: until when the peer has to show life, and until when its orders may continue. Both in
    /// the far future if there is none.
    gives_way: (Instant, Instant),
    /// The hub knows that this unit does not hear the peer, or the peer does not hear this unit.
    is_cut_off: bool,
    /// This unit has raised its own claim, and the peer has not been notified.
    pub(super) has_news: bool,
}

impl Obedience {
    const STAYS: (Instant, Instant) = (Instant::FAR_FUTURE, Instant::FAR_FUTURE);

    pub(super) const fn new() -> Self {
        Self { may_move: None, waits: false, gives_way: Self::STAYS, is_cut_off: false, has_news: false }
    }

    pub(super) fn gives_way(&self) -> bool {
        self.gives_way != Self::STAYS
    }

    pub(super) fn send_claim<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        if !P::MANAGES || !self.has_news {
            return;
        }
        let (now, mut report) = (cx.now, None);
        cx.hub.enter(&mut |hub| report = hub.node.own_report(now));
        self.has_news = report.is_some_and(|report| !wire.send_control(cx, &Control::Claimed { report }));
    }

    /// The peer has raised its claim.
    pub(super) fn claim_arrived<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, report: &ClaimReport) {
        let Some(peer) = wire.remote.as_ref().map(|remote| &remote.hello.identity) else { return };
        let mut stays = false;
        cx.hub.enter(&mut |hub| stays = hub.node.claim_raised(peer, report));
        if stays {
            self.gives_way = Self::STAYS;
        }
        self.may_move = None;
        // The hub now counts the peer as heard, both ways: it is told again if that is not so.
        self.is_cut_off = false;
        self.note_silence(wire, cx);
    }

    /// Tells the hub when this unit and the peer last heard each other, once either misses a keep-alive: a standby that asks counts
    /// from then, and not from the end of the link. To be called as soon as either is heard again, before anything can end the link.
    pub(super) fn note_silence<P: Port>(&mut self, wire: &Wire<P>, cx: &mut Context<'_, P>) {
        let liveness = &wire.liveness;
        let silent = liveness.is_silent().then(|| liveness.silent_for(cx.now));
        let apart = silent.max(liveness.missed_for(wire.own_keep_alive()));
        if core::mem::replace(&mut self.is_cut_off, apart.is_some()) != apart.is_some()
            && let Some(remote) = &wire.remote
        {
            let heard = apart.map_or(Instant::FAR_FUTURE, |apart| cx.now - apart);
            cx.hub.enter(&mut |hub| hub.node.manager_heard(heard, &remote.hello.identity));
        }
    }

    /// The claim under which a moving call of the peer may begin. `None` makes the call wait until the port has stored the claim, if
    /// this unit then [`waits`](Self::waits); else nothing of this peer may move.
    pub(super) fn may_move<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Option<Claim> {
        if self.may_move.is_none()
            && let Some(remote) = &wire.remote
        {
            let (now, peer) = (cx.now, &remote.hello.identity);
            let (mut may, mut under) = (MayMove::No, Claim::NONE);
            cx.hub.enter(&mut |hub| (may, under) = (hub.node.may_move(now, peer), hub.node.obeyed(peer)));
            (self.may_move, self.waits) = ((may == MayMove::Yes).then_some(under), may == MayMove::Waits);
            if self.waits {
                wire.due.set(Part::Claims, now + LOOK);
            }
        }
        self.may_move
    }

    /// A manager with a higher claim wants to command, unless the peer has raised its own meanwhile, or the other one is gone. The time
    /// for orders runs from the first such request.
    pub(super) fn give_way<P: Port>(&mut self, wire: &Wire<P>, cx: &mut Context<'_, P>) {
        let Some(remote) = wire.remote.as_ref().filter(|_| wire.phase == Phase::Live) else { return };
        let mut is_outranked = false;
        cx.hub.enter(&mut |hub| is_outranked = hub.node.is_outranked(&remote.hello.identity));
        if is_outranked {
            let answers_by = if self.gives_way() { self.gives_way.0 } else { Self::answers_by(wire, cx.now) };
            self.gives_way = (answers_by, self.gives_way.1.min(cx.now + wire.constraints.handover));
        }
    }

    /// The peer is asked for a sign of life. The link of one that gives way ends without an answer [`CHALLENGE_TIMEOUT`] after the first
    /// question that is open since it gives way, however often newcomers make the hub ask again.
    pub(super) fn note_question<P: Port>(&mut self, wire: &mut Wire<P>, now: Instant) {
        if self.gives_way() && !wire.challenged {
            self.gives_way.0 = Self::answers_by(wire, now);
        }
        if self.gives_way() {
            wire.due.hasten(Part::Claims, now + LOOK);
        }
    }

    fn answers_by<P: Port>(wire: &Wire<P>, now: Instant) -> Instant {
        // One that says that it hears nothing of this unit cannot answer either.
        let hears = wire.liveness.missed_for(wire.own_keep_alive()).is_none();
        if hears { now + CHALLENGE_TIMEOUT } else { now }
    }

    /// Checks what is waited for. If the link gives way, returns the time limits for the peer to show life and for its orders.
    pub(super) fn poll<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Option<(Instant, Instant)> {
        wire.due.set(Part::Claims, Instant::FAR_FUTURE);
        if self.waits {
            self.may_move(wire, cx);
        }
        if !self.gives_way() {
            return None;
        }
        wire.due.set(Part::Claims, cx.now + LOOK);
        Some(self.gives_way)
    }
}
