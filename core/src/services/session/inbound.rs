//! The receive path: bytes become frames, frames messages, messages events.

use super::answering::{is_emergency, read_arguments};
use super::details::DetailsPart;
use super::due::Part;
use super::granting::Granting;
use super::peer_clock::sent_at_earliest;
use super::permitting::{may_publish, permit_call};
use super::publishing::Advertised;
use super::streaming::StreamsPart;
use super::{Event, Phase, Session, close_reason, proving};
use crate::ability::{DETAILS, HAND_OVER, STREAMS};
use crate::config::{EMERGENCY_BYTES, Mode, Priority};
use crate::distribution::failure::Failure;
use crate::distribution::function::{Attributes, Signature, VariableSpecs};
use crate::distribution::function_list::{Function, Generation, Slot};
use crate::distribution::hello::Manager;
use crate::distribution::items::{Items, Malformed};
use crate::distribution::message::{Control, Message, REQUEST_BYTES, RequestHeader, SessionBody};
use crate::distribution::parameters::ParametersView;
use crate::distribution::{block, datagram};
use crate::error::{CloseReason, Error, Refusal};
use crate::host::connections::{Inbound, LinkCounter, Span};
use crate::host::endpoint::Endpoint as _;
use crate::host::frame::Frame;
use crate::host::secure::{Secure, Unopened};
use crate::services::calls::{CallHead, Seen};
use crate::services::lease::ActuatorState;
use crate::services::lease::Service;
use crate::services::requests::{CallId, Pending};
use crate::services::{Context, Port};
use crate::storage::LEFT_BY_WAITING;

/// How something reached this unit.
#[derive(Clone, Copy)]
enum Way {
    Stream,
    Datagram,
}

/// Result of [`Session::receive`].
#[derive(Clone, Copy, Debug)]
pub struct Receipt {
    /// How many of the lent bytes were consumed.
    pub consumed: usize,
    /// The event that they caused.
    pub event: Option<Event>,
    /// Offer the rest again later: no message buffer is free, or the hub has not decided about the peer yet.
    pub paused: bool,
}

/// Where a call's results are, until the next [`Session::receive`]; [`Session::results`] reads them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Results {
    pub(super) slot: Slot,
    pub(super) generation: Generation,
    pub(super) block: Span,
    /// Detects that the session has received since: other bytes may lie there by now.
    pub(super) step: u32,
}

/// The results of a call, still in the receive buffer.
#[derive(Clone, Copy, Debug)]
pub struct ReplyBlock<'b> {
    pub(super) signature: Signature<'b>,
    pub(super) specs: VariableSpecs<'b>,
    pub(super) bytes: &'b [u8],
}

impl Results {
    /// The function that answered.
    pub const fn function(&self) -> (Slot, Generation) {
        (self.slot, self.generation)
    }
}

impl<'b> ReplyBlock<'b> {
    /// Updates `parameters` with the results; on an error they are unchanged.
    pub fn read_into(&self, parameters: &mut ParametersView) -> Result<(), Error> {
        block::read(self.specs, self.bytes, parameters)
    }

    /// The function that answered.
    pub const fn signature(&self) -> Signature<'b> {
        self.signature
    }

    /// Capacity in bytes of a `Parameters` that holds all values. The signature does not say how long lists are, but together
    /// they are no longer than the block.
    pub fn parameters_bytes(&self) -> u32 {
        let block = u32::try_from(self.bytes.len()).unwrap_or(u32::MAX);
        self.specs.parameters_bytes().saturating_add(block)
    }

    /// The encoded block.
    pub const fn bytes(&self) -> &'b [u8] {
        self.bytes
    }
}

/// Longest block of an emergency request: the message has a header, too.
const EMERGENCY_BLOCK_BYTES: u32 = (EMERGENCY_BYTES - REQUEST_BYTES) as u32;

impl<P: Port> Session<P> {
    /// Whether the peer has joined and its list of functions, which may be empty, is complete. A node counts from then on.
    pub const fn is_listed(&self) -> bool {
        self.wire.joined && self.wire.listed
    }

