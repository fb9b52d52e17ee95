//! The send path: a request is checked against what the peer published and its limits, then becomes a message.

use super::due::Part;
use super::holding::Calling;
use super::wire::{Phase, Wire};
use crate::ability::DETAILS;
use crate::config::{DATAGRAM_BYTES, EMERGENCY_BYTES, Priority};
use crate::distribution::block::{self, Put, SliceWriter};
use crate::distribution::function::Signature;
use crate::distribution::message::{REQUEST_BYTES, RequestHeader, SessionBody};
use crate::distribution::parameters::ParametersView;
use crate::error::{CloseReason, Error};
use crate::host::frame::ChunkWriter;
use crate::services::call::Callee;
use crate::services::heart::Renew;
use crate::services::requests::{CallId, Made};
use crate::services::{Context, Port};
use crate::time::Duration;

/// How a request is sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Delivery {
    /// In the stream: it arrives in order, or the caller gets an error that it may not have arrived.
    #[default]
    Reliable,
    /// In one datagram of at most [`DATAGRAM_BYTES`], not retransmitted; only for requests without a reply. Sent in the stream as
    /// long as it is unknown whether datagrams reach the peer: right after joining, or behind a firewall.
    BestEffort,
}

/// Options of a request; the default suits most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RequestOptions {
    /// How long the caller waits, and until when the callee may begin; the constraint `request_timeout` if `None`.
    pub timeout: Option<Duration>,
    /// The priority class; the function's own if `None`.
    pub priority: Option<Priority>,
    /// Stream or datagram.
    pub delivery: Delivery,
    /// How long the call keeps renewing its lease, if its function has one.
    pub renew: Renew,
    /// Take over an actuator that another caller holds, instead of failing with [`Error::Held`].
    pub take_over: bool,
    /// Made by an operator and not by the unit's program: the two hold actuators separately.
    pub operator: bool,
    /// The call's place among those of its link, if it was [made](super::Session::make) before it is sent; now if `None`.
    pub made: Option<Made>,
    /// Request progress reports, if the function declares them.
    pub progress: bool,
    /// How long a call that is given up still waits for its answer; zero for not at all. Only on Linux.
    pub answer_within: Duration,
    /// Only while this unit leads, [`Error::NoAuthority`] otherwise. A port without leaders leaves it set, and is refused.
    pub only_while_leading: bool,
}

impl RequestOptions {
    /// The default options, as a constant.
    pub const fn new() -> Self {
        Self {
            timeout: None,
            priority: None,
            delivery: Delivery::Reliable,
            renew: Renew::Never,
            take_over: false,
            operator: false,
            made: None,
            progress: false,
            answer_within: Duration::ZERO,
            only_while_leading: false,
        }
    }

    /// The default options with this renewal, for a function with a lease.
    pub const fn renewing(renew: Renew) -> Self {
        Self { renew, ..Self::new() }
    }
}

impl Default for RequestOptions {
    fn default() -> Self {
        Self::new()
    }
}

/// A request that passed every check.
struct Checked {
    header: RequestHeader,
    priority: Priority,
    length: usize,
    lease: Option<Duration>,
    /// It may use the slots reserved for emergencies.
    is_urgent: bool,
}

impl<P: Port> Calling<P> {
    /// Sends a request; on an error nothing is sent.
    pub(super) fn request(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        if options.only_while_leading {
            // A port that knows who leads has looked, and taken it away.
            return Err(Error::NoAuthority);
        }
        // All checks before the id is taken: a request that is refused leaves no trace, and no gap that at-most-once would count.
        let mut checked = self.check(wire, cx, callee, parameters, options, wants_reply)?;
        let slot = checked.header.slot;
        let held = checked.lease.filter(|_| options.renew != Renew::Never);
        if let Some(lease) = held {
            self.check_held(lease, options, slot)?;
        }
        let Checked { header: RequestHeader { generation, remaining, .. }, priority, is_urgent, .. } = checked;
        let id = if wants_reply {
            let leased = checked.lease.is_some();
            let id = self.requests.open(slot, generation, cx.now + remaining, priority, leased, is_urgent)?;
            wire.due.hasten(Part::Calls, cx.now + remaining);
            id
        } else {
            self.requests.next_id()
        };
        let Some(id) = id else {
            wire.close(cx, CloseReason::Exhausted);
            return Err(Error::Closed(CloseReason::Exhausted));
        };
        checked.header.id = id.0;
        checked.header.number = self.requests.made(options.made).number();
        let sent = match options.delivery {
            Delivery::BestEffort if wire.liveness.is_heard() => Self::send_best_effort(wire, cx, &checked, parameters),
            _ => Self::send_reliable(wire, cx, &checked, parameters),
        };
        // No byte has been sent: a message that does not fit is refused as a whole.
        if let Err(error) = sent {
            self.requests.close(id);
            return Err(error);
        }
        self.requests.sent(cx.now);
        if checked.lease.is_some() {
            self.last_order = Some((slot, id));
        }
        if let Some(lease) = held {
            self.hold_lease(wire, cx, &checked.header, priority, lease, options.renew);
        }
        Ok(id)
    }

