//! What is told of calls beside their results: why they fail, how far they are, and that their callers have given them up.

use core::convert::Infallible;
use core::future::{Future as _, poll_fn};
use core::ops::ControlFlow;
use core::pin::pin;
use core::task::Poll;

use cara_core::config::FAILURE_VALUES_BYTES;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::services::call::{Callee, Detail, Outgoing};
use cara_core::time::Instant;

use crate::calls::CallError;
use crate::handle::Handle;
use crate::handler::Served;
use crate::link::InFlight;
use crate::machine::Machine;
use crate::peer::Peer;
use crate::port::{LinkContext, LinkSession};
use crate::taken::{PAUSE, TakenCall};
use crate::task_slots::Running;
use crate::time::{now, timer};

impl<T> Served<T> {
    /// What the handler returns for this failure, whose text and values go to the caller.
    pub fn fail(&self, failure: Failure) -> ServiceError {
        let error = failure.error();
        self.failure.set(Some(failure));
        error
    }
}

impl<T> TakenCall<T> {
    /// Answers with a failure, whose text and values go to the caller; otherwise as [`reply`](Self::reply).
    pub async fn fail(mut self, failure: &Failure) {
        while let Some(running) = self.running {
            if self.unit.act(|machine| machine.answer_failed(&running, failure)) {
                self.running = None;
                return;
            }
            timer(now() + PAUSE).await;
        }
    }

    /// Tells the caller how far the call is, if it wants to know and the signature says `progress (…)`.
    ///
    /// [`Error::Full`] where it cannot be sent now, as of values that come faster than every
    /// 10 ms. A board keeps none of them: tell newer ones later. Other errors say that they do not fit the signature, or the
    /// caller.
    pub fn progress(&self, values: &ParametersView) -> Result<(), Error> {
        let Some(running) = self.running else { return Ok(()) };
        let reported = self
            .unit
            .act(|machine| machine.on_link_of(&running, |session, cx| session.progress(cx, running.ticket, values)));
        reported.unwrap_or(Ok(()))
    }

    /// Whether the caller has given the call up, waits no longer, or is gone: no answer reaches it then.
    pub fn is_cancelled(&self) -> bool {
        let given_up = |running| self.unit.look(|machine| machine.is_given_up(&running));
        now() >= self.waited_until() || self.running.is_none_or(given_up)
    }

    /// A caller without this feature does not say that its time is over.
    fn waited_until(&self) -> Instant {
        if self.wants_reply { self.deadline } else { Instant::FAR_FUTURE }
    }

    /// Ends once [`is_cancelled`](Self::is_cancelled) says so. Cancelling loses nothing.
    pub async fn given_up(&self) {
        poll_fn(|cx| {
            if self.is_cancelled() {
                return Poll::Ready(());
            }
            self.unit.lend(|machine| machine.wakers.leases.register(cx));
            pin!(timer(self.waited_until())).poll(cx)
        })
        .await;
    }
}

/// What is known of a failed call.
pub(crate) type Kept = Option<Detail>;

impl<T> Peer<T> {
    /// Why a request was not sent, with where the peer's version of the function differs.
    pub(crate) fn explained(&self, callee: Callee<'_>, error: Error) -> CallError {
        let differs = |session: &LinkSession| {
            let published = session.their_function_list().named(callee.name())?;
            callee.check(published.signature).err()
        };
        let found = if let Error::Mismatch(_) = error { self.session(differs).flatten() } else { None };
        CallError::new(error, found.map(Detail::Version))
    }
}

impl<T> Handle<T> {
    /// Lends what a call has told last to what hears it.
    ///
    /// The unit has room for what one call tells, and none while a reply waits there: what another call tells before the task
    /// has looked takes its place. Values that take more than [`FAILURE_VALUES_BYTES`] are passed over.
    pub(crate) fn hear(&self, call: &InFlight, outgoing: &mut Outgoing<'_, Infallible>) -> ControlFlow<()> {
        let Some(hear) = &mut outgoing.progress else { return ControlFlow::Continue(()) };
        let mut reported = Parameters::<FAILURE_VALUES_BYTES>::sized();
        // What it does may use the unit.
        let is_reported = self.shared.machine.borrow_mut().take_reported(call, &mut reported);
        if is_reported { hear(&reported) } else { ControlFlow::Continue(()) }
    }
}

impl<T> Machine<T> {
    /// With what the service has said. The unit has room for one of them: where another call fails before the task has looked,
    /// nothing is known.
    pub(crate) fn failed(&mut self, call: &InFlight, error: Error) -> CallError {
        CallError::new(error, self.reply.take_failure(call).map(Detail::Service))
    }

    /// Lends the session that a call came on, while it lasts.
    fn on_link_of<R>(
        &mut self,
        running: &Running,
        act: impl FnOnce(&mut LinkSession, &mut LinkContext<'_>) -> R,
    ) -> Option<R> {
        self.link(running.link).filter(|link| link.serial == running.serial)?;
        self.with(running.link, act)
    }

    /// As [`answer`](Self::answer), with why there are no results.
    pub(crate) fn answer_failed(&mut self, running: &Running, failure: &Failure) -> bool {
        let answered = self.on_link_of(running, |session, cx| {
            let kept = session.answer_failed(cx, running.ticket, failure).is_ok();
            let late = cx.now >= running.deadline;
            if !kept && late {
                session.drop_answer(running.ticket);
            }
            kept || late
        });
        answered.unwrap_or(true)
    }

    pub(crate) fn is_given_up(&self, running: &Running) -> bool {
        let link = self.link(running.link).filter(|link| link.serial == running.serial);
        link.and_then(|link| link.session.as_ref()).is_none_or(|session| session.is_cancelled(running.ticket))
    }
}
