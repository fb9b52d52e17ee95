//! Calls of the peer: which begins next, and how it is answered or refused.

use super::details::DetailsPart;
use super::granting::Granting;
use super::permitting::{decide_call, log_refusal};
use super::{Incoming, Phase, Session};
use crate::ability::{ADMISSION, DETAILS, SCHEDULING};
use crate::config::{Priority, Scheduling};
use crate::distribution::block;
use crate::distribution::failure::Failure;
use crate::distribution::function::{Attributes, Signature};
use crate::distribution::function_list::Slot;
use crate::distribution::message::{REPLY_BYTES, encode_reply};
use crate::distribution::parameters::ParametersView;
use crate::error::{Error, Limit, ServiceError};
use crate::host::connections::LinkCounter;
use crate::services::calls::{CallHead, Cancelled, RunningCall, Ticket};
use crate::services::{Context, Port};

impl<P: Port> Session<P> {
    /// Whether the peer holds a lease on any function of this unit.
    pub fn moves(&self) -> bool {
        !self.granting.granted.is_empty()
    }

    /// Whether the peer's order of a lease is one of this function, and not of another one that shares the lease.
    pub fn moves_by(&self, slot: Slot) -> bool {
        self.granting.granted.iter().any(|granted| granted.slot == slot)
    }

    /// Begins the next waiting call, with its arguments in `arguments`. Call [`poll`](Self::poll) first, since a safe hook that
    /// is due precedes any handler. Then call this after [`receive`](Self::receive) and after each [`answer`](Self::answer) until
    /// it returns `None`.
    pub fn next_call(&mut self, cx: &mut Context<'_, P>, arguments: &mut ParametersView) -> Option<Incoming> {
        while self.wire.phase == Phase::Live && !self.granting.obedience.waits {
            if let Ok(call) = self.begin_next(cx, arguments)? {
                return Some(call);
            }
        }
        None
    }

    /// As [`next_call`](Self::next_call), for emergencies only: for ports that run these apart from other calls.
    pub fn next_emergency(&mut self, cx: &mut Context<'_, P>, arguments: &mut ParametersView) -> Option<Incoming> {
        while self.has_next_emergency() {
            if let Ok(call) = self.begin_next(cx, arguments)? {
                return Some(call);
            }
        }
        None
    }

    /// Begins or refuses the next call that may begin; `None` if there is none.
    fn begin_next(
        &mut self,
        cx: &mut Context<'_, P>,
        arguments: &mut ParametersView,
    ) -> Option<Result<Incoming, Error>> {
        let (functions, now, access, remote) = (cx.functions, cx.now, cx.table(), self.wire.remote.as_ref());
        if self.goes_by_deadline() && self.calls.put_next_first(now) {
            self.wire.link.counters.count(LinkCounter::RequestsAhead);
        }
        let (head, read) = self.calls.take_next(cx.buffers, |head, block| {
            if head.deadline <= now {
                return Err(Error::Expired);
            }
            let function = functions.lookup(head.slot, head.generation)?;
            // The access table may have changed while the call waited.
            if !decide_call(access, remote, function.name(), head.takes_over).is_allowed() {
                return Err(Error::NotAllowed);
            }
            read_arguments(function.signature, block, arguments).map(|()| function.attributes)
        })?;
        let started = read.and_then(|attributes| self.begin(cx, head, attributes));
        if let Err(error) = started {
            self.refuse_request(cx, head.id, head.slot, head.priority, head.wants_reply, error);
        }
        Some(started)
    }

    /// Whether [`next_call`](Self::next_call) has a call to begin or refuse.
    pub fn has_next_call(&self) -> bool {
        self.wire.phase == Phase::Live && !self.granting.obedience.waits && self.calls.can_begin()
    }

    /// Whether a moving call waits until its claim is stored. A port that does not poll before each `next_call` checks for calls
    /// again when this changes.
    pub const fn awaits_claim(&self) -> bool {
        self.granting.obedience.waits
    }

    /// Whether [`next_emergency`](Self::next_emergency) has a call to begin or refuse.
    pub fn has_next_emergency(&self) -> bool {
        self.wire.phase == Phase::Live && self.calls.has_next_emergency()
    }

    /// Whether a request that cannot begin at once could be queued. While not, a port can leave received bytes unread, so that
    /// flow control slows the peer down, instead of having its requests refused.
    pub fn has_call_room(&self) -> bool {
        self.calls.has_room(self.wire.constraints.calls_per_peer, self.wire.constraints.message_size as usize)
    }

