//! Calls that no thread waits for: the pool reads their replies, and the link, or the clock, wakes their tasks.

use std::fmt;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::call::{Callee, Outgoing};
use cara_core::services::requests::{CallId, Made};
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::calling::{PAUSE, of_given_up, worth_waiting};
use super::details::Canceller;
use super::driving::Alarm;
use super::link::{LinkCell, Wake};
use super::noting::Recorded;
use super::reader::Cause;
use super::state_gate::Mark;
use crate::error::CallError;
use crate::growing::CallParameters;

/// The pause before the next try for calls on many links: one of the links soon has room.
const SHORT_PAUSE: Duration = Duration::from_millis(2);

/// A call that was answered, by its link.
#[derive(Clone)]
pub struct Answered {
    pub(crate) link: Arc<LinkCell>,
    pub(crate) id: CallId,
}

impl fmt::Debug for Answered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.id.fmt(f)
    }
}

/// A call that a task waits for. It may have to wait for the minimum interval, or for room, before it is sent. While its task is
/// polled by a method that holds the application's state, its peer counts as waited for.
///
/// Dropped before it has ended, it is given up: nothing waits for its reply, and the lease that it began, or would begin, is
/// released. A service without a lease may still run.
pub struct Pending<T: Send + 'static> {
    engine: Arc<Engine<T>>,
    link: Arc<LinkCell>,
    stage: Stage,
    deadline: Instant,
    /// It was given up, and its answer is waited for until then.
    given_up: Option<Instant>,
    /// Its place among the calls that move the same thing, however long it waits for room.
    made: Made,
    alarm: Alarm,
    mark: Option<Mark>,
    /// For the audit log and those who follow, which get it also if the call is dropped before it has ended.
    recorded: Option<Box<Recorded>>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    Unsent,
    Sent(CallId),
    Over { was_sent: bool },
}

impl<T: Send + 'static> fmt::Debug for Pending<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pending").finish_non_exhaustive()
    }
}

