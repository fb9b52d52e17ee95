//! What a thread of the pool does for a unit: it reads the link that is ready, and runs the calls that it read.
//!
//! There is always a thread that reads, or is about to: one that is about to run a handler starts another if none is
//! idle, up to a limit; beyond it calls wait in their sessions until a handler returns. Before a handler that has been
//! quick it starts none: the clock does, should it take long after all.
//!
//! Going back to the epoll set after each call costs a system call, and on a busy CPU a second thread that is woken for
//! the next call while the first has not yet returned. So a thread stays on the link that it has just served, and blocks
//! in reading it: only while another one waits in the epoll set, and only on links whose calls follow each other at once
//! and are quick. Should one take long after all, the clock takes its token away ([`Links::look`](super::links::Links::look)),
//! so that other threads read on; until then that link's stream waits, but not its datagrams, which carry emergencies and
//! keep-alives as well, and no other link.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::error::CloseReason;
use cara_core::time::Instant;

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::reader::{Cause, Token};
use super::serving::Started;
use super::watch::Staying;
use super::worker::{READ_BYTES, Worker};
use crate::locks::Locked;
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
            // If no other thread can take over reading, leave the call queued in the session. Most reads carry no call.
            let at_once = call.is_none() && self.may_run_at_once(state.reading.is_quick());
            let arguments = if at_once { Some(&mut *worker.arguments) } else { None };
            let bytes = worker.buffer.get_mut(..count).unwrap_or_default();
            call = call.or(self.feed(self.now(), link, state, bytes, arguments, None));
            // A short read has emptied the stream. After a hang-up one more read returns the end of the stream.
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

    /// Waits on `link` for more calls, as long as they come and are quick, and another thread looks after the rest.
    fn stay(&self, link: &Arc<LinkCell>, worker: &mut Worker) {
        let Some((token, _staying)) = self.begin_stay(link) else { return };
        let _occupied = self.driver.pool().occupancy.enter();
        while let Some((call, began)) = self.await_call(link, token, worker) {
            let Some((state, now)) = self.serve_one(began, link, call, worker) else { break };
            if state.session.has_next_call() || state.is_paused() {
                // It is busy until the last of those that waited behind this call is done.
                if let Some(call) = self.next_call(link, state, worker) {
                    self.serve(link, call, worker);
                }
                if !self.continues(self.now(), link, link.lock(), token) {
                    break;
                }
            } else if !self.continues(now, link, state, token) {
                break;
            }
        }
        self.leave(link, link.lock(), Some(token));
    }

    fn begin_stay(&self, link: &Arc<LinkCell>) -> Option<(Token, Staying<'_>)> {
        let served = self.driver.pool().served.fetch_add(1, Ordering::Relaxed);
        if !self.driver.pool().has_idle() {
            return None;
        }
        let staying = self.links.watch.stay()?;
        let now = self.now();
        let mut state = link.lock();
        let may = state.waiters.is_empty() && state.session.is_live() && !state.is_paused();
        let token = self.links.read_by(now, link, &mut state, Cause::Stays { served, may })?;
        self.settle_at(now, link, state);
        Some((token, staying))
    }

    /// The thread has served a call: whether it stays.
    fn continues<'l>(
        &self,
        now: Instant,
        link: &'l Arc<LinkCell>,
        mut state: Locked<'l, LinkState>,
        token: Token,
    ) -> bool {
        self.links.read_by(now, link, &mut state, Cause::Ends(token));
        let stays = state.reading.is_quick() && !state.is_paused() && state.reading.is_held(token);
        self.settle_at(now, link, state);
        stays && self.driver.pool().has_idle() && !self.is_stopping()
    }

    /// Reads until a call is to be run; `None` when nothing comes any more, or the thread is needed elsewhere.
    fn await_call(&self, link: &Arc<LinkCell>, token: Token, worker: &mut Worker) -> Option<(Started, Instant)> {
        loop {
            let received = link.stream.receive(&mut worker.buffer, Wait::Slice);
            let now = self.now();
            worker.fit(self.services.call_bytes());
            let mut state = link.lock();
            let call = match received {
                Received::Bytes(count) => {
                    let bytes = worker.buffer.get_mut(..count).unwrap_or_default();
                    self.feed(now, link, &mut state, bytes, Some(&mut worker.arguments), None)
                }
                Received::WouldBlock => return None,
                Received::Closed => {
                    state.session.disconnected(CloseReason::Reset);
                    self.settle(link, state);
                    return None;
                }
            };
            let call = call.or_else(|| self.waiting_call(link, &mut state, worker));
            if call.is_some() {
                self.links.read_by(now, link, &mut state, Cause::Begins(token));
            }
            let alive = state.session.is_live() && state.waiters.is_empty() && !state.is_paused();
            self.settle_at(now, link, state);
            if let Some(call) = call {
                return Some((call, now));
            }
            if !alive || !self.driver.pool().has_idle() || self.is_stopping() {
                return None;
            }
        }
    }

    /// A call that came together with others and may begin.
    fn waiting_call(&self, link: &Arc<LinkCell>, state: &mut LinkState, worker: &mut Worker) -> Option<Started> {
        self.dispatch_emergencies(link, state);
        let has = state.session.has_next_call();
        has.then(|| self.take_call(link, state, worker)).flatten()
    }
}
