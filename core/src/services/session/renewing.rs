//! New keys for a link that lives long: the proof of its beginning is made anew in its sealed frames, while calls, leases
//! and emergencies go on.
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
//! A turn is the last frame of its direction under the old keys, so each frame is opened with the keys that it was sealed
//! with, however many are on their way. Only the end that dialled begins, so two renewals never meet.

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
    /// When datagrams under the key before are taken no longer.
    forget: Instant,
}

/// Where it stands.
#[derive(Clone, Copy, Debug)]
enum Step {
    /// Nothing goes on. The end that dialled begins at this time; the other one lets it begin from then on.
    Resting { due: Instant },
    /// This end's message waits for room in the stream.
    Telling { until: Instant, message: [u8; PROOF_BYTES] },
    /// The peer is to go on.
    Awaiting { until: Instant },
    /// The confirmation of the end that dialled waits for room in the stream.
    Confirming { until: Instant },
    /// The acknowledgement of the end that was dialled waits for room in the stream.
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

    /// Makes the keys of a secured link anew each time they are as old as `span`, or up to an eighth younger, instead of
    /// [`HANDSHAKE_LIFE`]; at least [`SHORTEST_HANDSHAKE_LIFE`]. Holds from the next handshake on, for the end that dialled:
    /// the other one follows.
    pub(super) fn renew_every(&mut self, span: Duration) {
        self.every = span.max(SHORTEST_HANDSHAKE_LIFE);
    }

    /// The link is live, or has new keys.
    pub(super) fn rest<P: Port>(&mut self, wire: &mut Wire<P>, now: Instant) {
        if wire.mode() == Mode::Plain {
            return;
        }
        let pause = if wire.dialed() { self.life_of_keys(wire.nonce) } else { SHORTEST_HANDSHAKE_LIFE.divided_by(2) };
        self.step = Step::Resting { due: now + pause };
        self.note_due(wire);
    }

    /// Links that began together have nonces of their own.
    fn life_of_keys(&self, nonce: u64) -> Duration {
        let eighth = self.every.divided_by(8).as_micros();
        let less = (eighth >> 8).saturating_mul(nonce & 0xff);
        Duration::from_micros(self.every.as_micros().saturating_sub(less))
    }

    /// Does what is due of the renewal.
    pub(super) fn poll<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, moves: bool) {
        if !P::RENEWS_KEYS {
            return self.end_with_keys(wire, cx, moves);
        }
        if cx.now >= self.forget {
            wire.link.cipher().forget_previous();
            self.forget = Instant::FAR_FUTURE;
            self.note_due(wire);
        }
        // Only the end that dialled begins: two handshakes at once on one link would each wait for the other's answer.
        if let Step::Resting { due } = self.step {
            if wire.dialed() && (cx.now >= due || wire.link.cipher().is_worn()) {
                self.begin(wire, cx, &[0; PROOF_BYTES]);
            }
            return;
        }
        match cx.now >= self.deadline(wire.dialed()) {
            // A peer that keeps the link alive and does not go on would leave it under worn keys for ever.
            true => wire.close(cx, CloseReason::HelloTimeout),
            false => self.pump(wire, cx),
        }
    }

    /// In place of a renewal the end that dialled ends the link, to dial it again: as long as the keys last not while anything moves.
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

    /// Proves once more that this unit has the key of the pair; the end that was dialled answers the peer's `message`.
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

    /// Sends what waits for room.
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
            // Until the same time as before.
            Step::Telling { until, .. } | Step::Confirming { until } => self.step = Step::Awaiting { until },
            _ => self.rest(wire, cx.now),
        }
        wire.flush(cx);
    }

    /// The last frame under the old keys, behind the message of the end that was dialled, and the first one under the new.
    fn send_turn<P: Port>(wire: &mut Wire<P>, message: Option<&[u8]>) -> bool {
        let confirmation = wire.link.cipher().confirmation();
        let confirm = Frame::Confirm(&confirmation);
        match message {
            Some(message) => wire.link.send_frames(&[Frame::Proof(message), Frame::TURN, confirm]),
            None => wire.link.send_frames(&[Frame::TURN, confirm]),
        }
    }

    /// A proof frame on a live link: the peer's message, or its turn.
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
            // Not before it is due: a handshake costs a board much computing, which a peer could otherwise ask for at will.
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

    /// A confirm frame on a live link: the first one under the peer's new keys, or what acknowledges this end's.
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

    /// The peer has turned and confirmed. Its confirmation also says that it has that of an end that was dialled.
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

    /// The peer has the key of this end's datagrams.
    fn adopt_keys<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Result<(), CloseReason> {
        wire.link.cipher().acknowledged()?;
        if let Some(peer) = wire.identity() {
            cx.hub.enter(&mut |hub| hub.node.proven_anew(peer));
        }
        wire.link.counters.count(LinkCounter::KeysRenewed);
        debug!("link {} has new keys", wire.link.id().0);
        Ok(())
    }

    /// A datagram has been opened; the first one under a new key lets the one before go.
    pub(super) fn datagram_opened<P: Port>(&mut self, wire: &mut Wire<P>, now: Instant) {
        if P::RENEWS_KEYS && self.forget != Instant::FAR_FUTURE && wire.link.cipher().hears_newest() {
            self.forget = self.forget.min(now + PREVIOUS_KEY_LIFE);
            self.note_due(wire);
        }
    }
}