    /// Begins a call of a function with these attributes.
    pub(super) fn begin(
        &mut self,
        cx: &mut Context<'_, P>,
        head: CallHead,
        attributes: &Attributes,
    ) -> Result<Incoming, Error> {
        let lease = attributes.lease;
        // The caller released the function while this call waited.
        if lease.is_some() && self.wire.publishing.is_released(head.slot, head.id) {
            return Err(Error::Expired);
        }
        self.admit(cx, &head)?;
        // Take a slot first, then the lease: a lease without a slot would last until it expires, since no call would end it.
        let ticket = self.calls.begin(&head, attributes.reset, is_emergency(attributes, head.priority))?;
        let order = match lease.map_or(Ok(None), |length| self.granting.grant(&mut self.wire, cx, &head, length)) {
            Ok(order) => order,
            Err(error) => {
                self.calls.end(ticket);
                return Err(error);
            }
        };
        if self.is_measured(head.priority, head.keeps_order) {
            let (now, running) = (cx.now, (self.wire.link.id(), ticket));
            cx.hub.enter(&mut |hub| hub.publications.run_times.began(now, &head, running));
        }
        self.wire.link.counters.count(LinkCounter::RequestsRun);
        let CallHead { slot, priority, wants_reply, deadline, .. } = head;
        Ok(Incoming { ticket, slot, priority, wants_reply, deadline, order })
    }

    /// Answers a call. [`Error::Full`] if the answer cannot be queued now: the call stays open, and the port tries again when the
    /// stream has taken bytes. Has no effect on a call that was answered, or whose link has ended.
    pub fn answer(
        &mut self,
        cx: &mut Context<'_, P>,
        ticket: Ticket,
        result: Result<&ParametersView, Error>,
    ) -> Result<(), Error> {
        self.answer_with(cx, ticket, result, None)
    }

    /// Not generic, so that answers with and without details share the code.
    pub(super) fn answer_with(
        &mut self,
        cx: &mut Context<'_, P>,
        ticket: Ticket,
        result: Result<&ParametersView, Error>,
        failure: Option<&Failure>,
    ) -> Result<(), Error> {
        let Some(head) = self.calls.call(ticket) else { return Ok(()) };
        // Measure before sending: waiting for capacity in the stream is not part of the function's run time.
        if self.is_measured(head.priority, false) {
            let (now, function, running) = (cx.now, (head.slot, head.generation), (self.wire.link.id(), ticket));
            cx.hub.enter(&mut |hub| hub.publications.run_times.ended(now, function, running));
        }
        // Reset before the answer is sent, so that the answer is true when it arrives.
        let result = if head.resets {
            result.and_then(|results| Granting::reset_orders(&mut self.wire, cx, &head).map(|()| results))
        } else {
            result
        };
        // A failed call wants no motion: stop what it started now, even if the answer cannot be queued yet.
        if result.is_err() {
            self.granting.cut_call(&mut self.wire, cx, head.id);
        }
        if self.wire.phase == Phase::Live {
            let sent = match result {
                Ok(results) if head.wants_reply => self.send_results(cx, &head, results),
                Ok(_) => Ok(()),
                Err(error) => DetailsPart::send_failure(&mut self.wire, cx, &head, error, failure.filter(|_| DETAILS)),
            };
            // Return before the call is closed: the port tries again, and the lease continues meanwhile.
            if let Err(error @ Error::Full(_)) = sent {
                return Err(error);
            }
        }
        self.calls.end(ticket);
        if head.resets {
            self.pump(cx);
        }
        Ok(())
    }

    /// As [`answer`](Self::answer) with [`ServiceError::Failed`], plus text and values as far as they fit and are declared.
    pub fn answer_failed(&mut self, cx: &mut Context<'_, P>, ticket: Ticket, failure: &Failure) -> Result<(), Error> {
        self.answer_with(cx, ticket, Err(failure.error().into()), Some(failure))
    }

    /// Sends progress of a running call to its caller. Does nothing if the caller has not asked for progress, or the call has
    /// ended.
    ///
    /// [`Error::Full`] if the stream has no capacity, or progress was sent less than the minimum interval ago: the port keeps the
    /// newest values, and tries again after the next [`poll`](Self::poll), or with newer values. Other errors: the values do not
    /// match the signature, or are too long for the peer.
    pub fn progress(&mut self, cx: &mut Context<'_, P>, ticket: Ticket, values: &ParametersView) -> Result<(), Error> {
        self.details.progress(&mut self.wire, &self.calls, cx, ticket, values)
    }

    /// Whether a call has been answered, or its link has ended.
    pub fn is_answered(&self, ticket: Ticket) -> bool {
        self.calls.call(ticket).is_none()
    }

    /// Whether the caller has given up a call; also `true` if the call has ended.
    pub fn is_cancelled(&self, ticket: Ticket) -> bool {
        self.calls.call(ticket).is_none_or(|head| head.cancelled != Cancelled::No)
    }

    fn goes_by_deadline(&self) -> bool {
        SCHEDULING && self.wire.constraints.scheduling != Scheduling::Fifo
    }

    /// Whether admission considers the run times of a call's function.
    fn is_measured(&self, class: Priority, keeps_order: bool) -> bool {
        let admits = ADMISSION && self.wire.constraints.scheduling == Scheduling::Admission;
        admits && !keeps_order && class != Priority::Emergency
    }

    /// Refuses a call that is not expected to make its deadline.
    pub(super) fn admit(&mut self, cx: &mut Context<'_, P>, head: &CallHead) -> Result<(), Error> {
        let (now, mut is_too_late) = (cx.now, false);
        if self.is_measured(head.priority, head.keeps_order) {
            cx.hub.enter(&mut |hub| is_too_late = hub.publications.run_times.is_too_late(now, head));
        }
        if is_too_late {
            return Err(Error::Busy);
        }
        Ok(())
    }

