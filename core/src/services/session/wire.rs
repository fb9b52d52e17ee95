//! What a session lends its parts: the link and its encryption, the peer and its liveness, function lists and deadlines.

use super::due::{Due, Part};
use super::peer_clock::PeerClock;
use super::publishing::Publishing;
use super::subscription::Pace;
use super::{ReplyBlock, Results};
use crate::ability::{STREAMS, State};
use crate::bytes::copy;
use crate::config::{Constraints, DATAGRAM_BYTES, GATHER, Mode, Priority, SIGNATURE_BYTES};
use crate::distribution::datagram;
use crate::distribution::function_list::{Generation, Slot, TheirFunctionList};
use crate::distribution::hello::Hello;
use crate::distribution::identity::{Fleet, Identity};
use crate::distribution::message::{
    CONTROL_BYTES, Control, PUBLISH_BYTES, REPLY_BYTES, SESSION_BODY_BYTES, encode_failure, encode_reply,
};
use crate::error::{CloseReason, Error, Refusal};
use crate::host::connections::{Link, LinkCounter, Liveness, Report};
use crate::host::endpoint::Endpoint as _;
use crate::host::frame::{ChunkWriter, Frame};
use crate::host::secure::{DATAGRAM_OVERHEAD, Secure};
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// Longest session datagram.
const LONGEST_DATAGRAM: usize =
    datagram::SESSION_HEADER_BYTES + SESSION_BODY_BYTES + DATAGRAM_BYTES + DATAGRAM_OVERHEAD;
/// Gathered one-way messages are sent once they are this long together.
const GATHERED_BYTES: usize = 8 * 1024;

/// The state of the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// The port is opening the connection, or waits for the peer's hello.
    AwaitingHello { until: Instant },
    /// The peer has to prove that it has the key: by its handshake message, then by a sealed frame (Noise NNpsk0).
    Proving { until: Instant },
    /// Waiting for the hub's decision about the peer.
    Deciding,
    /// Both ends have admitted each other.
    Live,
    /// The link has ended; what was in flight is being reported.
    Ending(CloseReason),
    /// Everything has been reported.
    Ended,
}

/// What the peer's hello said.
pub(super) struct Remote<E> {
    pub(super) hello: Hello,
    /// The highest version that both ends speak.
    pub(super) version: u8,
    /// When the hello arrived.
    pub(super) heard: Instant,
    /// Where its session datagrams go.
    pub(super) datagrams: E,
}

/// The link, lent to each part of a session.
pub(super) struct Wire<P: Port> {
    pub(super) link: Link<P::Storage, P::Cipher>,
    pub(super) phase: Phase,
    pub(super) dialed: bool,
    pub(super) nonce: u64,
    pub(super) fleet: Fleet,
    /// The keep-alive interval in milliseconds that this unit's hello announced.
    pub(super) reported_keep_alive: u32,
    pub(super) constraints: Constraints,
    pub(super) remote: Option<Remote<P::Endpoint>>,
    pub(super) peer_address: P::Endpoint,
    pub(super) liveness: Liveness,
    /// Bytes of the stream are left unread for now.
    pub(super) holds: bool,
    /// The hub has taken the peer.
    pub(super) joined: bool,
    /// The peer has listed its functions.
    pub(super) listed: bool,
    /// The hub waits for a sign of life to decide about a duplicate.
    pub(super) challenged: bool,
    pub(super) clock: PeerClock,
    pub(super) due: Due,
    pub(super) pace: State<Pace, { STREAMS as usize }>,
    /// The last write: one-way messages within a short time after it are gathered.
    pub(super) last_write: Instant,
    pub(super) publishing: Publishing<P::Storage>,
    pub(super) theirs: TheirFunctionList<P::Storage>,
    /// Counts calls of `receive`: [`Results`](super::Results) of an earlier one are stale.
    pub(super) step: u32,
}

impl<P: Port> Wire<P> {
    /// Whether this unit opened the connection.
    pub(super) const fn dialed(&self) -> bool {
        !P::MANAGES || self.dialed
    }

    /// The peer's hello, once it has come.
    pub(super) fn hello(&self) -> Option<&Hello> {
        self.remote.as_ref().map(|remote| &remote.hello)
    }

