//! Requests of this unit: blocking ones, whose caller reads its own reply, and those that do not wait.

use std::sync::Arc;
use std::thread;

use cara_core::config::Priority;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function_list::Function;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error, Limit};
use cara_core::services::call::{Callee, Detail, Outgoing};
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::details::Canceller;
use super::inbound::OwnCall;
use super::link::{LinkCell, LinkState, Wake};
use super::nested;
use super::pinging::{self, Turn};
use super::reader::{Cause, Token};
use super::settling::RETRY;
use super::worker::READ_BYTES;
use crate::error::CallError;
use crate::locks::Locked;
use crate::storage::filled;
use crate::sys::stream::{Received, Wait};

/// How long a caller waits at a time for room or for its turn, before it looks again.
pub(super) const PAUSE: Duration = Duration::from_millis(20);

/// What a caller reads at a time, until a read is as long. A program may have hundreds of threads that call, and most replies are short.
const FIRST_READ_BYTES: usize = 16 * 1024;

thread_local! {
    /// The buffer that a caller reads into. A caller that reads runs no handlers, so a thread uses one at a time.
    static READ_BUFFER: std::cell::RefCell<Vec<u8>> = const { std::cell::RefCell::new(Vec::new()) };
}

/// A call whose request has gone out.
struct Started<'l> {
    state: Locked<'l, LinkState>,
    token: Option<Token>,
    id: CallId,
    now: Instant,
    deadline: Instant,
}