impl<T: Send + 'static> Pending<T> {
    /// One that has not been tried yet. Its deadline counts from here.
    pub(crate) fn new(
        engine: &Arc<Engine<T>>,
        link: Arc<LinkCell>,
        callee: Callee<'_>,
        options: &RequestOptions,
    ) -> Self {
        let now = engine.now();
        let (timeout, made) = {
            let mut state = link.lock();
            (engine.timeout(now, &state, &callee, options), state.session.make())
        };
        Self {
            engine: engine.clone(),
            stage: Stage::Unsent,
            given_up: None,
            deadline: now + timeout,
            made,
            alarm: Alarm::new(engine.driver.clone()),
            mark: None,
            recorded: engine.notes.recorded(&link, callee.name(), options).map(Box::new),
            link,
        }
    }

    /// Goes on with the call, whose results update the parameters.
    pub(crate) fn poll(
        &mut self,
        outgoing: &mut Outgoing<'_, Canceller>,
        cx: &Context<'_>,
    ) -> Poll<Result<Answered, CallError>> {
        if self.stage == Stage::Unsent && outgoing.canceller.is_some_and(Canceller::is_cancelled) {
            return self.over(Err(Error::Cancelled.into()));
        }
        let (parameters, options) = (&*outgoing.parameters, outgoing.options);
        let (polled, again) = match self.send(outgoing.callee, parameters, options, cx.waker(), PAUSE) {
            Err(error) => return self.over(Err(error)),
            Ok(again) => (if again.is_some() { Poll::Pending } else { self.poll_reply(outgoing, cx) }, again),
        };
        // There is one alarm: the pause before the next try may be longer than the time in which a canceller is heard.
        let look = outgoing.canceller.filter(|_| polled.is_pending()).map(|_| self.engine.now() + PAUSE);
        let end = self.given_up.filter(|_| polled.is_pending());
        if let Some(at) = again.into_iter().chain(look).chain(end).min() {
            self.alarm.set(at, cx.waker());
        }
        polled
    }

    /// Sends it unless it has been sent; when to try again where that is worth while.
    fn send(
        &mut self,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        waker: &Waker,
        pause: Duration,
    ) -> Result<Option<Instant>, CallError> {
        self.mark();
        if self.stage != Stage::Unsent {
            return Ok(None);
        }
        self.recorded.iter_mut().for_each(|recorded| recorded.asks(parameters));
        let now = self.engine.now();
        let options = RequestOptions { timeout: Some(self.deadline.since(now)), made: Some(self.made), ..*options };
        match self.begin(now, callee, parameters, &options, waker) {
            Ok(id) => {
                self.stage = Stage::Sent(id);
                Ok(None)
            }
            Err(error) => match worth_waiting(&error.error, pause) {
                Some(wait) if now + wait < self.deadline => Ok(Some(now + wait)),
                _ => Err(error),
            },
        }
    }

    /// Sends a request whose reply the pool reads. Where it finds no room, the task of `waker` looks again when the link has
    /// changed.
    fn begin(
        &self,
        now: Instant,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        waker: &Waker,
    ) -> Result<CallId, CallError> {
        let (engine, link) = (&self.engine, &self.link);
        let mut state = link.lock();
        // A link that is kept is read by no thread until its caller is back.
        engine.links.read_by(now, link, &mut state, Cause::NeedsPool);
        let sent = engine.request_on(now, link, &mut state, callee, parameters, options, true);
        match &sent {
            Ok(id) => state.await_reply(*id, Wake::Task(Some(waker.clone()))),
            Err(error) if matches!(error.error, Error::Full(_)) => state.await_change(waker),
            Err(_) => {}
        }
        engine.settle(link, state);
        sent
    }

    fn poll_reply(
        &mut self,
        outgoing: &mut Outgoing<'_, Canceller>,
        cx: &Context<'_>,
    ) -> Poll<Result<Answered, CallError>> {
        let Stage::Sent(id) = self.stage else { return Poll::Ready(Err(Error::Interrupted.into())) };
        let (engine, link) = (self.engine.clone(), self.link.clone());
        let mut state = link.lock();
        let mut breaks = false;
        loop {
            if let Some(ended) = engine.take_ended(&link, &mut state, id, outgoing.parameters) {
                engine.settle(&link, state);
                if ended.is_ok() {
                    self.recorded.iter_mut().for_each(|recorded| recorded.answers(outgoing.parameters));
                }
                let is_given_up = self.given_up.is_some();
                return self.over(ended.map_err(|error| of_given_up(is_given_up, error)));
            }
            let is_cancelled = breaks || outgoing.canceller.is_some_and(Canceller::is_cancelled);
            if is_cancelled && self.given_up.is_none() {
                self.given_up = engine.give_up_but_wait(engine.now(), &link, &mut state, id, outgoing.options);
                if self.given_up.is_some() {
                    engine.settle(&link, state);
                    // The answer may have come meanwhile, and would wake nobody.
                    state = link.lock();
                    continue;
                }
            }
            let is_over = self.given_up.map_or(is_cancelled, |end| engine.now() >= end);
            let news = state.take_progress(id).filter(|_| !is_cancelled && self.given_up.is_none());
            let Some((news, hear)) = news.zip(outgoing.progress.as_mut()) else {
                if is_over {
                    drop(state);
                    return self.over(Err(Error::Cancelled.into()));
                }
                let earlier = state.await_reply_by(id, Wake::Task(Some(cx.waker().clone())));
                // Dropped without the lock: see `LinkState::forget`.
                drop(state);
                return if earlier.is_some() { Poll::Pending } else { self.over(Err(Error::Interrupted.into())) };
            };
            drop(state);
            breaks = hear(&news).is_break();
            if breaks && outgoing.options.answer_within == Duration::ZERO {
                return self.over(Err(Error::Cancelled.into()));
            }
            state = link.lock();
        }
    }

    /// The call has ended with this outcome. After an error it is given up.
    fn over(&mut self, ended: Result<(), CallError>) -> Poll<Result<Answered, CallError>> {
        let stage = self.stage;
        self.stage = Stage::Over { was_sent: stage != Stage::Unsent };
        self.unmark();
        if let Some(recorded) = self.recorded.take() {
            recorded.ended(ended.as_ref().map(|()| None).map_err(|failed| failed.error));
        }
        let answered = match stage {
            Stage::Sent(id) => ended.map(|()| Answered { link: self.link.clone(), id }).inspect_err(|_| {
                self.engine.give_up_call(&self.link, id);
            }),
            Stage::Unsent | Stage::Over { .. } => ended.and(Err(Error::Interrupted.into())),
        };
        Poll::Ready(answered)
    }

    /// Whether the request has been sent, also if the call has ended since.
    pub(crate) const fn was_sent(&self) -> bool {
        matches!(self.stage, Stage::Sent(_) | Stage::Over { was_sent: true })
    }

    fn mark(&mut self) {
        if self.mark.is_none() {
            self.mark = self.engine.services.state.mark(self.link.id);
            if self.mark.is_some() {
                self.engine.services.go_on_with_parked();
            }
        }
    }

    fn unmark(&mut self) {
        if let Some(mark) = self.mark.take() {
            self.engine.services.state.unmark(mark);
        }
    }
}