    /// The peer's identity, once its hello has come.
    pub(super) fn identity(&self) -> Option<&Identity> {
        self.hello().map(|hello| &hello.identity)
    }

    /// Ends the link with a close frame.
    pub(super) fn close(&mut self, cx: &mut Context<'_, P>, reason: CloseReason) {
        if matches!(reason, CloseReason::Protocol | CloseReason::Oversize) {
            self.link.counters.count(LinkCounter::FramesRefused);
        }
        self.farewell(cx, &Frame::Close(close_code(reason)));
        self.end(reason);
    }

    /// Refuses the peer and tells it why.
    pub(super) fn refuse(&mut self, cx: &mut Context<'_, P>, refusal: Refusal) {
        match refusal {
            Refusal::NoKey => {
                // Send the code of a failed proof: the peer need not know whether its key is missing or wrong.
                self.link.counters.count(LinkCounter::KeysMissing);
                self.farewell(cx, &Frame::Close(close_code(CloseReason::BadProof)));
            }
            _ => self.farewell(cx, &Frame::Refuse(refusal.to_wire())),
        }
        self.end(CloseReason::Refused(refusal));
    }

    /// Sends a last frame after what is queued, as far as the network takes bytes now.
    pub(super) fn farewell(&mut self, cx: &mut Context<'_, P>, frame: &Frame<'_>) {
        if !matches!(self.phase, Phase::Ending(_) | Phase::Ended) {
            // Flush first: a frame would overtake queued messages.
            let _ = self.link.flush(cx.mailman, cx.buffers);
            self.send_frame(frame);
            let _ = self.link.flush(cx.mailman, cx.buffers);
        }
    }

    pub(super) fn end(&mut self, reason: CloseReason) {
        if !matches!(self.phase, Phase::Ending(_) | Phase::Ended) {
            debug!("link {} ends: {}", self.link.id().0, reason);
            self.phase = Phase::Ending(reason);
        }
    }

    pub(super) fn flush(&mut self, cx: &mut Context<'_, P>) {
        self.due.set(Part::Gathered, Instant::FAR_FUTURE);
        if let Err(reason) = self.link.flush(cx.mailman, cx.buffers) {
            self.end(reason);
        }
        if STREAMS {
            self.note_pace();
        }
    }

    /// Queues a frame for the stream, sealed once encryption has begun.
    pub(super) fn send_frame(&mut self, frame: &Frame<'_>) -> bool {
        if self.link.cipher().is_sealing() { self.link.send_frame(frame) } else { self.link.send_clear(frame) }
    }

    pub(super) fn mode(&mut self) -> Mode {
        self.link.cipher().mode()
    }

    /// Longest block that the peer accepts.
    pub(super) fn peer_message_size(&self) -> u32 {
        self.hello().map_or(0, |hello| hello.limits.message_size)
    }

    /// The minimum interval: this unit's or the peer's, whichever is longer.
    pub(super) fn interval(&self) -> Duration {
        let theirs = self.hello().map_or(0, |hello| hello.limits.minimum_interval);
        self.constraints.minimum_interval.max(Duration::from_micros(u64::from(theirs)))
    }

    /// Not generic over the writer: one instance has a third of the code size of one for each message.
    pub(super) fn send(
        &mut self,
        cx: &mut Context<'_, P>,
        priority: Priority,
        total: usize,
        write: &mut dyn FnMut(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        let sent = self.link.send_message(cx.mailman, cx.buffers, priority, total, false, write);
        self.after_sending(cx, false, sent)
    }

    pub(super) fn send_error(
        &mut self,
        cx: &mut Context<'_, P>,
        id: u32,
        priority: Priority,
        wants_reply: bool,
        error: Error,
    ) -> Result<(), Error> {
        let header = if wants_reply { encode_reply(id, Err(error)) } else { encode_failure(id, error) };
        let write: &mut dyn FnMut(&mut ChunkWriter<'_>) = &mut |writer| writer.put(&header);
        match self.send(cx, priority, REPLY_BYTES, write) {
            Err(Error::Full(_)) if self.link.send_short(priority, REPLY_BYTES, write) => {
                self.flush(cx);
                Ok(())
            }
            sent => sent,
        }
    }

    /// Results that are in the lent bytes, or in a buffer of the link.
    pub(super) fn results<'b>(&'b self, results: &Results, lent: &'b [u8]) -> Result<ReplyBlock<'b>, Error> {
        if results.step != self.step {
            return Err(Error::ResultLost);
        }
        self.kept_results(results.slot, results.generation, self.link.view(results.block, lent))
    }

    /// As [`results`](Self::results), for the progress of a running call.
    pub(super) fn progress<'b>(&'b self, values: &Results, lent: &'b [u8]) -> Result<ReplyBlock<'b>, Error> {
        let block = self.results(values, lent)?;
        Ok(ReplyBlock { specs: block.signature.progress(), ..block })
    }

    pub(super) fn kept_results<'b>(
        &'b self,
        slot: Slot,
        generation: Generation,
        bytes: &'b [u8],
    ) -> Result<ReplyBlock<'b>, Error> {
        let function = self.theirs.function(slot).filter(|function| function.generation == generation);
        let signature = function.ok_or(Error::ResultLost)?.signature;
        Ok(ReplyBlock { signature, specs: signature.results(), bytes })
    }