impl<T: Send + 'static> Engine<T> {
    /// Requests without waiting: an id at once, or why not.
    pub(crate) fn request(
        &self,
        link: &Arc<LinkCell>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, CallError> {
        let mut recorded = self.notes.recorded(link, callee.name(), options);
        recorded.iter_mut().for_each(|recorded| recorded.asks(parameters));
        let now = self.now();
        let mut state = link.lock();
        let result = self.request_on(now, link, &mut state, callee, parameters, options, false);
        self.settle_at(now, link, state);
        if let Some(recorded) = recorded {
            recorded.ended(result.as_ref().map(|id| Some(id.0)).map_err(|error| error.error));
        }
        result
    }

    /// Requests and waits for the reply, which updates the parameters. On an error they are unchanged.
    pub(crate) fn block_request(
        &self,
        link: &Arc<LinkCell>,
        mut outgoing: Outgoing<'_, Canceller>,
    ) -> Result<CallId, CallError> {
        let mut recorded = self.notes.recorded(link, outgoing.callee.name(), outgoing.options);
        recorded.iter_mut().for_each(|recorded| recorded.asks(outgoing.parameters));
        let result = self.services.state.waiting_for(link.id, || {
            self.services.go_on_with_parked();
            let started = self.begin_call(link, &outgoing)?;
            let id = started.id;
            self.await_reply(link, started, &mut outgoing).map(|()| id)
        });
        if let Some(mut recorded) = recorded {
            if result.is_ok() {
                recorded.answers(outgoing.parameters);
            }
            recorded.ended(result.as_ref().map(|_| None).map_err(|error| error.error));
        }
        result
    }

    /// What a handler asks for its caller is of no use once that waits no longer; a stop is sent all the same.
    pub(super) fn timeout(
        &self,
        now: Instant,
        state: &LinkState,
        callee: &Callee<'_>,
        options: &RequestOptions,
    ) -> Duration {
        let timeout = options.timeout.unwrap_or(state.session.constraints().request_timeout);
        match nested::left(self.driver.clock(), now) {
            Some(left) if !is_urgent(state, callee, options) => timeout.min(left),
            _ => timeout,
        }
    }

    /// Sends the request as soon as the interval and the room allow, within the deadline, unless it is given up before.
    fn begin_call<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        outgoing: &Outgoing<'_, Canceller>,
    ) -> Result<Started<'l>, CallError> {
        let Outgoing { callee, parameters, options, canceller, .. } = outgoing;
        let mut now = self.now();
        let mut state = link.lock();
        let deadline = now + self.timeout(now, &state, callee, options);
        // It keeps its place among the calls that move the same thing, however long it waits for room.
        let made = Some(state.session.make());
        loop {
            if canceller.is_some_and(Canceller::is_cancelled) {
                return Err(Error::Cancelled.into());
            }
            // Before the request goes out: a thread of the pool must not wake for the reply.
            let token = self.take_token(now, link, &mut state);
            let options = RequestOptions { timeout: Some(deadline.since(now)), made, ..**options };
            let sent = self.request_on(now, link, &mut state, *callee, parameters, &options, true);
            let (error, wait) = match sent {
                Ok(id) => {
                    state.await_reply(id, Wake::Thread(thread::current()));
                    return Ok(Started { state, token, id, now, deadline });
                }
                Err(error) => {
                    let wait = worth_waiting(&error.error, PAUSE).unwrap_or(Duration::MAX);
                    (error, wait)
                }
            };
            self.leave(link, state, token);
            if self.now() + wait >= deadline {
                return Err(error);
            }
            state = link.lock();
            state = state.wait(&link.room, if canceller.is_some() { wait.min(PAUSE) } else { wait });
            now = self.now();
        }
    }

    fn take_token(&self, now: Instant, link: &LinkCell, state: &mut LinkState) -> Option<Token> {
        let is_live = state.session.is_live();
        let token = is_live.then(|| self.links.read_by(now, link, state, Cause::Wants)).flatten();
        self.links.set_interest(link, state);
        token
    }

    fn await_reply(
        &self,
        link: &Arc<LinkCell>,
        started: Started<'_>,
        outgoing: &mut Outgoing<'_, Canceller>,
    ) -> Result<(), CallError> {
        let Started { mut state, mut token, id, now: asked, mut deadline } = started;
        let Outgoing { parameters, options, progress, canceller, .. } = outgoing;
        let mut now = asked;
        let (mut breaks, mut is_given_up) = (false, false);
        loop {
            // The reply may have come through another thread before this one got the token. Without this look it would block in
            // reading for a reply that is here.
            if !breaks && let Some(ended) = self.take_ended(link, &mut state, id, parameters) {
                self.leave(link, state, token);
                return ended.map_err(|error| of_given_up(is_given_up, error));
            }
            let gives_up = !is_given_up && (breaks || canceller.is_some_and(Canceller::is_cancelled));
            if gives_up && let Some(end) = self.give_up_but_wait(now, link, &mut state, id, options) {
                (breaks, is_given_up, deadline) = (false, true, deadline.min(end));
                continue;
            }
            if gives_up || now >= deadline {
                self.cancel(now, link, &mut state, id);
                self.leave(link, state, token);
                return Err(if gives_up || is_given_up { Error::Cancelled } else { Error::TimedOut }.into());
            }
            if let Some(hear) = progress
                && !is_given_up
                && let Some(news) = state.take_progress(id)
            {
                // What it does may take its time: others read the link meanwhile.
                self.leave(link, state, token.take());
                breaks = hear(&news).is_break();
                state = link.lock();
                now = self.now();
                continue;
            }
            // Only arriving bytes wake a thread that reads, so a call with a canceller looks at it now and then.
            let until = if canceller.is_some() { deadline.min(now + PAUSE) } else { deadline };
            token = token.or_else(|| self.links.read_by(now, link, &mut state, Cause::Wants));
            if let Some(token) = token {
                let mut own = OwnCall { id, parameters, result: None };
                (state, now) = self.read_for_reply(link, state, &mut own, now, until);
                if let Some(result) = own.result {
                    if result.is_err() {
                        // The results may not fit: what the call started is not wanted then.
                        self.with_at(now, link, &mut state, |session, cx| session.cancel(cx, id));
                    }
                    let failure = state.forget(id);
                    self.leave_with_reply(asked, now, link, state, token);
                    return result.map_err(|error| of_given_up(is_given_up, failed(error, failure)));
                }
            } else {
                self.settle_at(now, link, state);
                thread::park_timeout(until.since(now).into());
                state = link.lock();
                now = self.now();
            }
        }
    }

    /// How a call has ended, if it has, with the results that another thread has read. What it started whose results do not fit
    /// is not wanted.
    pub(super) fn take_ended(
        &self,
        link: &LinkCell,
        state: &mut LinkState,
        id: CallId,
        parameters: &mut ParametersView,
    ) -> Option<Result<(), CallError>> {
        let ended = state.take_ended(id)?;
        let session = &state.session;
        let result = ended.outcome?.and_then(|(slot, generation, bytes)| {
            session.kept_results(slot, generation, &bytes)?.read_into(parameters)
        });
        if result.is_err() {
            self.with(link, state, |session, cx| session.cancel(cx, id));
        }
        Some(result.map_err(|error| failed(error, ended.failure)))
    }

    /// Reads the link until the own reply has come, the deadline has passed, or another thread has noted the end. Returns
    /// the time of its last look at the clock as well.
    fn read_for_reply<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        mut state: Locked<'l, LinkState>,
        own: &mut OwnCall<'_>,
        mut now: Instant,
        deadline: Instant,
    ) -> (Locked<'l, LinkState>, Instant) {
        READ_BUFFER.with_borrow_mut(|buffer| {
            if buffer.is_empty() {
                *buffer = vec![0; FIRST_READ_BYTES];
            }
            loop {
                if state.is_paused() {
                    // The reply may be in what waits to be looked at.
                    self.take_in(now, link, &mut state, &mut [], own);
                    if own.result.is_some() {
                        return (state, now);
                    }
                }
                let paused = state.is_paused();
                self.settle_at(now, link, state);
                let left = deadline.since(now);
                let received = if paused {
                    thread::park_timeout(left.min(RETRY).into());
                    Received::WouldBlock
                } else {
                    link.stream.receive(buffer, Wait::AtMost(left))
                };
                now = self.now();
                state = link.lock();
                match received {
                    Received::Bytes(count) => {
                        self.take_in(now, link, &mut state, buffer.get_mut(..count).unwrap_or_default(), own);
                        if count == buffer.len() && count < READ_BYTES {
                            *buffer = vec![0; READ_BYTES];
                        }
                    }
                    Received::WouldBlock => {}
                    Received::Closed => state.session.disconnected(CloseReason::Reset),
                }
                if own.result.is_some() || now >= deadline || is_over(&state, own.id) {
                    return (state, now);
                }
            }
        })
    }

    /// Looks at what a caller has read; calls of the peer are left to the pool.
    fn take_in(
        &self,
        now: Instant,
        link: &Arc<LinkCell>,
        state: &mut LinkState,
        bytes: &mut [u8],
        own: &mut OwnCall<'_>,
    ) {
        let call = self.feed(now, link, state, bytes, None, Some(own));
        debug_assert!(call.is_none(), "a caller that reads lends no room for arguments");
        if state.session.has_next_call() {
            self.hand_over(link);
        }
    }

    /// A thread no longer waits for the link: the next caller gets its token, or the pool.
    pub(super) fn leave(&self, link: &Arc<LinkCell>, mut state: Locked<'_, LinkState>, token: Option<Token>) {
        let (now, waiter) = (self.now(), state.next_reader());
        self.links.read_by(now, link, &mut state, Cause::Leaves { token, waiter });
        self.settle_at(now, link, state);
    }

    /// The same for a caller that has read its own reply, and keeps the link if its calls follow each other at once.
    fn leave_with_reply(
        &self,
        asked: Instant,
        now: Instant,
        link: &Arc<LinkCell>,
        mut state: Locked<'_, LinkState>,
        token: Token,
    ) {
        // Not while a task waits for a reply: no thread reads a kept link until the clock gives it to the pool.
        let may_keep = state.session.is_live() && !state.is_paused() && !state.has_task() && !self.is_stopping();
        let waiter = state.next_reader();
        self.links.read_by(now, link, &mut state, Cause::Replied { token, asked, may_keep, waiter });
        self.settle_at(now, link, state);
    }

    #[expect(clippy::too_many_arguments, reason = "those of a request, and where and when it is made")]
    /// A request on a link. If all of the link's slots for calls are taken, it gets more.
    pub(super) fn request_on(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wait: bool,
    ) -> Result<CallId, CallError> {
        if options.only_while_leading && !self.leads_at(now) {
            return Err(Error::NoAuthority.into());
        }
        let options = &RequestOptions { only_while_leading: false, ..*options };
        let mut attempt =
            || self.with_at(now, link, state, |session, cx| session.request(cx, callee, parameters, options, wait));
        let mut outcome = attempt();
        let most = self.links.capacities.calls_in_flight;
        if outcome == Err(Error::Full(Limit::Calls)) && state.session.call_slots() < most {
            drop(state.session.lend_calls(filled(most, None)));
            outcome = self.with(link, state, |session, cx| session.request(cx, callee, parameters, options, wait));
        }
        // Only the program asks later what became of a call, and only of its own.
        if let Ok(id) = outcome
            && !options.operator
            && state.session.last_order().is_some_and(|(_, order)| order == id)
            && let Some(peer) = link.peer.get()
        {
            peer.ordered(callee.name(), state.session.nonce() as u32, id);
        }
        outcome.map_err(|error| match error {
            Error::Mismatch(_) => mismatch(state, callee, error),
            error => error.into(),
        })
    }

    /// Asks for a sign of life and returns how long it took. Of several callers on a link each has its turn.
    pub(crate) fn ping(&self, link: &Arc<LinkCell>, timeout: Duration) -> Result<Duration, Error> {
        let deadline = self.now() + timeout;
        let (_turn, state) = Turn::wait(link, self.driver.clock(), deadline)?;
        self.round_trip(link, state, deadline)
    }

    fn round_trip<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        mut state: Locked<'l, LinkState>,
        deadline: Instant,
    ) -> Result<Duration, Error> {
        let clock = self.driver.clock();
        // A link that is kept is read by no thread until its caller is back.
        self.links.read_by(clock.now(), link, &mut state, Cause::NeedsPool);
        loop {
            match self.with(link, &mut state, |session, cx| session.ping(cx)) {
                Ok(()) => break,
                Err(Error::Full(_)) => state = pinging::wait(link, state, clock, deadline)?,
                Err(error) => return Err(error),
            }
        }
        self.settle(link, state);
        state = link.lock();
        loop {
            if let Some(took) = state.session.round_trip() {
                return Ok(took);
            }
            state = pinging::wait(link, state, clock, deadline)?;
        }
    }

    /// Nothing waits for a call any more, and what it started is not wanted.
    pub(crate) fn give_up_call(&self, link: &Arc<LinkCell>, id: CallId) {
        let mut state = link.lock();
        self.cancel(self.now(), link, &mut state, id);
        self.settle(link, state);
    }

    /// Gives a call up whose answer is waited for all the same, and until when; `None` where its caller does not want that.
    pub(super) fn give_up_but_wait(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        id: CallId,
        options: &RequestOptions,
    ) -> Option<Instant> {
        if options.answer_within == Duration::ZERO {
            return None;
        }
        self.with_at(now, link, state, |session, cx| session.cancel_but_wait(cx, id));
        Some(now + options.answer_within)
    }

    fn cancel(&self, now: Instant, link: &LinkCell, state: &mut LinkState, id: CallId) {
        self.with_at(now, link, state, |session, cx| session.cancel(cx, id));
        state.forget(id);
    }
}

