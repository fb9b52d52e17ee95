//! Details of a call beside its results: the reason of its failure, its progress, and notice that its caller has given it up.
//!
//! Details never delay anything else. A failure that does not fit loses its values first, then its text, never its code. Progress
//! is sent only when the send queue is empty. A cancellation is sent once, and acknowledged only by the call's answer.

use super::wire::{Phase, Wire};
use super::{Event, Results, due};
use crate::ability::{Ability, Begins, DETAILS, Details, State};
use crate::config::{PROGRESS_INTERVAL, Priority};
use crate::distribution::block;
use crate::distribution::failure::Failure;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::message::{
    FailureDetails, PROGRESS_BYTES, REPLY_BYTES, Release, encode_failure, encode_progress, encode_reply,
};
use crate::distribution::parameters::ParametersView;
use crate::error::{Error, Limit, ServiceError};
use crate::host::connections::{LinkCounter, Span};
use crate::services::calls::{Calls, Cancelled, RunningCall, Ticket};
use crate::services::requests::{CallId, Pending, Requests};
use crate::services::{Context, Port};
use crate::time::Instant;

/// The details of one link.
#[derive(Clone, Copy)]
pub(super) struct OfCalls {
    /// Running calls were given up, of which the port has not been notified.
    cancelled: bool,
    /// Details of the failure that was received last.
    failure: Option<Recorded>,
    /// Earliest time for the next progress message.
    progress_due: Instant,
    /// The port keeps progress that was not sent.
    progress_waits: bool,
}

/// Where the details of a failure are.
#[derive(Clone, Copy)]
struct Recorded {
    message: Span,
    step: u32,
    code: u16,
    /// The function, if the call waited for its reply.
    function: Option<(Slot, Generation)>,
}

impl Begins for OfCalls {
    const BEGIN: &'static Self =
        &Self { cancelled: false, failure: None, progress_due: Instant::START, progress_waits: false };
}

impl OfCalls {
    pub(super) fn deadline(&self) -> Instant {
        match (self.cancelled, self.progress_waits) {
            (true, _) => Instant::START,
            (false, true) => self.progress_due,
            (false, false) => Instant::FAR_FUTURE,
        }
    }
}

/// The details of a link; without state in builds that leave them out.
pub(super) type DetailsPart = State<OfCalls, { DETAILS as usize }>;

impl DetailsPart {
    /// Changes the state and updates its deadline.
    fn put<P: Port>(&mut self, wire: &mut Wire<P>, change: impl FnOnce(&mut OfCalls)) {
        self.change(change);
        if DETAILS {
            wire.due.set(due::Part::Details, self.deadline());
        }
    }

    /// Takes text and values of the failure that was received last.
    pub(super) fn failure<P: Port>(&mut self, wire: &mut Wire<P>, lent: &[u8]) -> Option<Failure> {
        let Recorded { message, code, function, .. } =
            self.get_mut()?.failure.take().filter(|recorded| recorded.step == wire.step)?;
        let FailureDetails { text, values } = FailureDetails::of(wire.link.view(message, lent))?;
        let mut failure = Failure::new(code, text);
        let mut is_whole = !failure.is_cut();
        let function = function.and_then(|(slot, generation)| {
            wire.theirs.function(slot).filter(|function| function.generation == generation)
        });
        if let Some(function) = function.filter(|_| !values.is_empty()) {
            is_whole &= block::read(function.signature.failure(), values, failure.values_mut()).is_ok();
        }
        if !is_whole {
            wire.link.counters.count(LinkCounter::DetailsDropped);
        }
        Some(failure)
    }

    /// Records a failure's details before the message is processed, since that closes the call.
    pub(super) fn note_failure<P: Port>(
        &mut self,
        wire: &Wire<P>,
        requests: &Requests<P::Storage>,
        message: Span,
        lent: &[u8],
    ) {
        self.change(|details| details.failure = None);
        let bytes = wire.link.view(message, lent);
        if FailureDetails::of(bytes).is_none() {
            return;
        }
        let Some(&[_, _, _, _, a, b, c, d, low, high]) = bytes.first_chunk() else { return };
        let pending = requests.waiting_for(CallId(u32::from_le_bytes([a, b, c, d])));
        let function = pending.map(|pending| (pending.slot, pending.generation));
        let code = u16::from_le_bytes([low, high]);
        self.change(|details| details.failure = Some(Recorded { message, step: wire.step, code, function }));
    }

