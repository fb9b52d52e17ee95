//! Calls that no thread waits for: the pool reads their replies, and the link, or the clock, wakes their tasks.

use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
#[cfg(feature = "async")]
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::alarms::Alarm;
#[cfg(feature = "async")]
use super::calling::PAUSE;
use super::calling::worth_waiting;
use super::link::{LinkCell, Wake};
use super::noting::Noted;
use super::reader::Cause;
use super::state_gate::Mark;
use crate::growing::CallParameters;

/// The pause before the next try for calls of many links, of which one or the other soon has room.
const SHORT_PAUSE: Duration = Duration::from_millis(2);

impl<T: Send + 'static> Engine<T> {
    /// Sends a request whose reply the pool reads. Where it finds no room, the task of `waker` looks again when the link has
    /// changed.
    pub(crate) fn call_future(
        self: &Arc<Self>,
        link: &Arc<LinkCell>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        waker: Option<&Waker>,
    ) -> Result<CallFuture<T>, Error> {
        let mut state = link.lock();
        let now = self.now();
        // A link that is kept is read by no thread until its caller is back.
        self.read_by(now, link, &mut state, Cause::NeedsPool);
        let sent = self.request_on(now, link, &mut state, function, parameters, options, true);
        match (sent, waker) {
            (Ok(id), _) => {
                state.await_reply(id, Wake::Task(waker.cloned()));
                if options.progress {
                    state.details.watch(id);
                }
            }
            (Err(Error::Full(_)), Some(waker)) => state.await_change(waker),
            _ => {}
        }
        self.settle(link, state);
        sent.map(|id| CallFuture { engine: self.clone(), link: link.clone(), id, has_succeeded: false, failure: None })
    }

    /// Begins a call, which waits within its deadline until it can be sent; the error where it never can.
    #[cfg(feature = "async")]
    pub(crate) fn pending_call(
        self: &Arc<Self>,
        link: Arc<LinkCell>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<PendingCall<T>, Error> {
        let mut call = PendingCall::new(self, link, function, options);
        match call.send(parameters, None, PAUSE) {
            Ok(_) => Ok(call),
            Err(error) => {
                call.over(Err(error));
                Err(error)
            }
        }
    }
}

/// A call in flight. Dropped before it has ended well, it is given up: nothing waits for its reply, and the lease that it
/// began, or would begin, is released. A service without a lease may still run.
pub(crate) struct CallFuture<T: Send + 'static> {
    engine: Arc<Engine<T>>,
    link: Arc<LinkCell>,
    id: CallId,
    has_succeeded: bool,
    /// Why it failed, of one that is watched.
    failure: Option<Box<Failure>>,
}