    /// Takes bytes that the port has read from the stream. Call it again with the rest, and finally with an empty slice, until
    /// it consumes nothing and returns no event.
    ///
    /// Arguments of a call that may begin at once are decoded into `arguments`. Without them, or if more bytes follow that have
    /// to be examined first, the call is queued for [`next_call`](Self::next_call). An emergency begins at once: nothing behind
    /// it can have precedence.
    pub fn receive(
        &mut self,
        cx: &mut Context<'_, P>,
        lent: &mut [u8],
        arguments: Option<&mut ParametersView>,
    ) -> Receipt {
        self.wire.step = self.wire.step.wrapping_add(1);
        match self.wire.phase {
            Phase::Ending(_) | Phase::Ended => return Receipt { consumed: lent.len(), event: None, paused: false },
            // Read nothing after the hello until the hub has decided: a request of a peer that it refuses must not run.
            Phase::Deciding => {
                return Receipt { consumed: 0, event: None, paused: true };
            }
            Phase::AwaitingHello { .. } | Phase::Proving { .. } | Phase::Live => {}
        }
        let received = match self.wire.link.receive(cx.buffers, lent) {
            Ok(received) => received,
            Err(reason) => {
                match self.wire.phase {
                    // All failures before the proof look the same from outside, so that an attacker learns nothing from them.
                    Phase::Proving { .. } => self.wire.fail(cx),
                    _ => self.wire.close(cx, reason),
                }
                return Receipt { consumed: lent.len(), event: None, paused: false };
            }
        };
        self.wire.holds = received.paused;
        let Some(inbound) = received.inbound else {
            return Receipt { consumed: received.consumed, event: None, paused: received.paused };
        };
        // A frame of a later version is no sign of life, since this unit cannot read it; a session body is judged once decoded.
        if !matches!(inbound, Inbound::Skipped | Inbound::Session(_)) {
            self.wire.heard(cx.now);
            self.granting.obedience.note_silence(&self.wire, cx);
        }
        let is_emergency = matches!(inbound, Inbound::Message(Priority::Emergency, _));
        // Begin a call only if no bytes follow it, else queue it: an emergency further back in these bytes comes first.
        let at_once = is_emergency || received.consumed == lent.len();
        let event = self.digest(cx, inbound, lent, arguments.filter(|_| at_once));
        Receipt { consumed: received.consumed, event, paused: received.paused }
    }

    /// Takes the body of a datagram that is [for the session](datagram::for_session) of this link, and the nonce in its header.
    /// Decrypts it in place; one of another session is dropped and counted.
    pub fn datagram(
        &mut self,
        cx: &mut Context<'_, P>,
        from: P::Endpoint,
        nonce: u64,
        body: &mut [u8],
    ) -> Option<Event> {
        // In secured mode nonce and seal identify the sender: its source may be another address of that host, or a NAT's.
        let is_of_peer = self.wire.mode() == Mode::Secured || from.is_of_host(&self.wire.peer_address);
        if self.wire.phase != Phase::Live || nonce != self.wire.nonce || !is_of_peer {
            self.wire.link.counters.count(LinkCounter::DatagramsDropped);
            return None;
        }
        let version = self.wire.remote.as_ref()?.version;
        let header = datagram::session_header(self.wire.mode(), version, self.wire.fleet, self.wire.link.id().0, nonce);
        let body = match self.wire.link.cipher().open_datagram(&header, body) {
            Ok(body) => &*body,
            Err(error) => {
                self.wire.link.counters.count(counter_of(error));
                return None;
            }
        };
        self.wire.link.counters.count(LinkCounter::DatagramsReceived);
        self.renewal.datagram_opened(&mut self.wire, cx.now);
        self.session_body(cx, Span::lent(body.len()), body, Way::Datagram)
    }

    /// The results that an [`Event::Reply`] refers to; `lent` is the slice lent to the [`receive`](Self::receive) that returned
    /// it. [`Error::ResultLost`] if the peer has replaced the function, or the session has received since.
    pub fn results<'b>(&'b self, results: &Results, lent: &'b [u8]) -> Result<ReplyBlock<'b>, Error> {
        self.wire.results(results, lent)
    }

