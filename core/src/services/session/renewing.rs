//! New keys for a long-lived link: the handshake is repeated inside its sealed frames, while calls and leases continue.
//!
//! ```text
//! dialler                                        the other one
//!   proof 1  ------------------------------------>
//!            <------------------------------------  proof 2, turn | confirm
//!   turn | confirm  ----------------------------->  its datagrams go under the new key
//!            <------------------------------------  acknowledgement
//!   its datagrams go under the new key
//! ```
//!
//! A turn is the last frame of its direction under the old keys, so the receiver knows for each frame in flight which keys it was
//! sealed with. Only the end that dialled begins, so two renewals never collide.

use super::Event;
use super::due::Part;
use super::wire::Wire;
use crate::config::{HANDSHAKE_LIFE, Mode, PREVIOUS_KEY_LIFE, RENEWAL_TIMEOUT, SHORTEST_HANDSHAKE_LIFE};
use crate::error::CloseReason;
use crate::host::connections::{LinkCounter, Span};
use crate::host::frame::Frame;
use crate::host::secure::{PROOF_BYTES, Secure};
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// The renewal of a link's keys.
#[derive(Clone, Copy, Debug)]
pub(super) struct Renewal {
    every: Duration,
    step: Step,
    /// Until when datagrams under the previous key are accepted.
    forget: Instant,
}

/// The state of the renewal.
#[derive(Clone, Copy, Debug)]
enum Step {
    /// Idle. The end that dialled begins at `due`; the other end accepts a renewal from `due` on.
    Resting { due: Instant },
    /// This end's handshake message waits for send capacity.
    Telling { until: Instant, message: [u8; PROOF_BYTES] },
    /// Waiting for the peer.
    Awaiting { until: Instant },
    /// The dialling end's confirmation waits for send capacity.
    Confirming { until: Instant },
    /// The dialled end's acknowledgement waits for send capacity.
    Acknowledging,
}

impl Renewal {
    pub(super) const fn new() -> Self {
        Self { every: HANDSHAKE_LIFE, step: Step::Resting { due: Instant::FAR_FUTURE }, forget: Instant::FAR_FUTURE }
    }

    pub(super) fn deadline(&self, dialed: bool) -> Instant {
        let step = match self.step {
            Step::Resting { due } if dialed => due,
            Step::Resting { .. } | Step::Acknowledging => Instant::FAR_FUTURE,
            Step::Telling { until, .. } | Step::Awaiting { until } | Step::Confirming { until } => until,
        };
        step.min(self.forget)
    }

    fn note_due<P: Port>(&self, wire: &mut Wire<P>) {
        wire.due.set(Part::Keys, self.deadline(wire.dialed));
    }

    /// Sets the lifetime of keys: see [`Session::renew_every`](super::Session::renew_every).
    pub(super) fn renew_every(&mut self, span: Duration) {
        self.every = span.max(SHORTEST_HANDSHAKE_LIFE);
    }

    /// Schedules the next renewal: the link has just gone live or got new keys.
    pub(super) fn rest<P: Port>(&mut self, wire: &mut Wire<P>, now: Instant) {
        if wire.mode() == Mode::Plain {
            return;
        }
        let pause = if wire.dialed() { self.life_of_keys(wire.nonce) } else { SHORTEST_HANDSHAKE_LIFE.divided_by(2) };
        self.step = Step::Resting { due: now + pause };
        self.note_due(wire);
    }

    /// Up to an eighth shorter than the set lifetime, by nonce, so that links that began together do not renew together.
    fn life_of_keys(&self, nonce: u64) -> Duration {
        let eighth = self.every.divided_by(8).as_micros();
        let less = (eighth >> 8).saturating_mul(nonce & 0xff);
        Duration::from_micros(self.every.as_micros().saturating_sub(less))
    }