    /// Answers with an error. Leaves out what exceeds a limit, values first; if the stream is full, all but the code.
    pub(super) fn send_failure<P: Port>(
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        head: &RunningCall,
        error: Error,
        failure: Option<&Failure>,
    ) -> Result<(), Error> {
        let functions = cx.functions;
        let plain =
            |wire: &mut Wire<P>, cx: &mut _| wire.send_error(cx, head.id, head.priority, head.wants_reply, error);
        let failure = failure.filter(|failure| error == Error::Service(failure.error()));
        let Some(failure) = failure else { return plain(wire, cx) };
        let function = functions.lookup(head.slot, head.generation).ok();
        let specs = function.map(|function| function.signature.failure());
        let values = failure.values();
        let measured = specs.and_then(|specs| block::measure(specs, values).ok());
        let mut is_whole = !failure.is_cut() && (values.is_empty() || measured.is_some_and(|length| length > 0));
        let text_bytes = FailureDetails::text_bytes(failure.text());
        let header = match head.wants_reply {
            true => encode_reply(head.id, Err(error)),
            false => encode_failure(head.id, error),
        };
        let mut sent = Err(Error::TooLarge { limit: 0 });
        for length in [measured.unwrap_or(0), 0] {
            let details = text_bytes.saturating_add(length);
            if details > wire.peer_message_size() as usize {
                is_whole = false;
                continue;
            }
            sent = wire.send(cx, head.priority, REPLY_BYTES.saturating_add(details), &mut |writer| {
                writer.put(&header);
                FailureDetails::put_text(failure.text(), writer);
                if let Some(specs) = specs.filter(|_| length > 0) {
                    block::write(specs, values, writer);
                }
            });
            if !matches!(sent, Err(Error::TooLarge { .. })) {
                break;
            }
            is_whole = false;
        }
        if let Err(Error::TooLarge { .. } | Error::Full(_)) = sent {
            is_whole = false;
            sent = plain(wire, cx);
        }
        if !is_whole {
            wire.link.counters.count(LinkCounter::DetailsDropped);
        }
        sent
    }

    /// Sends the progress of a running call to its caller.
    pub(super) fn progress<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        calls: &Calls<P::Storage>,
        cx: &mut Context<'_, P>,
        ticket: Ticket,
        values: &ParametersView,
    ) -> Result<(), Error> {
        let Some(head) = calls.call(ticket).filter(|head| head.wants_progress && head.cancelled == Cancelled::No)
        else {
            return Ok(());
        };
        if wire.phase != Phase::Live {
            return Ok(());
        }
        let specs = cx.functions.lookup(head.slot, head.generation)?.signature.progress();
        let length = block::measure(specs, values)?;
        let limit = wire.peer_message_size();
        if length > limit as usize {
            return Err(Error::TooLarge { limit });
        }
        if cx.now >= self.progress_due && wire.link.queued() > 0 {
            // Flush gathered messages first. If anything remains queued, wait: progress must not delay other messages.
            wire.flush(cx);
            if wire.link.queued() > 0 {
                self.put(wire, |details| details.progress_due = cx.now + PROGRESS_INTERVAL);
            }
        }
        if cx.now < self.progress_due {
            self.put(wire, |details| details.progress_waits = true);
            return Err(Error::Full(Limit::SendQueue));
        }
        wire.send(cx, Priority::Low, PROGRESS_BYTES.saturating_add(length), &mut |writer| {
            writer.put(&encode_progress(head.id));
            block::write(specs, values, writer);
        })?;
        wire.link.counters.count(LinkCounter::ProgressSent);
        self.put(wire, |details| details.progress_due = cx.now + PROGRESS_INTERVAL);
        Ok(())
    }

    pub(super) fn progress_arrived<P: Port>(
        wire: &mut Wire<P>,
        requests: &Requests<P::Storage>,
        id: CallId,
        block: Span,
        lent: &[u8],
    ) -> Option<Event> {
        let pending = requests.waiting_for(id);
        let reported = pending.map(|Pending { slot, generation, .. }| Results {
            slot: *slot,
            generation: *generation,
            block,
            step: wire.step,
        });
        let is_known =
            reported.as_ref().and_then(|reported| wire.progress(reported, lent).ok()).is_some_and(|values| {
                let declares = values.specs.clone().next().is_some();
                declares && block::check(values.specs, values.bytes).is_ok()
            });
        wire.link.counters.count(if is_known { LinkCounter::ProgressReceived } else { LinkCounter::ProgressDropped });
        reported.filter(|_| is_known).and_then(Details::of).map(|reported| Event::Progress(id, reported))
    }

    /// The peer has given a call up: its motion ends as if released. Notifies a running handler; a waiting call will not begin.
    pub(super) fn cancelled<P: Port>(&mut self, wire: &mut Wire<P>, calls: &mut Calls<P::Storage>, cancel: Release) {
        let Release { call, class } = cancel;
        match calls.cancel(class, call) {
            Ok(false) => {}
            Ok(true) => {
                wire.link.counters.count(LinkCounter::RunningCancelled);
                self.put(wire, |details| details.cancelled = true);
            }
            Err(_) if calls.has_arrived(class, call) && !calls.is_waiting(class, call) => {
                wire.link.counters.count(LinkCounter::CancelsIgnored);
            }
            Err(_) => {}
        }
    }

    /// Returns a notification for the port; called by `Session::poll`.
    pub(super) fn poll<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        calls: &mut Calls<P::Storage>,
        now: Instant,
    ) -> Option<Event> {
        self.put(wire, |details| details.progress_waits &= now < details.progress_due);
        if !self.cancelled {
            return None;
        }
        let ticket = calls.take_cancelled();
        self.put(wire, |details| details.cancelled = ticket.is_some());
        ticket.and_then(Details::of).map(Event::Cancelled)
    }
}

impl From<&Failure> for Error {
    fn from(failure: &Failure) -> Self {
        Self::Service(ServiceError::Failed(failure.code()))
    }
}
