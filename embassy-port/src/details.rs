//! What is told of calls beside their results: why they fail, how far they are, and that their callers have given them up.

use core::future::poll_fn;
use core::ops::ControlFlow;
use core::task::Poll;

use cara_core::config::FAILURE_VALUES_BYTES;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::services::session::RequestOptions;

use crate::handler::Served;
use crate::machine::{LinkContext, LinkSession, Machine};
use crate::peer::Peer;
use crate::taken::{PAUSE, Running, TakenCall};
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
        let told = self
            .unit
            .act(|machine| machine.on_link_of(&running, |session, cx| session.progress(cx, running.ticket, values)));
        told.unwrap_or(Ok(()))
    }

    /// Whether the caller has given the call up, waits no longer, or is gone: no answer reaches it then.
    pub fn is_cancelled(&self) -> bool {
        self.running.is_none_or(|running| self.unit.look(|machine| machine.is_given_up(&running)))
    }

    /// Ends once [`is_cancelled`](Self::is_cancelled) says so. Cancelling loses nothing.
    pub async fn given_up(&self) {
        poll_fn(|cx| {
            if self.is_cancelled() {
                return Poll::Ready(());
            }
            self.unit.shared.machine.borrow_mut().wakers.leases.register(cx.waker());
            Poll::Pending
        })
        .await;
    }
}

impl<T> Peer<T> {
    /// As [`block_request_with`](Self::block_request_with), with what the service has said of a failure in `why`. The unit has
    /// room for one of them: where another call fails before the task has looked, it stays `None`.
    pub async fn block_request_explained(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        why: &mut Option<Failure>,
    ) -> Result<(), Error> {
        // Nothing here would look at it.
        let options = &RequestOptions { progress: false, ..*options };
        self.await_told(function, parameters, options, |_| ControlFlow::Continue(()), why).await
    }

    /// The same, with what the call tells while it runs: the newest progress that the task has not looked at, and none after
    /// the reply. Where `on_progress` returns `Break`, the call is given up and ends with [`Error::Cancelled`]: what it moves
    /// stops, and its handler is told.
    ///
    /// The unit has room for what one call tells, and none while a reply waits there: what another call tells before the task
    /// has looked takes its place. Values that take more than [`FAILURE_VALUES_BYTES`] are passed over.
    pub async fn block_request_with_progress(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
    ) -> Result<(), Error> {
        let options = &RequestOptions { progress: true, ..*options };
        self.await_told(function, parameters, options, on_progress, why).await
    }

    async fn await_told(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        mut on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
    ) -> Result<(), Error> {
        *why = None;
        let timeout = options.timeout.unwrap_or(self.unit.constraints().request_timeout);
        let mut call = self.begin(function, parameters, options, now() + timeout).await?;
        poll_fn(|cx| {
            let mut told = Parameters::<FAILURE_VALUES_BYTES>::sized();
            // What it does may use the unit.
            let is_told = self.unit.shared.machine.borrow_mut().take_told(&call.call, &mut told);
            if is_told && on_progress(&told).is_break() {
                return Poll::Ready(Err(Error::Cancelled));
            }
            let mut machine = self.unit.shared.machine.borrow_mut();
            let Some(outcome) = machine.outcome(&call.call, parameters, cx.waker()) else { return Poll::Pending };
            *why = machine.reply.take_failure(&call.call);
            Poll::Ready(outcome)
        })
        .await?;
        call.is_wanted = true;
        Ok(())
    }
}

impl<T> Machine<T> {
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
