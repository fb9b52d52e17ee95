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

use super::{Event, Session};
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
}

impl<P: Port> Session<P> {
    /// Makes the keys of a secured link anew each time they are as old as `span`, or up to an eighth younger, instead of
    /// [`HANDSHAKE_LIFE`]; at least [`SHORTEST_HANDSHAKE_LIFE`]. Holds from the next handshake on, for the end that dialled:
    /// the other one follows.
    pub fn renew_every(&mut self, span: Duration) {
        self.renewal.every = span.max(SHORTEST_HANDSHAKE_LIFE);
    }

    /// The link is live, or has new keys.
    pub(super) fn rest_until_renewal(&mut self, now: Instant) {
        if self.mode() == Mode::Plain {
            return;
        }
        let pause = if self.dialed() { self.life_of_keys() } else { SHORTEST_HANDSHAKE_LIFE.divided_by(2) };
        self.renewal.step = Step::Resting { due: now + pause };
    }

    /// Links that began together have nonces of their own.
    fn life_of_keys(&self) -> Duration {
        let eighth = self.renewal.every.divided_by(8).as_micros();
        let less = (eighth >> 8).saturating_mul(self.nonce & 0xff);
        Duration::from_micros(self.renewal.every.as_micros().saturating_sub(less))
    }

    /// Does what is due of the renewal.
    pub(super) fn poll_renewal(&mut self, cx: &mut Context<'_, P>) {
        if !P::RENEWS_KEYS {
            return self.end_with_keys(cx);
        }
        if cx.now >= self.renewal.forget {
            self.link.cipher().forget_previous();
            self.renewal.forget = Instant::FAR_FUTURE;
        }
        // Only the end that dialled begins: two handshakes at once on one link would each wait for the other's answer.
        if let Step::Resting { due } = self.renewal.step {
            if self.dialed() && (cx.now >= due || self.link.cipher().is_worn()) {
                self.begin_renewal(cx, &[0; PROOF_BYTES]);
            }
            return;
        }
        match cx.now >= self.renewal.deadline(self.dialed()) {
            // A peer that keeps the link alive and does not go on would leave it under worn keys for ever.
            true => self.close(cx, CloseReason::HelloTimeout),
            false => self.pump_renewal(cx),
        }
    }

    /// In place of a renewal the end that dialled ends the link, to dial it again: as long as the keys last not while anything moves.
    fn end_with_keys(&mut self, cx: &mut Context<'_, P>) {
        let Step::Resting { due } = self.renewal.step else { return };
        if !self.dialed() || cx.now < due && !self.link.cipher().is_worn() {
            return;
        }
        if self.moves() && !self.link.cipher().is_worn() {
            self.renewal.step = Step::Resting { due: cx.now + SHORTEST_HANDSHAKE_LIFE };
        } else {
            self.close(cx, CloseReason::Exhausted);
        }
    }

    /// Proves once more that this unit has the key of the pair; the end that was dialled answers the peer's `message`.
    fn begin_renewal(&mut self, cx: &mut Context<'_, P>, message: &[u8; PROOF_BYTES]) {
        let Some(credentials) = self.credentials(cx) else { return };
        let begins = self.dialed();
        let reported = match self.link.cipher().prove(begins, credentials) {
            Ok(None) => self.link.cipher().answer(message),
            reported => reported,
        };
        match reported {
            Ok(Some(message)) => {
                self.renewal.step = Step::Telling { until: cx.now + RENEWAL_TIMEOUT, message };
                self.pump_renewal(cx);
            }
            Ok(None) | Err(_) => self.fail(cx),
        }
    }

    /// Sends what waits for room.
    pub(super) fn pump_renewal(&mut self, cx: &mut Context<'_, P>) {
        if !P::RENEWS_KEYS {
            return;
        }
        let sent = match self.renewal.step {
            Step::Resting { .. } | Step::Awaiting { .. } => return,
            Step::Telling { message, .. } if self.dialed() => self.link.send_frames(&[Frame::Proof(&message)]),
            Step::Telling { message, .. } => self.send_turn(Some(&message)),
            Step::Confirming { .. } => self.send_turn(None),
            Step::Acknowledging => self.link.send_frames(&[Frame::ACKNOWLEDGEMENT]),
        };
        if !sent {
            return;
        }
        match self.renewal.step {
            Step::Telling { until, .. } | Step::Confirming { until } => self.renewal.step = Step::Awaiting { until },
            _ => self.rest_until_renewal(cx.now),
        }
        self.flush(cx);
    }