    /// Does what is due.
    pub(super) fn poll<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, moves: bool) {
        if !P::RENEWS_KEYS {
            return self.end_with_keys(wire, cx, moves);
        }
        if cx.now >= self.forget {
            wire.link.cipher().forget_previous();
            self.forget = Instant::FAR_FUTURE;
            self.note_due(wire);
        }
        // Only the end that dialled begins: with two handshakes at once each end would wait for the other's answer.
        if let Step::Resting { due } = self.step {
            if wire.dialed() && (cx.now >= due || wire.link.cipher().is_worn()) {
                self.begin(wire, cx, &[0; PROOF_BYTES]);
            }
            return;
        }
        match cx.now >= self.deadline(wire.dialed()) {
            // Otherwise a peer could keep the link alive under worn keys by never continuing.
            true => wire.close(cx, CloseReason::HelloTimeout),
            false => self.pump(wire, cx),
        }
    }

    /// For builds without renewal: the dialling end ends the link, to dial anew. While anything moves, only if the keys are worn.
    fn end_with_keys<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, moves: bool) {
        let Step::Resting { due } = self.step else { return };
        if !wire.dialed() || cx.now < due && !wire.link.cipher().is_worn() {
            return;
        }
        if moves && !wire.link.cipher().is_worn() {
            self.step = Step::Resting { due: cx.now + SHORTEST_HANDSHAKE_LIFE };
            self.note_due(wire);
        } else {
            wire.close(cx, CloseReason::Exhausted);
        }
    }

    /// Starts the handshake anew; the end that was dialled answers the peer's `message`.
    fn begin<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, message: &[u8; PROOF_BYTES]) {
        let Some(credentials) = wire.credentials(cx) else { return };
        let begins = wire.dialed();
        let reported = match wire.link.cipher().prove(begins, credentials) {
            Ok(None) => wire.link.cipher().answer(message),
            reported => reported,
        };
        match reported {
            Ok(Some(message)) => {
                self.step = Step::Telling { until: cx.now + RENEWAL_TIMEOUT, message };
                self.note_due(wire);
                self.pump(wire, cx);
            }
            Ok(None) | Err(_) => wire.fail(cx),
        }
    }

    /// Sends what waited for capacity.
    pub(super) fn pump<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        if !P::RENEWS_KEYS {
            return;
        }
        let sent = match self.step {
            Step::Resting { .. } | Step::Awaiting { .. } => return,
            Step::Telling { message, .. } if wire.dialed() => wire.link.send_frames(&[Frame::Proof(&message)]),
            Step::Telling { message, .. } => Self::send_turn(wire, Some(&message)),
            Step::Confirming { .. } => Self::send_turn(wire, None),
            Step::Acknowledging => wire.link.send_frames(&[Frame::ACKNOWLEDGEMENT]),
        };
        if !sent {
            return;
        }
        match self.step {
            // The time limit covers the whole handshake, so it is kept.
            Step::Telling { until, .. } | Step::Confirming { until } => self.step = Step::Awaiting { until },
            _ => self.rest(wire, cx.now),
        }
        wire.flush(cx);
    }

    /// Sends the last frame under the old keys, after the dialled end's message, and the first frame under the new keys.
    fn send_turn<P: Port>(wire: &mut Wire<P>, message: Option<&[u8]>) -> bool {
        let confirmation = wire.link.cipher().confirmation();
        let confirm = Frame::Confirm(&confirmation);
        match message {
            Some(message) => wire.link.send_frames(&[Frame::Proof(message), Frame::TURN, confirm]),
            None => wire.link.send_frames(&[Frame::TURN, confirm]),
        }
    }

    /// A proof frame on a live link: the peer's handshake message, or its turn.
    pub(super) fn proof_arrived<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        span: Span,
        lent: &[u8],
    ) -> Option<Event> {
        let message = wire.link.view(span, lent);
        let understood = match (message.first_chunk(), self.step) {
            (None, _) if message.is_empty() => wire.link.cipher().turned(),
            (Some(_), Step::Awaiting { .. }) if wire.dialed() => {
                if wire.link.answer(span, lent) != Ok(None) {
                    wire.fail(cx);
                }
                return None;
            }
            // Reject an early one: a handshake takes a board much computing time, which a peer could otherwise demand at will.
            (Some(first), Step::Resting { due }) if cx.now >= due && !wire.dialed() && message.len() == PROOF_BYTES => {
                let first = *first;
                self.begin(wire, cx, &first);
                return None;
            }
            _ => Err(CloseReason::Protocol),
        };
        if let Err(reason) = understood {
            wire.close(cx, reason);
        }
        None
    }

    /// A confirm frame on a live link: the first under the peer's new keys, or the acknowledgement of this end's.
    pub(super) fn confirmation_arrived<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        span: Span,
        lent: &[u8],
    ) -> Option<Event> {
        let Step::Awaiting { until } = self.step else {
            wire.close(cx, CloseReason::Protocol);
            return None;
        };
        let understood = match wire.link.view(span, lent).is_empty() {
            true if wire.dialed() => Self::adopt_keys(wire, cx).map(|()| self.rest(wire, cx.now)),
            true => Err(CloseReason::Protocol),
            false => wire.link.confirmed(span, lent).and_then(|()| self.confirmed_anew(wire, cx, until)),
        };
        if let Err(reason) = understood {
            wire.close(cx, reason);
        }
        None
    }

    /// The peer has turned and confirmed. A dialling peer thereby also acknowledges this end's confirmation.
    fn confirmed_anew<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        until: Instant,
    ) -> Result<(), CloseReason> {
        self.forget = cx.now + RENEWAL_TIMEOUT;
        if wire.dialed() {
            self.step = Step::Confirming { until };
        } else {
            Self::adopt_keys(wire, cx)?;
            self.step = Step::Acknowledging;
        }
        self.note_due(wire);
        self.pump(wire, cx);
        Ok(())
    }

    /// The peer has the new key of this end's datagrams, which is used from now on.
    fn adopt_keys<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Result<(), CloseReason> {
        wire.link.cipher().acknowledged()?;
        if let Some(peer) = wire.identity() {
            cx.hub.enter(&mut |hub| hub.node.proven_anew(peer));
        }
        wire.link.counters.count(LinkCounter::KeysRenewed);
        debug!("link {} has new keys", wire.link.id().0);
        Ok(())
    }

    /// Notes an opened datagram. The first one under a new key starts the end of the previous key.
    pub(super) fn datagram_opened<P: Port>(&mut self, wire: &mut Wire<P>, now: Instant) {
        if P::RENEWS_KEYS && self.forget != Instant::FAR_FUTURE && wire.link.cipher().hears_newest() {
            self.forget = self.forget.min(now + PREVIOUS_KEY_LIFE);
            self.note_due(wire);
        }
    }
}