/// Why a call has no results, with what its service has said.
fn failed(error: Error, failure: Option<Box<Failure>>) -> CallError {
    CallError::new(error, failure.map(|failure| Detail::Service(*failure)))
}

/// A call that was given up before its deadline passed is a cancelled one.
pub(super) fn of_given_up(is_given_up: bool, error: CallError) -> CallError {
    if is_given_up && error.error == Error::TimedOut { Error::Cancelled.into() } else { error }
}

/// Where the peer's version of a function differs.
#[cold]
fn mismatch(state: &LinkState, callee: Callee<'_>, error: Error) -> CallError {
    let published = state.session.their_function_list().named(callee.name());
    let found = published.and_then(|published| callee.check(published.signature).err());
    CallError::new(error, found.map(Detail::Version))
}

/// Whether a call is an emergency, or stops something.
fn is_urgent(state: &LinkState, callee: &Callee<'_>, options: &RequestOptions) -> bool {
    let function = state.session.their_function_list().named(callee.name());
    function.is_some_and(|Function { attributes, .. }| {
        let class = options.priority.unwrap_or(attributes.priority);
        class == Priority::Emergency || attributes.is_urgent(class)
    })
}

/// When a request that failed with this error may succeed: after `pause` if only the end of another call makes room.
pub(crate) fn worth_waiting(error: &Error, pause: Duration) -> Option<Duration> {
    match *error {
        Error::TooSoon { wait } => Some(wait),
        Error::Full(Limit::SendQueue | Limit::Buffers | Limit::Calls) => Some(pause),
        _ => None,
    }
}

/// Whether a caller need not read on: the link has ended, or another thread has noted the end of its call.
fn is_over(state: &LinkState, id: CallId) -> bool {
    let ended = state.session.deadline() == Instant::START || state.session.is_ended();
    ended
        || state.waiters.iter().any(|waiter| waiter.id == id && (waiter.outcome.is_some() || waiter.progress.is_some()))
}