    /// Updates the gathering of one-way messages after an attempt to send. If a message was refused, the gathered ones are sent
    /// now: no later message may come to take them along, and they occupy the buffer that the retry needs.
    pub(super) fn after_sending(
        &mut self,
        cx: &mut Context<'_, P>,
        hold: bool,
        sent: Result<(), Error>,
    ) -> Result<(), Error> {
        if STREAMS {
            self.note_pace();
        }
        match sent {
            Ok(()) if hold && self.link.queued() < GATHERED_BYTES => {
                self.due.hasten(Part::Gathered, cx.now + GATHER);
                return sent;
            }
            // A message that is not held has taken the gathered ones along.
            Ok(()) if !hold => self.due.set(Part::Gathered, Instant::FAR_FUTURE),
            Ok(()) => self.flush(cx),
            Err(Error::Closed(reason)) => self.end(reason),
            Err(_) => self.flush(cx),
        }
        if sent.is_ok() {
            self.last_write = cx.now;
        }
        sent
    }

    /// Sets when samples are sent next.
    pub(super) fn pace_samples(&mut self, pace: Pace) {
        self.pace.change(|known| *known = pace);
        self.note_pace();
    }

    /// A queue that blocked samples may have drained with another write, of which the port is not notified.
    #[inline(never)]
    fn note_pace(&mut self) {
        self.due.set(Part::Streams, self.pace.deadline(self.link.queued()));
    }

    /// Notes that the stream brought bytes.
    #[inline(never)]
    pub(super) fn heard(&mut self, now: Instant) {
        if self.liveness.is_silent() {
            self.due.set(Part::KeepAlive, now);
        }
        self.liveness.heard(now);
        self.note_liveness();
    }

    pub(super) fn note_liveness(&mut self) {
        self.due.set(Part::Liveness, self.liveness.deadline());
    }

    /// Whether to hold back a one-way message made at `now`, so that later ones share its write.
    pub(super) fn may_gather(&self, now: Instant) -> bool {
        self.last_write != Instant::START && now < self.last_write + GATHER
    }

    /// Whether published functions may be sent: the link is live, or the peer that this end dialled has proven itself.
    pub(super) fn may_advertise(&mut self) -> bool {
        match self.phase {
            Phase::Live => true,
            Phase::Proving { .. } => self.dialed && self.link.cipher().is_sealing(),
            _ => false,
        }
    }

    /// Sends a control message; `false` if there is no capacity, or the peer may not get one yet.
    pub(super) fn send_control(&mut self, cx: &mut Context<'_, P>, control: &Control<'_>) -> bool {
        if !self.may_advertise() {
            return false;
        }
        let mut bytes = [0; CONTROL_BYTES + PUBLISH_BYTES + SIGNATURE_BYTES];
        let Some(message) = control.encode(&mut bytes) else { return false };
        self.send(cx, Priority::High, message.len(), &mut |writer| writer.put(message)).is_ok()
    }

    /// The keep-alive interval by which the peer counts.
    pub(super) fn own_keep_alive(&self) -> Duration {
        Duration::from_millis(self.reported_keep_alive.into())
    }

