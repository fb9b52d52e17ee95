//! How a link begins: both ends introduce themselves, and on a secured link prove that they have the key of the pair.
//!
//! Until the peer's first sealed frame has opened, what it says costs a bounded time and the link's own bytes, and reaches
//! nobody: no limit, no clock and no decision of the node depends on it.

use super::{Event, Phase, Remote, Session};
use crate::config::{MINIMUM_CHUNK_BYTES, Mode, VERSIONS};
use crate::distribution::hello::{Hello, HelloError};
use crate::error::{CloseReason, Refusal};
use crate::host::connections::{LinkCounter, Liveness, Span};
use crate::host::endpoint::Endpoint as _;
use crate::host::frame::Frame;
use crate::host::secure::Secure;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

impl<P: Port> Session<P> {
    /// Proves to the peer that this unit has the pair's key, and waits for the same from it. If it does not come, the link
    /// ends with [`CloseReason::BadProof`], [`CloseReason::Unproven`] or [`CloseReason::HelloTimeout`].
    ///
    /// The end that was dialled begins: it is the first one to have both hellos, which the proof covers.
    fn prove(&mut self, cx: &mut Context<'_, P>, until: Instant) {
        let Some(credentials) = self.credentials(cx) else { return };
        let begins = !self.dialed();
        match self.link.cipher().prove(begins, credentials) {
            Ok(message) => {
                self.phase = Phase::Proving { until };
                self.send_proof(cx, message.as_ref().map(|message| &message[..]));
            }
            Err(_) => self.fail(cx),
        }
    }

    pub(super) fn hello_arrived(
        &mut self,
        cx: &mut Context<'_, P>,
        until: Instant,
        span: Span,
        lent: &[u8],
    ) -> Option<Event> {
        let mode = self.mode();
        let hello = match Hello::decode(self.link.view(span, lent), mode) {
            Ok(hello) => hello,
            Err(error) => {
                self.link.counters.count(LinkCounter::FramesRefused);
                if matches!(error, HelloError::Version(_)) && !self.dialed() {
                    // The other end learns our versions from our hello.
                    self.send_hello(cx);
                }
                self.refuse(cx, refusal_of(error));
                return None;
            }
        };
        self.link.introduce(span, lent);
        self.link.counters.add(LinkCounter::ItemsSkipped, hello.skipped.into());
        let datagrams = self.peer_address.at_port(hello.udp_port);
        let version = VERSIONS.common(hello.versions).unwrap_or(VERSIONS.last);
        self.remote = Some(Remote { hello, version, heard: cx.now, datagrams });
        if mode == Mode::Plain {
            self.limit_to_peer();
            return self.peer_known(cx);
        }
        if !self.dialed() {
            self.send_hello(cx);
        }
        if !matches!(self.phase, Phase::AwaitingHello { .. }) {
            return None;
        }
        self.prove(cx, until);
        None
    }

    /// The peer's message of the proof. To the end that dialled it proves the peer, since it covers this link's fresh nonce:
    /// that end answers, confirms that it has the keys, and says what it has published. The peer reads the list once it has
    /// decided to take this unit.
    pub(super) fn proof_arrived(&mut self, cx: &mut Context<'_, P>, span: Span, lent: &[u8]) -> Option<Event> {
        match self.link.answer(span, lent) {
            Ok(answer) => self.send_proof(cx, answer.as_ref().map(|answer| &answer[..])),
            Err(_) => self.fail(cx),
        }
        if self.dialed() && matches!(self.phase, Phase::Proving { .. }) {
            self.send_confirmation(cx);
            self.publish(cx);
        }
        None
    }

    /// The peer's first sealed frame has opened: it is who it says it is.
    pub(super) fn confirmation_arrived(&mut self, cx: &mut Context<'_, P>, span: Span, lent: &[u8]) -> Option<Event> {
        if self.link.confirmed(span, lent).is_err() {
            self.fail(cx);
            return None;
        }
        self.link.set_chunk_limit(usize::from(self.constraints.chunk_size).max(MINIMUM_CHUNK_BYTES));
        self.peer_known(cx)
    }

    /// The hub has taken the peer: it is told so with this end's hello, or on a secured link with its confirmation.
    pub(super) fn reply_to_hello(&mut self, cx: &mut Context<'_, P>) {
        match self.mode() {
            Mode::Plain => self.send_hello(cx),
            Mode::Secured => self.send_confirmation(cx),
        }
    }

    /// Ends a link whose peer has not proven who it is.
    pub(super) fn fail(&mut self, cx: &mut Context<'_, P>) {
        self.link.counters.count(LinkCounter::ProofsFailed);
        self.close(cx, CloseReason::BadProof);
    }

    /// What a peer that has proven nothing says about the end of the link is no more than its end. That it has no use for this
    /// end's proof is counted, and told where it has dialled: most often one of the two has another key. An end that dialled
    /// goes on searching.
    pub(super) fn ended_in_clear(&mut self, reason: Option<CloseReason>) {
        self.link.counters.count(LinkCounter::FarewellsInClear);
        if reason == Some(CloseReason::BadProof) && matches!(self.phase, Phase::Proving { .. }) {
            self.link.counters.count(LinkCounter::ProofsFailed);
            if !self.dialed() {
                return self.end(CloseReason::BadProof);
            }
        }
        self.end(CloseReason::Unproven);
    }

    /// What the hello told counts from here on.
    fn peer_known(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        let Some(Remote { hello, heard, .. }) = &self.remote else { return None };
        self.liveness = Liveness::new(cx.now, Duration::from_millis(u64::from(hello.keep_alive)));
        self.clock.hear(*heard, hello.stamp);
        self.phase = Phase::Deciding;
        self.consult(cx)
    }

    /// Sends nothing that is longer than the peer takes.
    fn limit_to_peer(&mut self) {
        let chunk_size = self.hello().map_or(MINIMUM_CHUNK_BYTES, |hello| usize::from(hello.limits.chunk_size));
        self.link.set_peer_limits(chunk_size);
    }

    fn send_proof(&mut self, cx: &mut Context<'_, P>, message: Option<&[u8]>) {
        let Some(message) = message else { return };
        if self.link.send_clear(&Frame::Proof(message)) {
            self.flush(cx);
        } else {
            self.close(cx, CloseReason::Protocol);
        }
    }

    /// Confirms that this end has the keys, to a peer that has proven itself: what follows may be as long as it takes.
    fn send_confirmation(&mut self, cx: &mut Context<'_, P>) {
        self.limit_to_peer();
        let confirmation = self.link.cipher().confirmation();
        if self.link.send_frame(&Frame::Confirm(&confirmation)) {
            self.flush(cx);
        } else {
            self.close(cx, CloseReason::Protocol);
        }
    }
}

const fn refusal_of(error: HelloError) -> Refusal {
    match error {
        HelloError::Version(versions) => Refusal::Version(versions),
        HelloError::Suite => Refusal::Suite,
        HelloError::Mode => Refusal::Mode,
        HelloError::Magic | HelloError::Malformed => Refusal::Malformed,
    }
}
