//! What is told of a call beside its results: why it failed, what it tells while it runs, and that its caller has given it up.
//!
//! Nothing of it is in the way of anything else. A failure loses its values and then its text where they do not fit, and never its
//! code; progress is sent when nothing waits to be sent, or not at all; a cancellation is heard once and answered by nothing.

use super::{Event, Phase, ReplyBlock, Results, Session};
use crate::ability::{Ability, Begins, DETAILS, Details};
use crate::config::{PROGRESS_INTERVAL, Priority};
use crate::distribution::block;
use crate::distribution::failure::Failure;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::message::{
    FailureDetails, PROGRESS_BYTES, REPLY_BYTES, Release, SessionBody, encode_failure, encode_progress, encode_reply,
};
use crate::distribution::parameters::ParametersView;
use crate::error::{Error, Limit, ServiceError};
use crate::host::connections::{LinkCounter, Span};
use crate::host::frame::Frame;
use crate::services::calls::{Cancelled, RunningCall, Ticket};
use crate::services::requests::{CallId, Pending};
use crate::services::{Context, Port};
use crate::time::Instant;

/// The details of one link.
#[derive(Clone, Copy)]
pub(super) struct OfCalls {
    /// Calls that run were given up, and the port has yet to be told.
    cancelled: bool,
    /// Those of the failure that came last.
    failure: Option<Recorded>,
    /// When progress may be sent again.
    progress_due: Instant,
    /// The port has progress that was not due.
    progress_waits: bool,
}

/// Where the details of a failure lie.
#[derive(Clone, Copy)]
struct Recorded {
    message: Span,
    step: u32,
    code: u16,
    /// The function, where the call waited for its reply.
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

impl<P: Port> Session<P> {
    // --- failures

    /// As [`answer`](Self::answer) with [`ServiceError::Failed`], and tells the caller text and values as well: as much of it
    /// as fits and as the signature declares.
    pub fn answer_failed(&mut self, cx: &mut Context<'_, P>, ticket: Ticket, failure: &Failure) -> Result<(), Error> {
        self.answer_with(cx, ticket, Err(failure.error().into()), Some(failure))
    }

    /// Text and values of the failure that an [`Event::Reply`] or [`Event::Failed`] has just told; `None` where it has none.
    /// Values come with replies alone. `lent` is what was lent to the [`receive`](Self::receive) that returned the event.
    pub fn failure(&mut self, lent: &[u8]) -> Option<Failure> {
        let Recorded { message, code, function, .. } =
            self.details.get_mut()?.failure.take().filter(|recorded| recorded.step == self.step)?;
        let FailureDetails { text, values } = FailureDetails::of(self.link.view(message, lent))?;
        let mut failure = Failure::new(code, text);
        let mut is_whole = !failure.is_cut();
        let function = function.and_then(|(slot, generation)| {
            self.theirs.function(slot).filter(|function| function.generation == generation)
        });
        if let Some(function) = function.filter(|_| !values.is_empty()) {
            is_whole &= block::read(function.signature.failure(), values, failure.values_mut()).is_ok();
        }
        if !is_whole {
            self.link.counters.count(LinkCounter::DetailsDropped);
        }
        Some(failure)
    }

    /// Before the message is dealt with, since the call is forgotten then.
    pub(super) fn note_failure(&mut self, message: Span, lent: &[u8]) {
        self.details.change(|details| details.failure = None);
        let bytes = self.link.view(message, lent);
        if FailureDetails::of(bytes).is_none() {
            return;
        }
        let Some(&[_, _, _, _, a, b, c, d, low, high]) = bytes.first_chunk() else { return };
        let pending = self.requests.waiting_for(CallId(u32::from_le_bytes([a, b, c, d])));
        let function = pending.map(|pending| (pending.slot, pending.generation));
        let code = u16::from_le_bytes([low, high]);
        self.details.change(|details| details.failure = Some(Recorded { message, step: self.step, code, function }));
    }

