//! A thread of the pool that stays on the link that it has just served, and blocks in reading it.
//!
//! Going back to the epoll set after each call costs a system call, and on a busy CPU a second thread that is woken for
//! the next call while the first has not yet returned. A thread stays only while another one waits in the epoll set, and
//! only on links whose calls follow each other at once and are quick. Should one take long after all, the clock takes its
//! token away ([`Engine::watch_links`]), so that other threads read on; until then that link's stream waits, but not its
//! datagrams, which carry emergencies and keep-alives as well, and no other link.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::error::CloseReason;
use cara_core::time::Instant;

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::reader::{Cause, Token};
use super::serving::Started;
use super::watch::Staying;
use super::worker::Worker;
use crate::locks::Locked;
use crate::sys::stream::{Received, Wait};

impl<T: Send + 'static> Engine<T> {
    /// Waits on `link` for more calls, as long as they come and are quick, and another thread looks after the rest.
    pub(super) fn stay(&self, link: &Arc<LinkCell>, worker: &mut Worker) {
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
