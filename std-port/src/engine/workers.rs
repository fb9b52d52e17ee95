//! The pool: a few threads that wait in one epoll set, read what is ready, and run the calls that they read.
//!
//! There is always a thread that reads: one that is about to run a handler starts another if none is idle, up to a
//! limit; beyond it calls wait in their sessions until a handler returns.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::CloseReason;
use cara_core::host::mailman::LinkId;
use cara_core::services::unit::Call;

use super::link::{LinkCell, LinkState};
use super::{Engine, READ_BYTES, lock};
use crate::sys::epoll::{Events, Interest, Ready};
use crate::sys::stream::{Received, Wait};

/// Threads that a unit starts with.
const FIRST_WORKERS: usize = 2;
/// Most threads of a unit's pool.
const MOST_WORKERS: usize = 14;
/// The token of the waker.
pub(super) const WAKER: u64 = u64::MAX;
/// Reads of one link in a row, so that a busy one does not keep a thread from the others.
const READS: usize = 8;

pub(super) struct Worker {
    events: Events,
    pub(super) buffer: Vec<u8>,
    pub(super) arguments: Box<ParametersView>,
    /// The longest message that `arguments` hold.
    longest: usize,
}

impl Worker {
    fn new(longest: usize) -> Self {
        Self { events: Events::new(1), buffer: vec![0; READ_BYTES], arguments: arena(longest), longest }
    }

    /// The limit may have changed since the last call.
    pub(super) fn fit(&mut self, longest: usize) {
        if self.longest != longest {
            self.arguments = arena(longest);
            self.longest = longest;
        }
    }
}

impl<T: Send + 'static> Engine<T> {
    pub(super) fn start_workers(self: &Arc<Self>) -> std::io::Result<()> {
        self.epoll.add(&self.pool_waker, WAKER, Interest::READ_LEVEL)?;
        for _ in 0..FIRST_WORKERS {
            self.start_worker();
        }
        Ok(())
    }

    fn start_worker(self: &Arc<Self>) -> bool {
        let started = self.workers.fetch_add(1, Ordering::AcqRel) < MOST_WORKERS;
        let engine = self.clone();
        let thread = std::thread::Builder::new().name("cara-pool".into());
        match started.then(|| thread.spawn(move || engine.work())) {
            Some(Ok(thread)) => {
                lock(&self.threads).push(thread);
                true
            }
            _ => {
                self.workers.fetch_sub(1, Ordering::AcqRel);
                false
            }
        }
    }

    /// Whether a call may be run: another thread goes on reading.
    pub(super) fn may_run(&self) -> bool {
        self.idle.load(Ordering::Acquire) > 0 || self.this().is_some_and(|engine| engine.start_worker())
    }

    /// Bytes that the parameters of a served call may need: of a message, or of the largest function.
    pub(super) fn call_bytes(&self) -> usize {
        self.longest_message.load(Ordering::Acquire).max(self.largest_function.load(Ordering::Acquire))
    }

    /// Calls are served with room for at least so many bytes of arguments and results.
    pub(crate) fn make_room_for(&self, bytes: usize) {
        self.largest_function.fetch_max(bytes, Ordering::AcqRel);
    }

    fn work(self: Arc<Self>) {
        let mut worker = Worker::new(self.call_bytes());
        while !self.is_stopping() {
            self.idle.fetch_add(1, Ordering::AcqRel);
            let waited = self.epoll.wait(&mut worker.events, None);
            self.idle.fetch_sub(1, Ordering::AcqRel);
            if let Err(error) = waited {
                tracing::error!(%error, "waiting for links failed");
                return;
            }
            worker.fit(self.call_bytes());
            let ready = worker.events.iter().next();
            match ready {
                // While the unit stops, the waker stays set, so that every thread wakes.
                Some(ready) if ready.token == WAKER && self.is_stopping() => return,
                Some(ready) if ready.token == WAKER => {
                    self.pool_waker.reset();
                }
                Some(ready) => self.ready(ready, &mut worker),
                None => {}
            }
            self.serve_waiting(&mut worker);
        }
    }

    fn ready(&self, ready: Ready, worker: &mut Worker) {
        let Some(link) = self.link_of_token(ready.token) else { return };
        let mut state = link.lock();
        if state.connecting && ready.writable {
            self.connected(&link, &mut state);
        }
        if ready.writable && !state.connecting {
            self.with(&link, &mut state, |session, cx| session.writable(cx));
            link.room.notify_all();
        }
        let mut call = None;
        if ready.readable && !state.connecting && !state.reader.is_led() && !state.is_paused() {
            call = self.drain(&link, &mut state, ready.hung_up, worker);
        }
        match call {
            None => call = self.next_call(&link, state, &mut worker.arguments),
            Some(_) => self.settle(&link, state),
        }
        if let Some(call) = call {
            self.serve(&link, call, &mut worker.arguments);
            self.stay(&link, worker);
        }
    }

    /// Reads until nothing is left or the budget is used up, in which case the epoll set reports the link again.
    fn drain(&self, link: &Arc<LinkCell>, state: &mut LinkState, hung_up: bool, worker: &mut Worker) -> Option<Call> {
        let mut call = None;
        for _ in 0..READS {
            let count = match link.stream.receive(&mut worker.buffer, Wait::Not) {
                Received::Bytes(count) => count,
                Received::WouldBlock => return call,
                Received::Closed => {
                    state.session.disconnected(CloseReason::Reset);
                    return call;
                }
            };
            let arguments = if call.is_none() && self.may_run() { Some(&mut *worker.arguments) } else { None };
            let bytes = worker.buffer.get_mut(..count).unwrap_or_default();
            call = call.or(self.feed(link, state, bytes, arguments, None));
            // A short read has emptied the stream; a hang-up shows in one more.
            if state.is_paused() || (count < READ_BYTES && !hung_up) {
                return call;
            }
        }
        let interest = Interest { writable: state.registration.writable, ..Interest::READ_EDGE };
        let _ = self.epoll.modify(&link.stream, link.token(), interest);
        call
    }

    /// Runs the calls of links that nobody has run yet.
    fn serve_waiting(&self, worker: &mut Worker) {
        while let Some(id) = self.take_ready() {
            let Some(link) = self.link(id) else { continue };
            let state = link.lock();
            if let Some(call) = self.next_call(&link, state, &mut worker.arguments) {
                self.serve(&link, call, &mut worker.arguments);
            }
        }
    }

    fn take_ready(&self) -> Option<LinkId> {
        let mut ready = lock(&self.ready);
        if ready.is_empty() || !self.may_run() {
            return None;
        }
        ready.pop_front()
    }
}

/// Bytes of the parameters in which calls of up to `message` bytes are served: as much again for results and names.
pub(crate) const fn arena_bytes(message: usize) -> usize {
    match message {
        0..=2048 => 8 * 1024,
        2049..=20_000 => 48 * 1024,
        20_001..=40_000 => 96 * 1024,
        _ => 320 * 1024,
    }
}

fn arena(message: usize) -> Box<ParametersView> {
    match message {
        0..=2048 => Box::new(Parameters::<{ arena_bytes(0) }>::sized()),
        2049..=20_000 => Box::new(Parameters::<{ arena_bytes(20_000) }>::sized()),
        20_001..=40_000 => Box::new(Parameters::<{ arena_bytes(40_000) }>::sized()),
        _ => Box::new(Parameters::<{ arena_bytes(usize::MAX) }>::sized()),
    }
}
