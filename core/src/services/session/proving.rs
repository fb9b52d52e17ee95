//! How a link begins: hellos, then in secured mode the proof that both ends have the pair's key (Noise `NNpsk0`; docs/wire.md).
//!
//! Until the peer's first sealed frame has been opened, what it sends takes bounded time and only the link's own buffer, and
//! affects nothing else: no limit, no clock and no decision of the node.

use super::due::Part;
use super::wire::{Phase, Remote, Wire};
use crate::config::{MINIMUM_CHUNK_BYTES, Mode, VERSIONS};
use crate::distribution::hello::{Hello, HelloError};
use crate::error::{CloseReason, Refusal};
use crate::host::connections::{LinkCounter, Liveness, Span};
use crate::host::endpoint::Endpoint as _;
use crate::host::frame::Frame;
use crate::host::secure::Secure;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// Length of the longest hello frame.
const HELLO_BYTES: usize = 320;

pub(super) fn send_hello<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
    let (mut bytes, mut length) = ([0; HELLO_BYTES], 0);
    let (now, mode, link) = (cx.now, wire.mode(), wire.link.id());
    let (nonce, remote, fleet, reported) = (wire.nonce, &wire.remote, &mut wire.fleet, &mut wire.reported_keep_alive);
    cx.hub.enter(&mut |hub| {
        let mut hello = hub.node.hello(now, link, nonce);
        if let Some(remote) = remote {
            hello.obeyed = hub.node.obeyed_report(now, &remote.hello.identity);
        }
        (*fleet, *reported) = (hello.fleet, hello.keep_alive);
        length = hello.encode(mode, &mut bytes).unwrap_or(0);
    });
    let bytes = bytes.get_mut(..length).unwrap_or_default();
    wire.link.cipher().offer(bytes);
    wire.link.cipher().introduce(bytes);
    wire.send_frame(&Frame::Hello(bytes));
    wire.flush(cx);
}

/// Sends this unit's handshake message and waits for the peer's. If none comes, the link ends with [`CloseReason::BadProof`],
/// [`CloseReason::Unproven`] or [`CloseReason::HelloTimeout`].
///
/// The dialled end begins: it is the first to have both hellos, which the handshake authenticates as its prologue.
fn prove<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>, until: Instant) {
    let Some(credentials) = wire.credentials(cx) else { return };
    let begins = !wire.dialed();
    match wire.link.cipher().prove(begins, credentials) {
        Ok(message) => {
            wire.phase = Phase::Proving { until };
            send_proof(wire, cx, message.as_ref().map(|message| &message[..]));
        }
        Err(_) => wire.fail(cx),
    }
}

pub(super) fn hello_arrived<P: Port>(
    wire: &mut Wire<P>,
    cx: &mut Context<'_, P>,
    until: Instant,
    span: Span,
    lent: &[u8],
) -> bool {
    let mode = wire.mode();
    let hello = match Hello::decode(wire.link.view(span, lent), mode) {
        Ok(hello) => hello,
        Err(error) => {
            wire.link.counters.count(LinkCounter::FramesRefused);
            if matches!(error, HelloError::Version(_)) && !wire.dialed() {
                // Send our hello all the same: the other end learns from it which versions we speak.
                send_hello(wire, cx);
            }
            wire.refuse(cx, refusal_of(error));
            return false;
        }
    };
    wire.link.introduce(span, lent);
    wire.link.counters.add(LinkCounter::ItemsSkipped, hello.skipped.into());
    let datagrams = wire.peer_address.at_port(hello.udp_port);
    let version = VERSIONS.common(hello.versions).unwrap_or(VERSIONS.last);
    wire.remote = Some(Remote { hello, version, heard: cx.now, datagrams });
    if mode == Mode::Plain {
        limit_to_peer(wire);
        peer_known(wire, cx.now);
        return true;
    }
    if !wire.dialed() {
        send_hello(wire, cx);
    }
    if !matches!(wire.phase, Phase::AwaitingHello { .. }) {
        return false;
    }
    prove(wire, cx, until);
    false
}

