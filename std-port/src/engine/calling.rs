//! Requests of this unit: blocking ones, whose caller reads its own reply, and those that do not wait.

use std::sync::{Arc, MutexGuard, PoisonError};
use std::task::{Context as TaskContext, Poll};
use std::thread;

use cara_core::distribution::block;
use cara_core::distribution::function::Signature;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error, Limit};
use cara_core::services::requests::CallId;
use cara_core::services::unit::RequestOptions;
use cara_core::time::{Duration, Instant};

use super::link::{LinkCell, LinkState, Outcome, Waiter, Wake};
use super::reader::Turn;
use super::{Engine, OwnCall, READ_BYTES, RETRY};
use crate::sys::stream::{Received, Wait};

/// How long a caller waits at a time for room or for its turn, before it looks again.
const PAUSE: Duration = Duration::from_millis(20);

/// The same for calls of many links, of which one or the other soon has room.
const SHORT_PAUSE: Duration = Duration::from_millis(2);

thread_local! {
    /// What a leader reads into. A leader runs no handlers, so there is one at a time in a thread.
    static READ_BUFFER: std::cell::RefCell<Vec<u8>> = const { std::cell::RefCell::new(Vec::new()) };
}

impl<T: Send + 'static> Engine<T> {
    /// Requests without waiting: an id at once, or why not.
    pub(crate) fn request(
        &self,
        link: &Arc<LinkCell>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, Error> {
        let mut state = link.lock();
        let result = self.request_on(link, &mut state, function, parameters, options, false);
        self.settle(link, state);
        result
    }

    /// Requests and waits for the reply, which updates `parameters`. On an error they are unchanged.
    pub(crate) fn block_request(
        &self,
        link: &Arc<LinkCell>,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<(), Error> {
        self.state.waiting_for(link.id, || {
            let started = self.now();
            let (state, id, deadline) = self.begin_call(link, function, parameters, options, started)?;
            self.await_reply(link, state, id, parameters, deadline)
        })
    }

    /// Sends the request as soon as the interval and the room allow, within the deadline.
    fn begin_call<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        started: Instant,
    ) -> Result<(MutexGuard<'l, LinkState>, CallId, Instant), Error> {
        let mut state = link.lock();
        let timeout = options.timeout.unwrap_or(state.session.constraints().request_timeout);
        let deadline = started + timeout;
        loop {
            let options = RequestOptions { timeout: Some(deadline.since(self.now())), ..*options };
            let sent = self.request_on(link, &mut state, function, parameters, &options, true);
            let (error, wait) = match sent {
                Ok(id) => {
                    state.waiters.push(Waiter { id, wake: Wake::Thread(thread::current()), outcome: None });
                    return Ok((state, id, deadline));
                }
                Err(error) => (error, worth_waiting(&error, PAUSE).unwrap_or(Duration::MAX)),
            };
            self.settle(link, state);
            if self.now() + wait >= deadline {
                return Err(error);
            }
            state = link.lock();
            let waited = link.room.wait_timeout(state, wait.into());
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn await_reply<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        mut state: MutexGuard<'l, LinkState>,
        id: CallId,
        parameters: &mut ParametersView,
        deadline: Instant,
    ) -> Result<(), Error> {
        let mut turn = None;
        loop {
            // The reply may have come through another thread before this one took the lead.
            if let Some(outcome) = state.take_outcome(id) {
                self.leave(link, state, turn);
                return read_outcome(outcome, parameters);
            }
            let now = self.now();
            if now >= deadline {
                state.session.cancel(id);
                state.forget(id);
                self.leave(link, state, turn);
                return Err(Error::TimedOut);
            }
            turn = turn.or_else(|| state.reader.take_lead());
            if turn.is_some() {
                let mut own = OwnCall { id, parameters, result: None };
                state = self.lead(link, state, &mut own, deadline);
                if let Some(result) = own.result {
                    state.forget(id);
                    self.leave(link, state, turn);
                    return result;
                }
            } else {
                self.settle(link, state);
                thread::park_timeout(deadline.since(now).into());
                state = link.lock();
            }
        }
    }

    /// Reads the link until the own reply has come, the deadline has passed, or somebody else has noted the end.
    fn lead<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        mut state: MutexGuard<'l, LinkState>,
        own: &mut OwnCall<'_>,
        deadline: Instant,
    ) -> MutexGuard<'l, LinkState> {
        READ_BUFFER.with_borrow_mut(|buffer| {
            if buffer.is_empty() {
                buffer.resize(READ_BYTES, 0);
            }
            loop {
                let paused = state.is_paused();
                self.settle(link, state);
                let left = deadline.since(self.now());
                let received = if paused {
                    // The clock looks at what waits; the reply may be in it.
                    thread::park_timeout(left.min(RETRY).into());
                    Received::WouldBlock
                } else {
                    link.stream.receive(buffer, Wait::AtMost(left))
                };
                state = link.lock();
                match received {
                    Received::Bytes(count) => {
                        let bytes = buffer.get_mut(..count).unwrap_or_default();
                        let call = self.feed(link, &mut state, bytes, None, Some(own));
                        debug_assert!(call.is_none(), "a leader lends no room for arguments");
                        if state.session.has_next_call() {
                            self.hand_over(link);
                        }
                    }
                    Received::WouldBlock => {}
                    Received::Closed => state.session.disconnected(CloseReason::Reset),
                }
                let ended = state.session.deadline() == Instant::START || state.session.is_ended();
                let done = own.result.is_some() || state.waiters.iter().any(|w| w.id == own.id && w.outcome.is_some());
                if ended || done || self.now() >= deadline {
                    return state;
                }
            }
        })
    }

    /// A caller is through: it passes the lead on if it has it, or was to have it.
    pub(super) fn leave(&self, link: &Arc<LinkCell>, mut guard: MutexGuard<'_, LinkState>, turn: Option<Turn>) {
        let LinkState { reader, waiters, .. } = &mut *guard;
        reader.leave(turn, || pass_lead(waiters));
        self.settle(link, guard);
    }

    /// A request as a future: the pool reads its reply.
    pub(crate) fn call_future(
        self: &Arc<Self>,
        link: Arc<LinkCell>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallFuture<T>, Error> {
        let mut state = link.lock();
        let sent = self.request_on(&link, &mut state, function, parameters, options, true);
        if let Ok(id) = sent {
            state.waiters.push(Waiter { id, wake: Wake::Task(None), outcome: None });
        }
        self.settle(&link, state);
        sent.map(|id| CallFuture { engine: self.clone(), link, id })
    }
}