impl<T: Send + 'static> CallFuture<T> {
    /// One that has ended well: what it has started is given up with this.
    pub(crate) const fn held(engine: Arc<Engine<T>>, link: Arc<LinkCell>, id: CallId) -> Self {
        Self { engine, link, id, has_succeeded: false, failure: None }
    }

    /// The call's id.
    #[cfg(feature = "control")]
    pub(crate) const fn id(&self) -> CallId {
        self.id
    }

    /// Whether the lease that it has begun is renewed.
    pub(crate) fn is_held(&self) -> bool {
        self.link.lock().session.holds(self.id)
    }

    /// What a call has started that ended well is not wanted any longer than this.
    #[cfg(any(feature = "async", feature = "control"))]
    pub(crate) const fn release(&mut self) {
        self.has_succeeded = false;
    }

    /// Gives up what it has started, and tells how that ended once its peer has told. It is given up at once also where this
    /// is dropped before.
    #[cfg(feature = "async")]
    pub(crate) async fn ended(self, timeout: Duration) -> Result<LeaseEnd, Error> {
        let (engine, link, id) = (self.engine.clone(), self.link.clone(), self.id);
        drop(self);
        engine.end_of_order(&link, id, timeout).await
    }

    /// Why it failed, where its service has said so and it was watched.
    #[cfg(any(feature = "async", feature = "control"))]
    pub(crate) const fn take_failure(&mut self) -> Option<Box<Failure>> {
        self.failure.take()
    }

    /// The newest that it has told, if it is watched; `None` as well where it has ended. Otherwise the task of `cx` is woken.
    #[cfg(any(feature = "async", feature = "control"))]
    pub(crate) fn poll_progress(&self, cx: &Context<'_>) -> Poll<Option<Box<ParametersView>>> {
        let mut state = self.link.lock();
        let told = state.details.take_progress(self.id);
        let waiter = state.waiters.iter_mut().find(|waiter| waiter.id == self.id && waiter.outcome.is_none());
        let Some(waiter) = waiter else { return Poll::Ready(None) };
        if told.is_some() {
            return Poll::Ready(told);
        }
        let earlier = std::mem::replace(&mut waiter.wake, Wake::Task(Some(cx.waker().clone())));
        drop(state);
        drop(earlier);
        Poll::Pending
    }

    /// Polls for the reply, which updates `parameters`.
    pub(crate) fn poll(&mut self, cx: &mut Context<'_>, parameters: &mut ParametersView) -> Poll<Result<(), Error>> {
        let mut state = self.link.lock();
        if let Some(outcome) = state.take_outcome(self.id) {
            self.failure = state.details.unwatch(self.id);
            drop(state);
            let result = self.engine.read_outcome(&self.link, self.id, outcome, parameters);
            self.has_succeeded = result.is_ok();
            return Poll::Ready(result);
        }
        let Some(waiter) = state.waiters.iter_mut().find(|waiter| waiter.id == self.id) else {
            return Poll::Ready(Err(Error::Interrupted));
        };
        let earlier = std::mem::replace(&mut waiter.wake, Wake::Task(Some(cx.waker().clone())));
        // Dropped without the lock: see `LinkState::forget`.
        drop(state);
        drop(earlier);
        Poll::Pending
    }
}

impl<T: Send + 'static> Drop for CallFuture<T> {
    fn drop(&mut self) {
        if !self.has_succeeded {
            drop(self.link.lock().details.unwatch(self.id));
            self.engine.give_up_call(&self.link, self.id);
        }
    }
}

/// A call that may have to wait for the minimum interval, or for room, before it is sent. While its task is polled by a
/// method that holds the application's state, its peer counts as waited for.
pub(crate) struct PendingCall<T: Send + 'static> {
    engine: Arc<Engine<T>>,
    link: Arc<LinkCell>,
    stage: Stage<T>,
    mark: Option<Mark>,
    /// For the audit log; dropped before the call has ended, it notes that.
    noted: Option<Noted>,
}

enum Stage<T: Send + 'static> {
    Unsent { function: Box<str>, options: RequestOptions, deadline: Instant },
    Sent(CallFuture<T>),
}

/// How far a call is.
pub(crate) enum Step {
    Over(Result<(), Error>),
    InFlight,
    /// It is to be tried again then, or when its link has changed.
    Again(Instant),
}

/// What a call that is watched has told.
#[cfg(feature = "async")]
pub(crate) enum Told {
    Progress(Box<ParametersView>),
    Nothing,
    /// It has not been sent, and is to be tried again then.
    Again(Instant),
    /// It has ended, or could not be sent.
    Over(Option<Error>),
}

