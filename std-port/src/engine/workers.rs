//! What a thread of the pool does for a unit: it reads the link that is ready, and runs the calls that it read.
//!
//! There is always a thread that reads, or comes back to: one that is about to run a handler starts another if none is
//! idle, up to a limit; beyond it calls wait in their sessions until a handler returns. Before a handler that has been
//! quick it starts none: the clock does, should it take long after all.

use std::sync::Arc;

use cara_core::error::CloseReason;

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::serving::Started;
use super::worker::{READ_BYTES, Worker};
use crate::sys::epoll::{Interest, Ready};
use crate::sys::stream::{Received, Wait};

/// Reads of one link in a row, so that a busy one does not keep a thread from the others.
const READS: usize = 8;

impl<T: Send + 'static> Engine<T> {
    /// Whether a call may be run: another thread goes on reading.
    pub(super) fn may_run(&self, quick: bool) -> bool {
        self.may_run_at_once(quick) || self.driver.pool().may_run()
    }

    /// Whether a call may be run without another thread being started: one waits, or the handler has been quick, and the
    /// clock looks whether it still is.
    fn may_run_at_once(&self, quick: bool) -> bool {
        if self.driver.pool().has_idle() {
            return true;
        }
        let may = quick && self.driver.pool().may_run_quickly();
        if may {
            self.links.begin_watch();
        }
        may
    }

    pub(super) fn link_ready(&self, ready: Ready, worker: &mut Worker) {
        let Some(link) = self.links.of_token(ready.token) else { return };
        worker.fit(self.services.call_bytes());
        let mut state = link.lock();
        if state.reading.is_opening() && ready.writable {
            self.connected(&link, &mut state);
        }
        if ready.writable && !state.reading.is_opening() {
            self.with(&link, &mut state, |session, cx| session.writable(cx));
            link.room.notify_all();
            state.wake_tasks();
        }
        let mut call = None;
        if ready.readable && state.reading.is_free() && !state.is_paused() {
            call = self.drain(&link, &mut state, ready.hung_up, worker);
        }
        match call {
            None => call = self.next_call(&link, state, worker),
            Some(_) => self.settle(&link, state),
        }
        if let Some(call) = call {
            self.serve(&link, call, worker);
            self.stay(&link, worker);
        }
    }

    /// Reads until nothing is left or the budget is used up, in which case the epoll set reports the link again.
    fn drain(
        &self,
        link: &Arc<LinkCell>,
        state: &mut LinkState,
        hung_up: bool,
        worker: &mut Worker,
    ) -> Option<Started> {
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
            // Where no other thread goes on reading, the call waits in the session: most of what is read is none.
            let at_once = call.is_none() && self.may_run_at_once(state.reading.is_quick());
            let arguments = if at_once { Some(&mut *worker.arguments) } else { None };
            let bytes = worker.buffer.get_mut(..count).unwrap_or_default();
            call = call.or(self.feed(self.now(), link, state, bytes, arguments, None));
            // A short read has emptied the stream; a hang-up shows in one more.
            if state.is_paused() || (count < READ_BYTES && !hung_up) {
                return call;
            }
        }
        let interest = Interest { writable: state.registration.writable, ..Interest::READ_EDGE };
        let _ = self.driver.pool().epoll.modify(&link.stream, link.token(), interest);
        call
    }

    /// Runs a call that was parked and has its turn, and the calls of a link that no thread has run yet.
    pub(super) fn serve_link(&self, token: u64, worker: &mut Worker) {
        worker.fit(self.services.call_bytes());
        self.serve_parked(worker);
        let Some(link) = self.links.of_token(token) else { return };
        let state = link.lock();
        if let Some(call) = self.next_call(&link, state, worker) {
            self.serve(&link, call, worker);
        }
    }
}