    fn check(
        &self,
        wire: &Wire<P>,
        cx: &Context<'_, P>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<Checked, Error> {
        if wire.phase != Phase::Live {
            return Err(Error::NotConnected);
        }
        let function = wire.theirs.named(callee.name()).ok_or(Error::UnknownFunction)?;
        callee.check(function.signature).map_err(|found| Error::Mismatch(found.part))?;
        if function.attributes.is_stream() {
            return Err(Error::UnknownFunction);
        }
        let priority = options.priority.unwrap_or(function.attributes.priority);
        let is_urgent = function.attributes.is_urgent(priority);
        let length = block::measure(function.signature.arguments(), parameters)?;
        Self::check_length(wire, priority, options.delivery, length)?;
        if wants_reply {
            // Check this before sending: a call whose results do not fit here must not move a vehicle.
            block::check_results_fit(function.signature.results(), parameters)?;
            if options.delivery == Delivery::BestEffort {
                return Err(Error::BadConstraint);
            }
        }
        if priority != Priority::Emergency && !is_urgent {
            self.requests.gate(cx.now, wire.interval())?;
        }
        let (stamp, since) = wire.clock.stamp(cx.now);
        let remaining = options.timeout.unwrap_or(wire.constraints.request_timeout);
        let wants_progress =
            DETAILS && wants_reply && options.progress && function.signature.progress().next().is_some();
        let header = RequestHeader {
            id: 0,
            slot: function.slot,
            generation: function.generation,
            wants_reply,
            wants_progress,
            takes_over: options.take_over,
            operator: options.operator,
            unknown: 0,
            remaining,
            stamp,
            since,
            number: 0,
        };
        Ok(Checked { header, priority, length, lease: function.attributes.lease, is_urgent })
    }

    fn check_length(wire: &Wire<P>, priority: Priority, delivery: Delivery, length: usize) -> Result<(), Error> {
        let peer = wire.peer_message_size();
        if length > peer as usize {
            return Err(Error::TooLarge { limit: peer });
        }
        let fixed = match (priority, delivery) {
            (Priority::Emergency, _) => EMERGENCY_BYTES,
            (_, Delivery::BestEffort) => DATAGRAM_BYTES,
            _ => return Ok(()),
        };
        let limit = fixed.saturating_sub(REQUEST_BYTES);
        if length > limit { Err(Error::TooLarge { limit: limit as u32 }) } else { Ok(()) }
    }

    fn send_reliable(
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        checked: &Checked,
        parameters: &ParametersView,
    ) -> Result<(), Error> {
        let Checked { header, priority, length, .. } = checked;
        let total = REQUEST_BYTES.saturating_add(*length);
        // A second copy by datagram, since the stream may be blocked. Both have one id, so the callee runs the call once.
        let has_left = *priority == Priority::Emergency && Self::send_emergency_datagram(wire, cx, header, parameters);
        // Gather one-way messages only: a caller is waiting for a reply, and an emergency waits for nothing.
        let hold = !header.wants_reply && *priority != Priority::Emergency && wire.may_gather(cx.now);
        let Wire { link, theirs, .. } = wire;
        let signature = theirs.function(header.slot).ok_or(Error::StaleFunction)?.signature;
        // The same instantiation that sends answers, to save code.
        let write: &mut dyn FnMut(&mut ChunkWriter<'_>) = &mut |writer| {
            writer.put(&header.encode());
            block::write(signature.arguments(), parameters, writer);
        };
        let sent = link.send_message(cx.mailman, cx.buffers, *priority, total, hold, write);
        match wire.after_sending(cx, hold, sent) {
            // The stream's queue is full of other emergencies, but the datagram has been sent.
            Err(Error::Full(_)) if has_left => Ok(()),
            sent => sent,
        }
    }

    /// Sends the second copy of an emergency, which the callee drops as a duplicate of the first. Returns whether it was sent
    /// to a peer that receives datagrams.
    fn send_emergency_datagram(
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        header: &RequestHeader,
        parameters: &ParametersView,
    ) -> bool {
        let mut message = [0; EMERGENCY_BYTES];
        let Some(signature) = wire.theirs.function(header.slot).map(|function| function.signature) else {
            return false;
        };
        let length = write_message(&mut message, header, signature, parameters);
        let prefix = SessionBody::message_prefix(Priority::Emergency.to_wire());
        let sent = wire.send_datagram(cx, &prefix, message.get(..length).unwrap_or(&[]));
        sent && wire.liveness.is_heard()
    }

    fn send_best_effort(
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        checked: &Checked,
        parameters: &ParametersView,
    ) -> Result<(), Error> {
        let mut message = [0; DATAGRAM_BYTES];
        let signature = wire.theirs.function(checked.header.slot).ok_or(Error::StaleFunction)?.signature;
        let length = write_message(&mut message, &checked.header, signature, parameters);
        let prefix = SessionBody::message_prefix(checked.priority.to_wire());
        let sent = wire.send_datagram(cx, &prefix, message.get(..length).unwrap_or(&[]));
        if sent { Ok(()) } else { Err(Error::Network) }
    }
}

/// Encodes header and block; returns their length.
fn write_message(
    out: &mut [u8],
    header: &RequestHeader,
    signature: Signature<'_>,
    parameters: &ParametersView,
) -> usize {
    let mut writer = SliceWriter::new(out);
    writer.put(&header.encode());
    block::write(signature.arguments(), parameters, &mut writer);
    writer.written()
}