impl<T: Send + 'static> PendingCall<T> {
    /// One that has not been tried yet. Its deadline counts from here.
    fn new(engine: &Arc<Engine<T>>, link: Arc<LinkCell>, function: &str, options: &RequestOptions) -> Self {
        let (usual, made) = {
            let session = &mut link.lock().session;
            (session.constraints().request_timeout, Some(session.make()))
        };
        let deadline = engine.now() + options.timeout.unwrap_or(usual);
        let stage = Stage::Unsent { function: function.into(), options: RequestOptions { made, ..*options }, deadline };
        let noted = engine.noted(&link, function, options);
        Self { engine: engine.clone(), link, stage, mark: None, noted }
    }

    /// Sends it unless it has been sent; when to try again where that is worth while.
    fn send(
        &mut self,
        parameters: &ParametersView,
        waker: Option<&Waker>,
        pause: Duration,
    ) -> Result<Option<Instant>, Error> {
        let Stage::Unsent { function, options, deadline } = &self.stage else { return Ok(None) };
        let now = self.engine.now();
        let options = RequestOptions { timeout: Some(deadline.since(now)), ..*options };
        match self.engine.call_future(&self.link, function, parameters, &options, waker) {
            Ok(call) => {
                self.stage = Stage::Sent(call);
                Ok(None)
            }
            Err(error) => match worth_waiting(&error, pause) {
                Some(wait) if now + wait < *deadline => Ok(Some(now + wait)),
                _ => Err(error),
            },
        }
    }

    /// Goes on with the call, whose results update `parameters`. An alarm for [`Step::Again`] is left to the caller.
    #[cfg(feature = "async")]
    pub(crate) fn advance(&mut self, cx: &mut Context<'_>, parameters: &mut ParametersView) -> Step {
        self.advance_after(cx, parameters, PAUSE)
    }

    fn advance_after(&mut self, cx: &mut Context<'_>, parameters: &mut ParametersView, pause: Duration) -> Step {
        self.mark();
        let step = match self.send(parameters, Some(cx.waker()), pause) {
            Err(error) => Step::Over(Err(error)),
            Ok(Some(at)) => Step::Again(at),
            Ok(None) => self.poll(cx, parameters),
        };
        if let Step::Over(result) = &step {
            self.over(*result);
        }
        step
    }

    fn poll(&mut self, cx: &mut Context<'_>, parameters: &mut ParametersView) -> Step {
        let Stage::Sent(call) = &mut self.stage else { return Step::InFlight };
        match call.poll(cx, parameters) {
            Poll::Ready(result) => {
                self.over(result);
                Step::Over(result)
            }
            Poll::Pending => Step::InFlight,
        }
    }

    /// It has ended so.
    fn over(&mut self, result: Result<(), Error>) {
        self.unmark();
        if let Some(noted) = self.noted.take() {
            noted.ended(result);
        }
    }

    const fn is_sent(&self) -> bool {
        matches!(self.stage, Stage::Sent(_))
    }

    /// As [`CallFuture::poll_progress`], sending the call first where it has not been; an error where that failed.
    #[cfg(feature = "async")]
    pub(crate) fn advance_progress(&mut self, cx: &Context<'_>, parameters: &ParametersView) -> Told {
        self.mark();
        match self.send(parameters, Some(cx.waker()), PAUSE) {
            Err(error) => {
                self.over(Err(error));
                Told::Over(Some(error))
            }
            Ok(Some(at)) => Told::Again(at),
            Ok(None) => {
                let Stage::Sent(call) = &self.stage else { return Told::Nothing };
                match call.poll_progress(cx) {
                    Poll::Ready(Some(told)) => Told::Progress(told),
                    Poll::Ready(None) => Told::Over(None),
                    Poll::Pending => Told::Nothing,
                }
            }
        }
    }

    /// Why it failed, where its service has said so and it was watched.
    #[cfg(feature = "async")]
    pub(crate) const fn take_failure(&mut self) -> Option<Box<Failure>> {
        match &mut self.stage {
            Stage::Sent(call) => call.take_failure(),
            Stage::Unsent { .. } => None,
        }
    }

    /// The call, once it has ended: what it has started is given up with it.
    #[cfg(feature = "async")]
    pub(crate) fn into_held(mut self) -> Option<CallFuture<T>> {
        self.unmark();
        let unsent =
            Stage::Unsent { function: Box::default(), options: RequestOptions::default(), deadline: Instant::START };
        match std::mem::replace(&mut self.stage, unsent) {
            Stage::Sent(mut call) => {
                call.release();
                Some(call)
            }
            Stage::Unsent { .. } => None,
        }
    }

    fn mark(&mut self) {
        if self.mark.is_none() {
            self.mark = self.engine.services.state.mark(self.link.id);
            if self.mark.is_some() {
                self.engine.go_on_with_parked();
            }
        }
    }

    fn unmark(&mut self) {
        if let Some(mark) = self.mark.take() {
            self.engine.services.state.unmark(mark);
        }
    }
}