impl<T: Send + 'static> Drop for Pending<T> {
    fn drop(&mut self) {
        self.unmark();
        if let Stage::Sent(id) = self.stage {
            self.engine.give_up_call(&self.link, id);
        }
    }
}

/// Calls of one function on many links, all at the same time. Dropped, those that have not ended are given up.
pub(crate) struct CallsToAll<T: Send + 'static> {
    calls: Vec<Member<T>>,
    options: RequestOptions,
    /// Those before this one have ended.
    front: usize,
    unsent: usize,
    alarm: Alarm,
}

enum Member<T: Send + 'static> {
    Pending(Pending<T>),
    Ended(Result<(), CallError>),
}

impl<T: Send + 'static> CallsToAll<T> {
    /// Nothing is sent before it is polled; the deadlines count from here.
    pub(crate) fn new(
        engine: &Arc<Engine<T>>,
        links: impl IntoIterator<Item = Result<Arc<LinkCell>, Error>>,
        function: &str,
        options: RequestOptions,
    ) -> Self {
        let call = |link: Result<_, Error>| match link {
            Ok(link) => Member::Pending(Pending::new(engine, link, function.into(), &options)),
            Err(error) => Member::Ended(Err(error.into())),
        };
        let calls: Vec<_> = links.into_iter().map(call).collect();
        Self { unsent: calls.len(), calls, options, front: 0, alarm: Alarm::new(engine.driver.clone()) }
    }

    /// Ready when all have ended. `parameters` lends those of a call, by its place.
    pub(crate) fn poll(
        &mut self,
        cx: &Context<'_>,
        function: &str,
        parameters: &mut [impl CallParameters],
    ) -> Poll<()> {
        self.send_unsent(cx, function, parameters);
        // A reply that comes out of turn stays at its link, and wakes no task: the work is that of one look for each call.
        while let Some((call, parameters)) = self.calls.get_mut(self.front).zip(parameters.get_mut(self.front)) {
            if let Member::Pending(pending) = call {
                if !pending.was_sent() {
                    return Poll::Pending;
                }
                let (callee, options) = (function.into(), &self.options);
                let parameters = parameters.view_mut();
                let mut outgoing = Outgoing { callee, parameters, options, progress: None, canceller: None };
                match pending.poll_reply(&mut outgoing, cx) {
                    Poll::Ready(ended) => *call = Member::Ended(ended.map(drop)),
                    Poll::Pending => return Poll::Pending,
                }
            }
            self.front += 1;
        }
        Poll::Ready(())
    }

    fn send_unsent(&mut self, cx: &Context<'_>, function: &str, parameters: &mut [impl CallParameters]) {
        if self.unsent == 0 {
            return;
        }
        self.unsent = 0;
        let mut again = Instant::FAR_FUTURE;
        for (call, parameters) in self.calls.iter_mut().zip(parameters) {
            let Member::Pending(pending) = call else { continue };
            match pending.send(function.into(), parameters.view_mut(), &self.options, cx.waker(), SHORT_PAUSE) {
                Err(error) => {
                    if let Poll::Ready(ended) = pending.over(Err(error)) {
                        *call = Member::Ended(ended.map(drop));
                    }
                }
                Ok(None) => {}
                Ok(Some(at)) => {
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
    pub(crate) fn into_outcomes(self) -> impl Iterator<Item = Result<(), CallError>> {
        self.calls.into_iter().map(|call| match call {
            Member::Ended(outcome) => outcome,
            Member::Pending(_) => Err(Error::TimedOut.into()),
        })
    }
}