    /// Reads results that the port has copied from a [`ReplyBlock`]; [`Error::ResultLost`] if the function has changed since.
    pub fn kept_results<'b>(
        &'b self,
        slot: Slot,
        generation: Generation,
        bytes: &'b [u8],
    ) -> Result<ReplyBlock<'b>, Error> {
        self.wire.kept_results(slot, generation, bytes)
    }

    /// The values of an [`Event::Progress`], read as [`results`](Self::results) reads results.
    pub fn progress_values<'b>(&'b self, values: &Results, lent: &'b [u8]) -> Result<ReplyBlock<'b>, Error> {
        self.wire.progress(values, lent)
    }

    /// Text and values of the failure that the last event, an [`Event::Reply`] or [`Event::Failed`], reported; `None` if the
    /// Text and values of the failure in the last event, an [`Event::Reply`] or [`Event::Failed`]; `None` if the peer sent none.
    /// Only replies carry values. `lent` is the slice lent to the [`receive`](Self::receive) that returned the event.
    pub fn failure(&mut self, lent: &[u8]) -> Option<Failure> {
        self.details.failure(&mut self.wire, lent)
    }

    fn digest(
        &mut self,
        cx: &mut Context<'_, P>,
        inbound: Inbound,
        lent: &[u8],
        arguments: Option<&mut ParametersView>,
    ) -> Option<Event> {
        match (inbound, self.wire.phase) {
            // Before encryption anyone on the path can send this: do not take it for the peer's decision, and go on searching.
            (Inbound::Refuse(_), _) if !self.wire.link.cipher().is_sealing() => {
                proving::ended_in_clear(&mut self.wire, None);
                None
            }
            (Inbound::Close(code), _) if !self.wire.link.cipher().is_sealing() => {
                proving::ended_in_clear(&mut self.wire, Some(close_reason(code)));
                None
            }
            (Inbound::Refuse(code), _) => {
                self.wire.end(CloseReason::Refused(Refusal::from_wire(code)));
                None
            }
            (Inbound::Close(code), _) => {
                self.wire.end(close_reason(code));
                None
            }
            (Inbound::Hello(span), Phase::AwaitingHello { until }) => {
                if proving::hello_arrived(&mut self.wire, cx, until, span, lent) { self.consult(cx) } else { None }
            }
            (Inbound::Proof(span), Phase::Proving { .. }) => {
                // Publish now; the peer processes the list once it has admitted this unit.
                if proving::proof_arrived(&mut self.wire, cx, span, lent) {
                    self.publish(cx);
                }
                None
            }
            (Inbound::Confirm(span), Phase::Proving { .. }) if self.wire.link.cipher().is_sealing() => {
                if proving::confirmation_arrived(&mut self.wire, cx, span, lent) {
                    self.consult(cx)
                } else {
                    None
                }
            }
            (Inbound::Proof(span), Phase::Live) if P::RENEWS_KEYS => {
                self.renewal.proof_arrived(&mut self.wire, cx, span, lent)
            }
            (Inbound::Confirm(span), Phase::Live) if P::RENEWS_KEYS => {
                self.renewal.confirmation_arrived(&mut self.wire, cx, span, lent)
            }
            // Answer in the stream, too: only a reply that has passed the send queue shows that the stream makes progress.
            (Inbound::Ping, Phase::Live) => {
                self.wire.link.send_frame(&Frame::Pong);
                self.wire.flush(cx);
                None
            }
            (Inbound::Pong, Phase::Live) => {
                self.show_life(cx);
                self.pings.answered(cx.now).then_some(Event::Answered)
            }
            (Inbound::Session(span), Phase::Live) => self.session_body(cx, span, lent, Way::Stream),
            (Inbound::Message(priority, span), Phase::Live) => {
                self.message_arrived(cx, priority, span, lent, arguments)
            }
            (Inbound::Skipped, Phase::Live) => {
                self.wire.link.counters.count(LinkCounter::ItemsSkipped);
                None
            }
            _ => {
                self.wire.close(cx, CloseReason::Protocol);
                None
            }
        }
    }

    /// Processes a session body. One that can be decoded is a sign of life.
    fn session_body(&mut self, cx: &mut Context<'_, P>, span: Span, lent: &[u8], way: Way) -> Option<Event> {
        let body = SessionBody::decode(self.wire.link.view(span, lent));
        if body.is_some() {
            if self.wire.liveness.is_silent() {
                // Tell the peer at once that it is heard again.
                self.wire.due.set(Part::KeepAlive, cx.now);
            }
            match way {
                Way::Stream => self.wire.liveness.heard(cx.now),
                Way::Datagram if self.wire.liveness.heard_datagram(cx.now) => {
                    // Tell the peer at once that its datagrams arrive.
                    self.wire.due.set(Part::KeepAlive, cx.now);
                }
                Way::Datagram => {}
            }
            self.wire.due.set(Part::Liveness, self.wire.liveness.deadline());
            self.granting.obedience.note_silence(&self.wire, cx);
        }
        match body {
            Some(SessionBody::KeepAlive { stamp, report }) => {
                self.wire.clock.hear(cx.now, stamp);
                self.reported(cx, report);
                None
            }
            Some(SessionBody::Renew(renewal)) => {
                self.granting.renewed(&mut self.wire, &self.calls, cx, &renewal);
                let answer = SessionBody::renewed(renewal.call);
                match way {
                    Way::Datagram => drop(self.wire.send_datagram(cx, &answer, &[])),
                    Way::Stream => {
                        self.wire.link.send_frame(&Frame::Session(&answer));
                        self.wire.flush(cx);
                    }
                }
                None
            }
            Some(SessionBody::Renewed(call)) if P::CALLS => {
                self.calling.was_renewed(cx.now, CallId(call));
                None
            }
            Some(SessionBody::Release(release)) => self.granting.released(&mut self.calls, cx, release),
            Some(SessionBody::Cancel(release)) if DETAILS => {
                self.details.cancelled(&mut self.wire, &mut self.calls, release);
                self.granting.released(&mut self.calls, cx, release)
            }
            Some(SessionBody::ReleaseAll(slot, id)) => self.granting.released_all(&mut self.wire, cx, slot, id),
            Some(SessionBody::Message(priority, message)) if P::TAKES_DATAGRAM_REQUESTS => {
                match (Priority::from_wire(priority), Message::decode(message)) {
                    (Some(priority), Some(Message::Request(header, block))) => {
                        let block = span.last(block.len());
                        self.request_arrived(cx, priority, &header, block, lent, None)
                    }
                    _ => self.unreadable_datagram(),
                }
            }
            Some(SessionBody::Ping) => {
                let report = self.wire.report();
                self.wire.send_datagram(cx, &SessionBody::pong(report), &[]);
                None
            }
            Some(SessionBody::Pong(report)) => {
                self.show_life(cx);
                self.reported(cx, report);
                None
            }
            Some(SessionBody::Close(code)) => {
                if let (Way::Datagram, reason @ CloseReason::StreamDead { .. }) = (way, close_reason(code)) {
                    self.wire.link.counters.count(LinkCounter::StreamsDied);
                    self.wire.end(reason);
                }
                None
            }
            // This build lacks the ability, so it asked for none of these and does not decode them.
            Some(SessionBody::Cancel(_) | SessionBody::Renewed(_) | SessionBody::Message(..)) | None => {
                self.unreadable_datagram()
            }
        }
    }

    fn unreadable_datagram(&mut self) -> Option<Event> {
        self.wire.link.counters.count(LinkCounter::DatagramsDropped);
        None
    }

    fn message_arrived(
        &mut self,
        cx: &mut Context<'_, P>,
        priority: Priority,
        span: Span,
        lent: &[u8],
        arguments: Option<&mut ParametersView>,
    ) -> Option<Event> {
        if DETAILS && P::CALLS {
            self.details.note_failure(&self.wire, &self.calling.requests, span, lent);
        }
        match Message::decode(self.wire.link.view(span, lent)) {
            Some(Message::Request(header, block)) => {
                let block = span.last(block.len());
                self.request_arrived(cx, priority, &header, block, lent, arguments)
            }
            Some(Message::Reply(id, result)) if P::CALLS => {
                let block = result.map(|block| span.last(block.len()));
                self.reply_arrived(cx, CallId(id), block)
            }
            Some(Message::Failure(id, error)) if P::CALLS => self.failure_arrived(cx, CallId(id), error),
            Some(Message::Sample(header, block)) if STREAMS && P::CALLS => {
                let block = span.last(block.len());
                StreamsPart::sample_arrived(&mut self.wire, cx.now, &header, block, lent)
            }
            Some(Message::Progress(id, block)) if DETAILS && P::CALLS => {
                let block = span.last(block.len());
                DetailsPart::progress_arrived(&mut self.wire, &self.calling.requests, CallId(id), block, lent)
            }
            Some(Message::Control(items)) => {
                let items = span.last(items.len());
                self.controls_arrived(cx, items, lent)
            }
            Some(Message::Reply(..) | Message::Failure(..) | Message::Sample(..) | Message::Progress(..)) | None => {
                self.wire.close(cx, CloseReason::Protocol);
                None
            }
        }
    }

    /// Processes the items of a control message in order. An item that yields an event has to be the last one.
    fn controls_arrived(&mut self, cx: &mut Context<'_, P>, items: Span, lent: &[u8]) -> Option<Event> {
        let (mut left, mut event) = (self.wire.link.view(items, lent).len(), None);
        while left > 0 && event.is_none() && self.wire.phase == Phase::Live {
            (left, event) = self.control_arrived(cx, items.last(left), lent);
        }
        if event.is_some() && Items::new(self.wire.link.view(items.last(left), lent)).next().is_some() {
            self.wire.close(cx, CloseReason::Protocol);
        }
        event
    }

    fn reply_arrived(&mut self, cx: &mut Context<'_, P>, id: CallId, result: Result<Span, Error>) -> Option<Event> {
        let Some(pending) = self.calling.requests.close(id) else {
            // The call has timed out or was cancelled, and its lease was released then, or it was never made. Drop the results.
            self.wire.link.counters.count(LinkCounter::RepliesLate);
            return None;
        };
        match result {
            Err(error) => {
                // The call failed at the peer, perhaps after its lease had begun there: release it.
                self.calling.release_call(&mut self.wire, cx, id, Some(pending));
                Some(Event::Reply(id, Err(error)))
            }
            Ok(block) => {
                self.calling.note_answered(&pending);
                let Pending { slot, generation, .. } = pending;
                Some(Event::Reply(id, Ok(Results { slot, generation, block, step: self.wire.step })))
            }
        }
    }

    /// A failure ends a request without a reply. A peer that sends one for a call that waits has answered it.
    fn failure_arrived(&mut self, cx: &mut Context<'_, P>, id: CallId, error: Error) -> Option<Event> {
        if self.calling.requests.waiting_for(id).is_some() || id > self.calling.requests.newest() {
            return self.reply_arrived(cx, id, Err(error));
        }
        self.calling.release_call(&mut self.wire, cx, id, None);
        Some(Event::Failed(id, error))
    }

    /// Processes the first item; returns how many bytes of items are left.
    fn control_arrived(&mut self, cx: &mut Context<'_, P>, items: Span, lent: &[u8]) -> (usize, Option<Event>) {
        let mut items = Items::new(self.wire.link.view(items, lent));
        let Some(item) = items.next() else { return (0, None) };
        let left = items.rest().len();
        let mut skipped = 0;
        let control = item.and_then(|item| match Control::take(&item)? {
            None => item.skip(&mut skipped).map(|()| None),
            control => Ok(control),
        });
        let control = match control {
            Ok(Some(control)) => control,
            Ok(None) => {
                self.wire.link.counters.add(LinkCounter::ItemsSkipped, skipped.into());
                return (left, None);
            }
            Err(Malformed) => {
                self.wire.close(cx, CloseReason::Protocol);
                return (0, None);
            }
        };
        let event = match control {
            Control::Publish { .. } if !P::CALLS => {
                self.wire.theirs.skip();
                self.wire.link.counters.count(LinkCounter::FunctionsSkipped);
                None
            }
            Control::Publish { slot, generation, attributes, signature } => {
                let kept = Attributes::decode(attributes).map(|attributes| {
                    self.wire.theirs.insert(Slot(slot), Generation(generation), attributes, signature)
                });
                let allowed = may_publish(cx, self.wire.remote.as_ref(), &mut self.wire.publishing.refusals, signature);
                match kept {
                    Ok(Ok(())) if allowed => {}
                    Ok(Ok(())) => {
                        self.wire.theirs.hide(Slot(slot));
                        self.wire.link.counters.count(LinkCounter::FunctionsForbidden);
                    }
                    Ok(Err(_)) => self.wire.link.counters.count(LinkCounter::FunctionsSkipped),
                    Err(_) => self.wire.close(cx, CloseReason::Protocol),
                }
                None
            }
            Control::Withdraw { slot } => {
                if P::CALLS {
                    self.wire.theirs.remove(Slot(slot));
                }
                None
            }
            Control::ListEnd { serial } => {
                self.wire.listed = true;
                self.wire.publishing.acknowledge(serial);
                self.pump(cx);
                Some(Event::ListChanged)
            }
            Control::ListAck { serial, skipped } => {
                self.wire.publishing.was_acknowledged(serial);
                Some(Event::Acknowledged { serial, skipped })
            }
            Control::Limits { message_size, minimum_interval, calls } => {
                if let Some(remote) = &mut self.wire.remote {
                    remote.hello.limits.message_size = message_size;
                    remote.hello.limits.minimum_interval = minimum_interval;
                    remote.hello.limits.calls = calls;
                }
                None
            }
            Control::Actuator { slot, latch, last } if P::CALLS => {
                Some(Event::Actuator { slot: Slot(slot), state: ActuatorState { latch, last } })
            }
            Control::Subscribe { slot, generation, interval } if STREAMS => {
                self.streaming.subscription_arrived(&mut self.wire, cx, Slot(slot), Generation(generation), interval);
                None
            }
            Control::Subscribed { slot, generation, interval, bytes, refusal } if STREAMS && P::CALLS => {
                let granted =
                    super::GrantedStream { interval: crate::time::Duration::from_millis(interval.into()), bytes };
                StreamsPart::subscription_answered(&mut self.wire, Slot(slot), Generation(generation), granted, refusal)
            }
            Control::Claimed { report } => {
                self.granting.obedience.claim_arrived(&mut self.wire, cx, &report);
                None
            }
            Control::HandOver { name, id } if HAND_OVER => {
                let to = core::str::from_utf8(name).ok().and_then(|name| Manager::new(name, id).ok());
                self.granting.hand_over_arrived(&mut self.wire, cx, to);
                None
            }
            Control::HandedOver { refusal } if HAND_OVER && P::CALLS => {
                self.handing.answered(refusal).then_some(Event::Answered)
            }
            Control::LeaseEnded { call, why } if P::CALLS => self
                .calling
                .stop_renewing(CallId(call))
                .map(|held| Event::LeaseEnded { call: held.call, slot: held.slot, why }),
            Control::Subscribe { .. }
            | Control::Subscribed { .. }
            | Control::Actuator { .. }
            | Control::HandOver { .. }
            | Control::HandedOver { .. }
            | Control::LeaseEnded { .. } => None,
        };
        (left, event)
    }

    fn request_arrived(
        &mut self,
        cx: &mut Context<'_, P>,
        priority: Priority,
        header: &RequestHeader,
        block: Span,
        lent: &[u8],
        arguments: Option<&mut ParametersView>,
    ) -> Option<Event> {
        self.wire.link.counters.count(LinkCounter::RequestsReceived);
        // Detect duplicates before anything else: refusing a copy could overtake the answer of the original.
        let seen = self.calls.note(priority, header.id);
        if seen == Seen::Before {
            self.wire.link.counters.count(LinkCounter::RequestsRepeated);
            return None;
        }
        // Look the function up once; the checks below share the result.
        let function = cx.functions.lookup(header.slot, header.generation);
        let length = self.wire.link.view(block, lent).len();
        let result = self.check_request(cx, priority, header, seen, length, function).and_then(|(head, function)| {
            // A stop's handler waits if a safe hook has to run first: `poll` returns the hook before `next_call` returns the
            // handler. A moving call waits until its claim is stored.
            let waits = function.attributes.stop && Granting::awaits_hook(cx, header.slot, header.generation)
                || function.attributes.lease.is_some()
                    && self.granting.obedience.may_move(&mut self.wire, cx).is_none()
                    && self.granting.obedience.waits;
            let arguments = arguments.filter(|_| !waits && self.calls.is_idle(priority));
            let bytes = self.wire.link.view(block, lent);
            match arguments {
                // Decode the arguments before the call begins: no lease may start for a request that is refused.
                Some(arguments) => {
                    read_arguments(function.signature, bytes, arguments)?;
                    self.begin(cx, head, function.attributes).map(Some)
                }
                None => {
                    // If the request lies in a pool buffer, that buffer is free again as soon as the request is queued.
                    let left = LEFT_BY_WAITING.saturating_sub(usize::from(block.is_in_buffer()));
                    let waits = self.calls.wait(cx.buffers, left, head, bytes);
                    if waits.is_ok() || !self.displace(cx, &head, length) {
                        return waits.map(|()| None);
                    }
                    self.calls.wait(cx.buffers, left, head, self.wire.link.view(block, lent)).map(|()| None)
                }
            }
        });
        match result {
            Ok(Some(call)) => Some(Event::Incoming(call)),
            Ok(None) => None,
            Err(error) => {
                self.refuse_request(cx, header.id, header.slot, priority, header.wants_reply, error);
                None
            }
        }
    }

    /// Checks a request without decoding its arguments.
    fn check_request<'f>(
        &mut self,
        cx: &mut Context<'_, P>,
        priority: Priority,
        header: &RequestHeader,
        seen: Seen,
        length: usize,
        function: Result<Function<'f, dyn Service>, Error>,
    ) -> Result<(CallHead, Function<'f, dyn Service>), Error> {
        // A stop takes effect first, even if it is late, has to wait, or its handler is refused below.
        let stops = function.as_ref().ok().filter(|function| function.attributes.stop);
        if let Some(function) =
            stops.filter(|_| self.wire.publishing.advertised(header.slot, header.generation) == Advertised::Now)
            && permit_call(&mut self.wire, cx, function, priority, false).is_ok()
        {
            self.granting.stop_orders(&mut self.wire, cx, header);
        }
        if seen == Seen::TooOld {
            return Err(Error::Stale);
        }
        if header.unknown != 0 {
            return Err(Error::Unsupported);
        }
        // The limit may have been lowered while the request was in flight.
        let limit = match priority {
            Priority::Emergency => self.wire.constraints.message_size.min(EMERGENCY_BLOCK_BYTES),
            _ => self.wire.constraints.message_size,
        };
        if length > limit as usize {
            return Err(Error::TooLarge { limit });
        }
        let sent_at = sent_at_earliest(cx.now, header.stamp, header.since).ok_or(Error::Malformed)?;
        // Count from the earliest time at which it can have been sent, so that a delayed command is never taken for a new one.
        // A stop is never too late.
        let deadline = if stops.is_some() { cx.now } else { sent_at } + header.remaining;
        if deadline <= cx.now && stops.is_none() {
            return Err(Error::Expired);
        }
        // Judge by what this peer was shown: a function that is published to another node only is unknown here.
        let function = match self.wire.publishing.advertised(header.slot, header.generation) {
            Advertised::Never => return Err(Error::UnknownFunction),
            Advertised::Earlier => return Err(Error::StaleFunction),
            Advertised::Now => function?,
        };
        if function.attributes.is_stream() {
            return Err(Error::UnknownFunction);
        }
        if cx.table().is_some() {
            permit_call(&mut self.wire, cx, &function, priority, header.takes_over)?;
        }
        if priority != Priority::Emergency && !function.attributes.stop {
            self.calls.interval(cx.now, self.wire.constraints.minimum_interval)?;
        }
        let head = CallHead {
            id: header.id,
            slot: header.slot,
            generation: header.generation,
            priority,
            wants_reply: header.wants_reply,
            wants_progress: header.wants_progress,
            takes_over: header.takes_over,
            operator: header.operator,
            keeps_order: function.attributes.lease.is_some() || function.attributes.stop || function.attributes.reset,
            deadline,
            sent_at,
            number: header.number,
        };
        // Before a waiting call is displaced in favour of this one.
        self.admit(cx, &head)?;
        let is_emergency = is_emergency(function.attributes, priority);
        let admitted = self.calls.admit(header.slot, is_emergency, self.wire.constraints.calls_per_peer);
        if admitted.is_err() && !self.displace(cx, &head, length) {
            return admitted.map(|()| (head, function));
        }
        Ok((head, function))
    }
}

const fn counter_of(error: Unopened) -> LinkCounter {
    match error {
        Unopened::Repeated => LinkCounter::DatagramsRepeated,
        Unopened::Forged => LinkCounter::DatagramsForged,
    }
}