impl<T: Send + 'static> Drop for PendingCall<T> {
    fn drop(&mut self) {
        self.unmark();
    }
}

/// Calls of one function on many links, all at the same time. Dropped, those that have not ended are given up.
pub(crate) struct CallsToAll<T: Send + 'static> {
    calls: Vec<Member<T>>,
    /// Those before this one have ended.
    front: usize,
    unsent: usize,
    alarm: Alarm<T>,
}

enum Member<T: Send + 'static> {
    Goes(PendingCall<T>),
    Ended(Result<(), Error>),
}

impl<T: Send + 'static> CallsToAll<T> {
    /// Nothing is sent before it is polled; the deadlines count from here.
    pub(crate) fn new(
        engine: &Arc<Engine<T>>,
        links: impl IntoIterator<Item = Result<Arc<LinkCell>, Error>>,
        function: &str,
        options: &RequestOptions,
    ) -> Self {
        let call = |link: Result<_, _>| match link {
            Ok(link) => Member::Goes(PendingCall::new(engine, link, function, options)),
            Err(error) => Member::Ended(Err(error)),
        };
        let calls: Vec<_> = links.into_iter().map(call).collect();
        Self { unsent: calls.len(), calls, front: 0, alarm: Alarm::new(engine.clone()) }
    }

    /// Ready when all have ended. `parameters` lends those of a call, by its place.
    pub(crate) fn poll(&mut self, cx: &mut Context<'_>, parameters: &mut [impl CallParameters]) -> Poll<()> {
        self.send_unsent(cx, parameters);
        // A reply that comes out of turn stays at its link, and wakes no task: the work is that of one look for each call.
        while let Some((call, parameters)) = self.calls.get_mut(self.front).zip(parameters.get_mut(self.front)) {
            if let Member::Goes(pending) = call {
                match pending.poll(cx, parameters.view_mut()) {
                    Step::Over(result) => *call = Member::Ended(result),
                    Step::InFlight | Step::Again(_) => return Poll::Pending,
                }
            }
            self.front += 1;
        }
        Poll::Ready(())
    }

    fn send_unsent(&mut self, cx: &mut Context<'_>, parameters: &mut [impl CallParameters]) {
        if self.unsent == 0 {
            return;
        }
        self.unsent = 0;
        let mut again = Instant::FAR_FUTURE;
        for (call, parameters) in self.calls.iter_mut().zip(parameters) {
            let Member::Goes(pending) = call else { continue };
            if pending.is_sent() {
                continue;
            }
            match pending.advance_after(cx, parameters.view_mut(), SHORT_PAUSE) {
                Step::Over(result) => *call = Member::Ended(result),
                Step::InFlight => {}
                Step::Again(at) => {
                    self.unsent += 1;
                    again = again.min(at);
                }
            }
        }
        if self.unsent > 0 {
            self.alarm.set(again, cx.waker());
        }
    }

    /// How each has ended; those that have not are given up.
    pub(crate) fn into_outcomes(self) -> impl Iterator<Item = Result<(), Error>> {
        self.calls.into_iter().map(|call| match call {
            Member::Ended(outcome) => outcome,
            Member::Goes(_) => Err(Error::TimedOut),
        })
    }
}
