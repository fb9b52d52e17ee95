//! Requests of this unit: blocking ones, whose caller reads its own reply, and those that do not wait.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::thread;

use cara_core::distribution::block;
use cara_core::distribution::function::Signature;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error, Limit};
use cara_core::services::heart::Beats;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::awaiting::CallFuture;
use super::details::{Canceller, Watch};
use super::inbound::OwnCall;
use super::link::{LinkCell, LinkState, Outcome, Wake};
use super::reader::{Cause, Token};
use super::settling::RETRY;
use super::worker::READ_BYTES;
use crate::locks::Locked;
use crate::sys::stream::{Received, Wait};

/// How long a caller waits at a time for room or for its turn, before it looks again.
pub(super) const PAUSE: Duration = Duration::from_millis(20);

thread_local! {
    /// What a caller reads into. A caller that reads runs no handlers, so one is in use at a time in a thread.
    static READ_BUFFER: std::cell::RefCell<Vec<u8>> = const { std::cell::RefCell::new(Vec::new()) };
}

/// A call whose request has gone out.
struct Begun<'l> {
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
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, Error> {
        let noted = self.noted(link, function, options);
        let now = self.now();
        let mut state = link.lock();
        let result = self.request_on(now, link, &mut state, function, parameters, options, false);
        self.settle_at(now, link, state);
        if let Some(noted) = noted {
            noted.ended(result.map(drop));
        }
        result
    }

    /// Requests and waits for the reply, which updates `parameters`. On an error they are unchanged.
    pub(crate) fn block_request(
        &self,
        link: &Arc<LinkCell>,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, Error> {
        let noted = self.noted(link, function, options);
        // Nothing here would look at it.
        let options = RequestOptions { progress: false, ..*options };
        let result = self.services.state.waiting_for(link.id, || {
            self.go_on_with_parked();
            let begun = self.begin_call(link, function, parameters, &options, None)?;
            let id = begun.id;
            self.await_reply(link, begun, parameters, None).map(|()| id)
        });
        if let Some(noted) = noted {
            noted.ended(result.map(drop));
        }
        result
    }

    /// The same for a call that is watched.
    pub(crate) fn block_request_watched(
        &self,
        link: &Arc<LinkCell>,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        watch: &mut Watch<'_>,
    ) -> Result<CallId, Error> {
        let noted = self.noted(link, function, options);
        let options = RequestOptions { progress: watch.on_progress.is_some(), ..*options };
        let result = self.services.state.waiting_for(link.id, || {
            self.go_on_with_parked();
            let mut begun = self.begin_call(link, function, parameters, &options, Some(watch.canceller))?;
            let id = begun.id;
            begun.state.details.watch(id);
            let result = self.await_reply(link, begun, parameters, Some(&mut *watch));
            watch.failure = link.lock().details.unwatch(id).filter(|_| result.is_err());
            result.map(|()| id)
        });
        if let Some(noted) = noted {
            noted.ended(result.map(drop));
        }
        result
    }

    /// The same; what the call has started is given up with what is returned.
    pub(crate) fn hold(
        self: &Arc<Self>,
        link: Arc<LinkCell>,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        watch: Option<&mut Watch<'_>>,
    ) -> Result<CallFuture<T>, Error> {
        let id = match watch {
            Some(watch) => self.block_request_watched(&link, function, parameters, options, watch),
            None => self.block_request(&link, function, parameters, options),
        }?;
        Ok(CallFuture::held(self.clone(), link, id))
    }

    /// Sends the request as soon as the interval and the room allow, within the deadline, unless it is given up before.
    fn begin_call<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        canceller: Option<&Canceller>,
    ) -> Result<Begun<'l>, Error> {
        let mut now = self.now();
        let mut state = link.lock();
        let timeout = options.timeout.unwrap_or(state.session.constraints().request_timeout);
        let deadline = now + timeout;
        // It keeps its place among the calls that move the same thing, however long it waits for room.
        let made = Some(state.session.make());
        loop {
            if canceller.is_some_and(Canceller::is_cancelled) {
                return Err(Error::Cancelled);
            }
            // Before the request goes out: a thread of the pool must not wake for the reply.
            let token = self.take_token(now, link, &mut state);
            let options = RequestOptions { timeout: Some(deadline.since(now)), made, ..*options };
            let sent = self.request_on(now, link, &mut state, function, parameters, &options, true);
            let (error, wait) = match sent {
                Ok(id) => {
                    state.await_reply(id, Wake::Thread(thread::current()));
                    return Ok(Begun { state, token, id, now, deadline });
                }
                Err(error) => (error, worth_waiting(&error, PAUSE).unwrap_or(Duration::MAX)),
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
        let token = is_live.then(|| self.read_by(now, link, state, Cause::Wants)).flatten();
        self.set_interest(link, state);
        token
    }

    fn await_reply(
        &self,
        link: &Arc<LinkCell>,
        begun: Begun<'_>,
        parameters: &mut ParametersView,
        mut watch: Option<&mut Watch<'_>>,
    ) -> Result<(), Error> {
        let Begun { mut state, mut token, id, now: asked, deadline } = begun;
        let mut now = asked;
        loop {
            // The reply may have come through another thread before this one got the token. Without this look it would block in
            // reading for a reply that is here.
            if let Some(outcome) = state.take_outcome(id) {
                self.leave(link, state, token);
                return self.read_outcome(link, id, outcome, parameters);
            }
            if now >= deadline {
                self.cancel(now, link, &mut state, id);
                self.leave(link, state, token);
                return Err(Error::TimedOut);
            }
            if let Some(watch) = watch.as_deref_mut() {
                let told = state.details.take_progress(id).filter(|_| !watch.canceller.is_cancelled());
                let is_told = told.is_some();
                let mut flow = ControlFlow::Continue(());
                if let Some((told, on_progress)) = told.zip(watch.on_progress.as_mut()) {
                    // What it does may take its time: others read the link meanwhile.
                    self.leave(link, state, token.take());
                    flow = on_progress(&told);
                    state = link.lock();
                    now = self.now();
                }
                if flow.is_break() || watch.canceller.is_cancelled() {
                    self.cancel(now, link, &mut state, id);
                    self.leave(link, state, token);
                    return Err(Error::Cancelled);
                }
                if is_told {
                    continue;
                }
            }
            // A thread that reads is woken by what comes alone, so one that may be told to give up looks now and then.
            let until = if watch.is_some() { deadline.min(now + PAUSE) } else { deadline };
            token = token.or_else(|| self.read_by(now, link, &mut state, Cause::Wants));
            if let Some(token) = token {
                let mut own = OwnCall { id, parameters, result: None };
                (state, now) = self.read_for_reply(link, state, &mut own, now, until);
                if let Some(result) = own.result {
                    if result.is_err() {
                        // The results may not fit: what the call started is not wanted then.
                        self.cancel(now, link, &mut state, id);
                    }
                    state.forget(id);
                    self.leave_with_reply(asked, now, link, state, token);
                    return result;
                }
            } else {
                self.settle_at(now, link, state);
                thread::park_timeout(until.since(now).into());
                state = link.lock();
                now = self.now();
            }
        }
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
                // Zeros of the system, none of which is touched before something is read.
                *buffer = vec![0; READ_BYTES];
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
        self.read_by(now, link, &mut state, Cause::Leaves { token, waiter });
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
        // A task reads nothing itself: it would wait until the clock gives the link to the pool.
        let may_keep = state.session.is_live() && !state.is_paused() && !state.has_task() && !self.is_stopping();
        let waiter = state.next_reader();
        self.read_by(now, link, &mut state, Cause::Replied { token, asked, may_keep, waiter });
        self.settle_at(now, link, state);
    }

    /// Nothing waits for a call any more, and what it started is not wanted.
    pub(crate) fn give_up_call(&self, link: &Arc<LinkCell>, id: CallId) {
        let mut state = link.lock();
        self.cancel(self.now(), link, &mut state, id);
        self.settle(link, state);
    }

    /// A loop has ended: what it wanted is released on all links.
    pub(crate) fn release_beats(&self, beats: Beats) {
        for link in self.each_link() {
            let mut state = link.lock();
            self.with(&link, &mut state, |session, cx| session.release_beats(cx, beats));
            self.settle(&link, state);
        }
    }

    pub(super) fn cancel(&self, now: Instant, link: &LinkCell, state: &mut LinkState, id: CallId) {
        self.with_at(now, link, state, |session, cx| session.cancel(cx, id));
        state.forget(id);
    }

    /// Decodes what another thread read. What a call started whose results do not fit is not wanted.
    pub(super) fn read_outcome(
        &self,
        link: &Arc<LinkCell>,
        id: CallId,
        outcome: Outcome,
        parameters: &mut ParametersView,
    ) -> Result<(), Error> {
        let result = outcome
            .and_then(|(signature, bytes)| block::read(Signature::decode(&signature)?.results(), &bytes, parameters));
        if result.is_err() {
            self.give_up_call(link, id);
        }
        result
    }
}

/// After what time a request that failed so may succeed; after `pause` where only the end of another call makes room.
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
        || state.details.has_news(id)
        || state.waiters.iter().any(|waiter| waiter.id == id && waiter.outcome.is_some())
}