    /// The last frame under the old keys, behind the message of the end that was dialled, and the first one under the new.
    fn send_turn(&mut self, message: Option<&[u8]>) -> bool {
        let confirmation = self.link.cipher().confirmation();
        let confirm = Frame::Confirm(&confirmation);
        match message {
            Some(message) => self.link.send_frames(&[Frame::Proof(message), Frame::TURN, confirm]),
            None => self.link.send_frames(&[Frame::TURN, confirm]),
        }
    }

    /// A proof frame on a live link: the peer's message, or its turn.
    pub(super) fn proof_on_live(&mut self, cx: &mut Context<'_, P>, span: Span, lent: &[u8]) -> Option<Event> {
        let message = self.link.view(span, lent);
        let understood = match (message.first_chunk(), self.renewal.step) {
            (None, _) if message.is_empty() => self.link.cipher().turned(),
            (Some(_), Step::Awaiting { .. }) if self.dialed() => return self.answered_anew(cx, span, lent),
            // Not before it is due: a handshake costs a board much computing, which a peer could otherwise ask for at will.
            (Some(first), Step::Resting { due }) if cx.now >= due && !self.dialed() && message.len() == PROOF_BYTES => {
                let first = *first;
                self.begin_renewal(cx, &first);
                return None;
            }
            _ => Err(CloseReason::Protocol),
        };
        if let Err(reason) = understood {
            self.close(cx, reason);
        }
        None
    }

    fn answered_anew(&mut self, cx: &mut Context<'_, P>, span: Span, lent: &[u8]) -> Option<Event> {
        if self.link.answer(span, lent) != Ok(None) {
            self.fail(cx);
        }
        None
    }

    /// A confirm frame on a live link: the first one under the peer's new keys, or what acknowledges this end's.
    pub(super) fn confirmation_on_live(&mut self, cx: &mut Context<'_, P>, span: Span, lent: &[u8]) -> Option<Event> {
        let Step::Awaiting { until } = self.renewal.step else {
            self.close(cx, CloseReason::Protocol);
            return None;
        };
        let understood = match self.link.view(span, lent).is_empty() {
            true if self.dialed() => self.adopt_keys(cx).map(|()| self.rest_until_renewal(cx.now)),
            true => Err(CloseReason::Protocol),
            false => self.link.confirmed(span, lent).and_then(|()| self.confirmed_anew(cx, until)),
        };
        if let Err(reason) = understood {
            self.close(cx, reason);
        }
        None
    }

    /// The peer has turned and confirmed. Its confirmation also says that it has that of an end that was dialled.
    fn confirmed_anew(&mut self, cx: &mut Context<'_, P>, until: Instant) -> Result<(), CloseReason> {
        self.renewal.forget = cx.now + RENEWAL_TIMEOUT;
        if self.dialed() {
            self.renewal.step = Step::Confirming { until };
        } else {
            self.adopt_keys(cx)?;
            self.renewal.step = Step::Acknowledging;
        }
        self.pump_renewal(cx);
        Ok(())
    }

    /// The peer has the key of this end's datagrams.
    fn adopt_keys(&mut self, cx: &mut Context<'_, P>) -> Result<(), CloseReason> {
        self.link.cipher().acknowledged()?;
        if let Some(peer) = self.identity() {
            cx.hub.enter(&mut |hub| hub.node.proven_anew(peer));
        }
        self.link.counters.count(LinkCounter::KeysRenewed);
        debug!("link {} has new keys", self.link.id().0);
        Ok(())
    }

    /// A datagram has been opened; the first one under a new key lets the one before go.
    pub(super) fn datagram_opened(&mut self, now: Instant) {
        if P::RENEWS_KEYS && self.renewal.forget != Instant::FAR_FUTURE && self.link.cipher().hears_newest() {
            self.renewal.forget = self.renewal.forget.min(now + PREVIOUS_KEY_LIFE);
        }
    }
}