    /// Bytes written to the stream so far, modulo 2^32 as in reports.
    pub(super) fn sent(&self) -> u32 {
        self.link.counters.value(LinkCounter::BytesSent) as u32
    }

    /// A report of what has arrived from the peer.
    pub(super) fn report(&self) -> Report {
        Report {
            received: self.link.counters.value(LinkCounter::BytesReceived) as u32,
            hears: self.liveness.hears(),
            holds: self.holds,
            misses: self.liveness.is_silent(),
        }
    }

    /// Sends a session datagram of `body` followed by `rest`. `false` if the network refused it.
    pub(super) fn send_datagram(&mut self, cx: &mut Context<'_, P>, body: &[u8], rest: &[u8]) -> bool {
        let Some((to, header)) = self.datagram_header() else { return false };
        let (front, back) = self.link.cipher().datagram_room();
        let mut bytes = [0; LONGEST_DATAGRAM];
        let start = header.len().saturating_add(front);
        let end = start.saturating_add(body.len()).saturating_add(rest.len());
        let place = bytes.get_mut(start..end).and_then(|place| place.split_at_mut_checked(body.len()));
        let Some((place, behind)) = place else { return false };
        copy(body, place);
        copy(rest, behind);
        let Some(whole) = bytes.get_mut(..end.saturating_add(back)) else { return false };
        let Some((head, sealed)) = whole.split_first_chunk_mut() else { return false };
        *head = header;
        if !self.link.cipher().seal_datagram(&header, sealed) {
            return false;
        }
        let sent = cx.mailman.send_to(to, whole);
        if sent {
            self.link.counters.count(LinkCounter::DatagramsSent);
        }
        sent
    }

    fn datagram_header(&mut self) -> Option<(P::Endpoint, [u8; datagram::SESSION_HEADER_BYTES])> {
        let mode = self.mode();
        let remote = self.remote.as_ref()?;
        if remote.datagrams.port() == 0 {
            return None;
        }
        let header = datagram::session_header(mode, remote.version, self.fleet, remote.hello.link, remote.hello.nonce);
        Some((remote.datagrams, header))
    }

    /// The key of the pair, with which each end authenticates itself. Ends the link if there is none.
    pub(super) fn credentials(&mut self, cx: &mut Context<'_, P>) -> Option<<P::Cipher as Secure>::Credentials> {
        let Remote { hello, .. } = self.remote.as_ref()?;
        let credentials = cx.keys.credentials(hello);
        if credentials.is_none() {
            let (now, from) = (cx.now, self.peer_address);
            cx.hub.enter(&mut |hub| hub.node.refuse_without_key(now, from, &hello.identity));
            self.refuse(cx, Refusal::NoKey);
        }
        credentials
    }

    /// Ends a link whose peer failed to authenticate itself.
    pub(super) fn fail(&mut self, cx: &mut Context<'_, P>) {
        self.link.counters.count(LinkCounter::ProofsFailed);
        self.close(cx, CloseReason::BadProof);
    }
}

pub(super) const fn close_code(reason: CloseReason) -> u8 {
    match reason {
        CloseReason::Stopped | CloseReason::StoppedHere => 1,
        CloseReason::Reset => 2,
        CloseReason::Silent => 3,
        CloseReason::PeerRestarted => 4,
        CloseReason::Protocol => 5,
        CloseReason::Oversize => 6,
        CloseReason::HelloTimeout => 7,
        CloseReason::Refused(_) => 8,
        CloseReason::DialFailed => 9,
        CloseReason::Exhausted => 10,
        CloseReason::Unproven => 11,
        CloseReason::BadProof => 12,
        CloseReason::StreamDead { long: false } => 13,
        CloseReason::StreamDead { long: true } => 14,
    }
}

pub(super) const fn close_reason(code: u8) -> CloseReason {
    match code {
        1 => CloseReason::Stopped,
        3 => CloseReason::Silent,
        4 => CloseReason::PeerRestarted,
        5 => CloseReason::Protocol,
        6 => CloseReason::Oversize,
        7 => CloseReason::HelloTimeout,
        10 => CloseReason::Exhausted,
        12 => CloseReason::BadProof,
        13 => CloseReason::StreamDead { long: false },
        14 => CloseReason::StreamDead { long: true },
        _ => CloseReason::Reset,
    }
}