    /// Answers with an error. What exceeds a limit is left out, the values first; so is all but the code where there is no
    /// room in the stream.
    pub(super) fn send_failure(
        &mut self,
        cx: &mut Context<'_, P>,
        head: &RunningCall,
        error: Error,
        failure: Option<&Failure>,
    ) -> Result<(), Error> {
        let functions = cx.functions;
        let plain = |this: &mut Self, cx: &mut _| this.send_error(cx, head.id, head.priority, head.wants_reply, error);
        let failure = failure.filter(|failure| error == Error::Service(failure.error()));
        let Some(failure) = failure else { return plain(self, cx) };
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
            if details > self.peer_message_size() as usize {
                is_whole = false;
                continue;
            }
            sent = self.send(cx, head.priority, REPLY_BYTES.saturating_add(details), &mut |writer| {
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
            sent = plain(self, cx);
        }
        if !is_whole {
            self.link.counters.count(LinkCounter::DetailsDropped);
        }
        sent
    }

    // --- progress

    /// Tells the caller of a running call how far it is. Nothing is sent, and nothing is wrong, where it does not want to know or
    /// the call has ended.
    ///
    /// [`Error::Full`] where the stream has no room now or the last progress was just sent: the port keeps the newest values, and
    /// tries again after the next [`poll`](Self::poll), or with newer ones. Other errors say that the values do not fit the
    /// signature, or the peer.
    pub fn progress(&mut self, cx: &mut Context<'_, P>, ticket: Ticket, values: &ParametersView) -> Result<(), Error> {
        let Some(head) = self.calls.call(ticket).filter(|head| head.wants_progress && head.cancelled == Cancelled::No)
        else {
            return Ok(());
        };
        if self.phase != Phase::Live {
            return Ok(());
        }
        let specs = cx.functions.lookup(head.slot, head.generation)?.signature.progress();
        let length = block::measure(specs, values)?;
        let limit = self.peer_message_size();
        if length > limit as usize {
            return Err(Error::TooLarge { limit });
        }
        if cx.now >= self.details.progress_due && self.link.queued() > 0 {
            // What gathers goes first, and nothing is to wait behind what this sends.
            self.flush(cx);
            if self.link.queued() > 0 {
                self.details.change(|details| details.progress_due = cx.now + PROGRESS_INTERVAL);
            }
        }
        if cx.now < self.details.progress_due {
            self.details.change(|details| details.progress_waits = true);
            return Err(Error::Full(Limit::SendQueue));
        }
        self.send(cx, Priority::Low, PROGRESS_BYTES.saturating_add(length), &mut |writer| {
            writer.put(&encode_progress(head.id));
            block::write(specs, values, writer);
        })?;
        self.link.counters.count(LinkCounter::ProgressSent);
        self.details.change(|details| details.progress_due = cx.now + PROGRESS_INTERVAL);
        Ok(())
    }

    /// What an [`Event::Progress`] tells, as [`results`](Self::results) shows the results of a call.
    pub fn progress_values<'b>(&'b self, values: &Results, lent: &'b [u8]) -> Result<ReplyBlock<'b>, Error> {
        let block = self.results(values, lent)?;
        Ok(ReplyBlock { specs: block.signature.progress(), ..block })
    }

    pub(super) fn progress_arrived(&mut self, id: CallId, block: Span, lent: &[u8]) -> Option<Event> {
        let pending = self.requests.waiting_for(id);
        let reported = pending.map(|Pending { slot, generation, .. }| Results {
            slot: *slot,
            generation: *generation,
            block,
            step: self.step,
        });
        let is_known =
            reported.as_ref().and_then(|reported| self.progress_values(reported, lent).ok()).is_some_and(|values| {
                let declares = values.specs.clone().next().is_some();
                declares && block::check(values.specs, values.bytes).is_ok()
            });
        self.link.counters.count(if is_known { LinkCounter::ProgressReceived } else { LinkCounter::ProgressDropped });
        reported.filter(|_| is_known).and_then(Details::of).map(|reported| Event::Progress(id, reported))
    }

    // --- cancellation

    /// The peer is told that a call has no caller any more. In the stream alone, and at most once: what such a call moves is
    /// released as well, which is not lost.
    pub(super) fn send_cancel(&mut self, cx: &mut Context<'_, P>, pending: &Pending) {
        // A stop is not taken back: its handler runs, however late it comes.
        let stops = self.theirs.function(pending.slot).is_some_and(|function| function.attributes.stop);
        if DETAILS && self.phase == Phase::Live && !stops {
            let body = SessionBody::cancel(&Release { call: pending.id.0, class: pending.class });
            self.link.send_frame(&Frame::Session(&body));
            self.flush(cx);
        }
    }

    /// The peer has given a call up. What it moves ends as if it were released; if it runs, its handler is told; if it has not
    /// begun, it does not.
    pub(super) fn cancel_arrived(&mut self, cx: &mut Context<'_, P>, cancel: Release) -> Option<Event> {
        let Release { call, class } = cancel;
        match self.calls.cancel(class, call) {
            Ok(false) => {}
            Ok(true) => {
                self.link.counters.count(LinkCounter::RunningCancelled);
                self.details.change(|details| details.cancelled = true);
            }
            Err(_) if self.calls.has_arrived(class, call) && !self.calls.is_waiting(class, call) => {
                self.link.counters.count(LinkCounter::CancelsIgnored);
            }
            Err(_) => {}
        }
        self.released(cx, cancel)
    }

    /// What the port is to be told, from [`poll`](Self::poll).
    pub(super) fn poll_details(&mut self, now: Instant) -> Option<Event> {
        self.details.change(|details| details.progress_waits &= now < details.progress_due);
        if !self.details.cancelled {
            return None;
        }
        let ticket = self.calls.take_cancelled();
        self.details.change(|details| details.cancelled = ticket.is_some());
        ticket.and_then(Details::of).map(Event::Cancelled)
    }

    /// Whether the caller of a running call has given it up; also where the call has ended.
    pub fn is_cancelled(&self, ticket: Ticket) -> bool {
        self.calls.call(ticket).is_none_or(|head| head.cancelled != Cancelled::No)
    }
}

impl From<&Failure> for Error {
    fn from(failure: &Failure) -> Self {
        Self::Service(ServiceError::Failed(failure.code()))
    }
}
