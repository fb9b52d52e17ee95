//! The way down: a request becomes a message, checked against what the peer published and the limits that it told.

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

/// How a request travels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Delivery {
    /// In the stream: it arrives, in order, or the caller learns that it may not have.
    #[default]
    Reliable,
    /// In one datagram, at most [`DATAGRAM_BYTES`]: now or never. Only for requests that want no reply. As long as the peer has not
    /// told that datagrams come, as right behind a join or where a firewall drops them, it goes in the stream.
    BestEffort,
}

/// How a request is made; the default suits most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RequestOptions {
    /// The caller waits no longer, and the callee begins no later, than this; the constraint's value if none.
    pub timeout: Option<Duration>,
    /// The class; the function's own if none.
    pub priority: Option<Priority>,
    /// Stream or datagram.
    pub delivery: Delivery,
    /// How long what the call starts is wanted, if its function has a lease.
    pub renew: Renew,
    /// Take over what another caller moves, in place of [`Error::Held`].
    pub take_over: bool,
    /// An operator makes it, and not the unit's program: each of them holds for itself what it moves.
    pub operator: bool,
    /// Its place among the calls of its link, where it was [made](super::Session::make) before it is sent; now if none.
    pub made: Option<Made>,
    /// Tell what the call tells while it runs, if its function declares that.
    pub progress: bool,
    /// Once it is given up its answer is still waited for, so long at most; zero for not at all. Only on Linux.
    pub answer_within: Duration,
}

impl RequestOptions {
    /// The default, for constants.
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
        }
    }

    /// The default, for a call of a leased function whose motion is wanted so long.
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
    /// It has a place where other calls find none.
    is_urgent: bool,
}

impl<P: Port> Calling<P> {
    /// Sends a request, or nothing of it.
    pub(super) fn request(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
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
        // Nothing of the message has left, since a message that does not fit is refused before its first byte.
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
            // Known before anything runs at the peer: a call whose results could not be kept must not move a vehicle.
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
        // Beside the stream, which may be blocked; both copies have one id, and the callee runs it once.
        let has_left = *priority == Priority::Emergency && Self::send_emergency_datagram(wire, cx, header, parameters);
        // A caller that waits is not kept waiting for others, and an emergency for no one.
        let hold = !header.wants_reply && *priority != Priority::Emergency && wire.may_gather(cx.now);
        let Wire { link, theirs, .. } = wire;
        let signature = theirs.function(header.slot).ok_or(Error::StaleFunction)?.signature;
        // The piece of code that also sends answers.
        let write: &mut dyn FnMut(&mut ChunkWriter<'_>) = &mut |writer| {
            writer.put(&header.encode());
            block::write(signature.arguments(), parameters, writer);
        };
        let sent = link.send_message(cx.mailman, cx.buffers, *priority, total, hold, write);
        match wire.after_sending(cx, hold, sent) {
            // What is before it in the stream are emergencies as well.
            Err(Error::Full(_)) if has_left => Ok(()),
            sent => sent,
        }
    }

    /// The second copy of an emergency; at-most-once removes the double. Whether it has left, to a peer that has told that datagrams come.
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

/// Writes header and block; returns their length.
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