/// Processes the peer's handshake message. To the dialling end it authenticates the peer, since it covers this link's fresh
/// nonce: that end answers, confirms its keys and publishes its list, which the peer processes once it has admitted this unit.
pub(super) fn proof_arrived<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>, span: Span, lent: &[u8]) -> bool {
    match wire.link.answer(span, lent) {
        Ok(answer) => send_proof(wire, cx, answer.as_ref().map(|answer| &answer[..])),
        Err(_) => wire.fail(cx),
    }
    if wire.dialed() && matches!(wire.phase, Phase::Proving { .. }) {
        send_confirmation(wire, cx);
        return true;
    }
    false
}

/// The peer's first sealed frame has been opened: its identity is authentic.
pub(super) fn confirmation_arrived<P: Port>(
    wire: &mut Wire<P>,
    cx: &mut Context<'_, P>,
    span: Span,
    lent: &[u8],
) -> bool {
    if wire.link.confirmed(span, lent).is_err() {
        wire.fail(cx);
        return false;
    }
    wire.link.set_chunk_limit(usize::from(wire.constraints.chunk_size).max(MINIMUM_CHUNK_BYTES));
    peer_known(wire, cx.now);
    true
}

/// The hub has admitted the peer: replies with this end's hello, or in secured mode with its confirmation.
pub(super) fn reply_to_hello<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
    match wire.mode() {
        Mode::Plain => send_hello(wire, cx),
        Mode::Secured => send_confirmation(wire, cx),
    }
}

/// A refusal or close frame from a peer that is not authenticated only ends the link; its reason is not believed. If it says that
/// this end's proof is bad, count it and, if the peer dialled, report it: most likely one of the two has another key. A dialling
/// end goes on searching.
pub(super) fn ended_in_clear<P: Port>(wire: &mut Wire<P>, reason: Option<CloseReason>) {
    wire.link.counters.count(LinkCounter::FarewellsInClear);
    if reason == Some(CloseReason::BadProof) && matches!(wire.phase, Phase::Proving { .. }) {
        wire.link.counters.count(LinkCounter::ProofsFailed);
        if !wire.dialed() {
            return wire.end(CloseReason::BadProof);
        }
    }
    wire.end(CloseReason::Unproven);
}

/// The contents of the hello are used from here on.
fn peer_known<P: Port>(wire: &mut Wire<P>, now: Instant) {
    let Some(Remote { hello, heard, .. }) = &wire.remote else { return };
    wire.liveness = Liveness::new(now, Duration::from_millis(u64::from(hello.keep_alive)));
    wire.due.set(Part::Liveness, wire.liveness.deadline());
    wire.clock.hear(*heard, hello.stamp);
    wire.phase = Phase::Deciding;
}

/// Adopts the peer's limit on frames.
fn limit_to_peer<P: Port>(wire: &mut Wire<P>) {
    let chunk_size = wire.hello().map_or(MINIMUM_CHUNK_BYTES, |hello| usize::from(hello.limits.chunk_size));
    wire.link.set_peer_limits(chunk_size);
}

fn send_proof<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>, message: Option<&[u8]>) {
    let Some(message) = message else { return };
    if wire.link.send_clear(&Frame::Proof(message)) {
        wire.flush(cx);
    } else {
        wire.close(cx, CloseReason::Protocol);
    }
}

/// Confirms this end's keys to an authenticated peer. Later frames may be as long as the peer accepts.
fn send_confirmation<P: Port>(wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
    limit_to_peer(wire);
    let confirmation = wire.link.cipher().confirmation();
    if wire.link.send_frame(&Frame::Confirm(&confirmation)) {
        wire.flush(cx);
    } else {
        wire.close(cx, CloseReason::Protocol);
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