impl<T: Send + 'static> Engine<T> {
    /// Begins a call on each of many links. One that has no room, or whose interval has not passed, is tried again
    /// within the deadline, while the others run.
    pub(crate) fn call_each(
        self: &Arc<Self>,
        links: Vec<Result<Arc<LinkCell>, Error>>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Vec<Result<CallFuture<T>, Error>> {
        let began = self.now();
        let mut calls: Vec<_> = links.iter().map(|_| None).collect();
        loop {
            let mut pause = Duration::MAX;
            for (link, call) in links.iter().zip(&mut calls).filter(|(_, call)| call.is_none()) {
                let Ok(link) = link.as_ref().map_err(|error| *call = Some(Err(*error))) else { continue };
                let usual = || link.lock().session.constraints().request_timeout;
                let deadline = began + options.timeout.unwrap_or_else(usual);
                let options = RequestOptions { timeout: Some(deadline.since(self.now())), ..*options };
                let attempt = self.call_future(link.clone(), function, parameters, &options);
                match attempt.as_ref().err().and_then(|error| worth_waiting(error, SHORT_PAUSE)) {
                    Some(wait) if self.now() + wait < deadline => pause = pause.min(wait),
                    _ => *call = Some(attempt),
                }
            }
            if pause == Duration::MAX {
                return calls.into_iter().flatten().collect();
            }
            thread::sleep(pause.into());
        }
    }
}

/// After what time a request that failed so may succeed; after `pause` where only somebody else's end makes room.
fn worth_waiting(error: &Error, pause: Duration) -> Option<Duration> {
    match *error {
        Error::TooSoon { wait } => Some(wait),
        Error::Full(Limit::SendQueue | Limit::Buffers | Limit::Calls) => Some(pause),
        _ => None,
    }
}

/// Wakes one thread that waits for a reply, so that it takes the lead. `false` when there is none.
pub(super) fn pass_lead(waiters: &mut [Waiter]) -> bool {
    let next = waiters.iter_mut().find(|w| w.outcome.is_none() && matches!(w.wake, Wake::Thread(_)));
    match next {
        Some(waiter) => {
            waiter.wake.wake();
            true
        }
        None => false,
    }
}

/// Decodes what another thread read.
fn read_outcome(outcome: Outcome, parameters: &mut ParametersView) -> Result<(), Error> {
    let (signature, bytes) = outcome?;
    block::read(Signature::decode(&signature)?.results(), &bytes, parameters)
}

/// A call in flight. Dropping it gives up the reply; the service may still run.
pub(crate) struct CallFuture<T: Send + 'static> {
    engine: Arc<Engine<T>>,
    link: Arc<LinkCell>,
    id: CallId,
}

impl<T: Send + 'static> CallFuture<T> {
    /// Polls for the reply, which updates `parameters`.
    pub(crate) fn poll(
        &mut self,
        cx: &mut TaskContext<'_>,
        parameters: &mut ParametersView,
    ) -> Poll<Result<(), Error>> {
        let mut state = self.link.lock();
        if let Some(outcome) = state.take_outcome(self.id) {
            drop(state);
            return Poll::Ready(read_outcome(outcome, parameters));
        }
        match state.waiters.iter_mut().find(|waiter| waiter.id == self.id) {
            Some(waiter) => {
                waiter.wake = Wake::Task(Some(cx.waker().clone()));
                Poll::Pending
            }
            None => Poll::Ready(Err(Error::Interrupted)),
        }
    }
}

impl<T: Send + 'static> Drop for CallFuture<T> {
    fn drop(&mut self) {
        let mut state = self.link.lock();
        let id = self.id;
        state.session.cancel(id);
        state.forget(id);
        self.engine.settle(&self.link, state);
    }
}