    /// Refuses the waiting call with the latest deadline if the newcomer's is earlier. Returns whether the newcomer can wait now.
    pub(super) fn displace(&mut self, cx: &mut Context<'_, P>, newcomer: &CallHead, length: usize) -> bool {
        if !self.goes_by_deadline() {
            return false;
        }
        let displaced = self.calls.displace(cx.now, newcomer.priority, newcomer.deadline, length);
        if let Some(CallHead { id, slot, priority, wants_reply, .. }) = displaced {
            self.wire.link.counters.count(LinkCounter::RequestsDisplaced);
            self.refuse_request(cx, id, slot, priority, wants_reply, Error::Busy);
        }
        displaced.is_some()
    }

    /// Closes a call whose answer could not be queued.
    pub fn drop_answer(&mut self, ticket: Ticket) {
        if self.calls.end(ticket) {
            self.wire.link.counters.count(LinkCounter::RepliesDropped);
        }
    }

    fn send_results(
        &mut self,
        cx: &mut Context<'_, P>,
        head: &RunningCall,
        results: &ParametersView,
    ) -> Result<(), Error> {
        let functions = cx.functions;
        let specs = match functions.lookup(head.slot, head.generation) {
            Ok(function) => function.signature.results(),
            // The function was replaced while it ran. The caller cannot decode results of the old signature.
            Err(_) => return self.wire.send_error(cx, head.id, head.priority, true, Error::ResultLost),
        };
        let Ok(length) = block::measure(specs, results) else {
            return self.wire.send_error(cx, head.id, head.priority, true, ServiceError::BadResults.into());
        };
        let limit = self.wire.peer_message_size();
        if length > limit as usize {
            return self.wire.send_error(cx, head.id, head.priority, true, Error::TooLarge { limit });
        }
        let header = encode_reply(head.id, Ok(()));
        let total = REPLY_BYTES.saturating_add(length);
        let sent = self.wire.send(cx, head.priority, total, &mut |writer| {
            writer.put(&header);
            block::write(specs, results, writer);
        });
        match sent {
            Err(Error::TooLarge { limit }) => {
                self.wire.send_error(cx, head.id, head.priority, true, Error::TooLarge { limit })
            }
            sent => sent,
        }
    }

    pub(super) fn refuse_request(
        &mut self,
        cx: &mut Context<'_, P>,
        id: u32,
        slot: Slot,
        priority: Priority,
        wants_reply: bool,
        error: Error,
    ) {
        let counter = match error {
            Error::Expired => LinkCounter::RequestsExpired,
            Error::Stale => LinkCounter::RequestsRepeated,
            Error::Busy | Error::Full(_) => LinkCounter::RequestsBusy,
            Error::TooSoon { .. } => LinkCounter::RequestsTooSoon,
            Error::NotAllowed => LinkCounter::RequestsForbidden,
            _ => LinkCounter::RequestsRejected,
        };
        self.wire.link.counters.count(counter);
        if error == Error::NotAllowed
            && let Some(function) = cx.functions.function(slot)
        {
            log_refusal(cx, self.wire.remote.as_ref(), &mut self.wire.publishing.refusals, function.name(), "call");
        }
        let error = match error {
            Error::Full(Limit::ParametersBytes | Limit::Variables) => {
                Error::TooLarge { limit: self.wire.constraints.message_size }
            }
            Error::Full(_) => Error::Busy,
            error => error,
        };
        let is_sent = self.wire.send_error(cx, id, priority, wants_reply, error).is_ok();
        // A burst of requests is refused faster than a poor network takes the refusals.
        let is_kept = is_sent || error == Error::Busy && self.calls.refused.insert(id, wants_reply);
        if !is_kept {
            self.wire.link.counters.count(LinkCounter::RepliesDropped);
        }
        if error == Error::StaleFunction {
            self.wire.publishing.notify_again(slot);
            self.pump(cx);
        }
    }

    /// Sends the refusals that waited for capacity, behind what ends or renews motion.
    pub(super) fn send_refused(&mut self, cx: &mut Context<'_, P>) {
        while let Some((id, wants_reply)) = self.calls.refused.first()
            && self.wire.send_error(cx, id, Priority::Normal, wants_reply, Error::Busy).is_ok()
        {
            self.calls.refused.remove_first();
        }
    }
}

/// Whether a call may use the slots for emergencies: both the call and its function have to be of that class.
pub(super) fn is_emergency(attributes: &Attributes, priority: Priority) -> bool {
    priority == Priority::Emergency && attributes.priority == Priority::Emergency
}

/// Decodes a call's arguments, and reserves capacity for its results, in the lent parameters.
pub(super) fn read_arguments(
    signature: Signature<'_>,
    block: &[u8],
    arguments: &mut ParametersView,
) -> Result<(), Error> {
    block::read_arguments(signature.arguments(), block, arguments)?;
    block::prepare_results(signature.results(), arguments)
}
