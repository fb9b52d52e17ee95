//! A thread of the pool that stays on the link that it has just served, and blocks in reading it.
//!
//! Going back to the epoll set after each call costs a system call, and on a busy CPU a second thread that is woken for
//! the next call while the first has not yet returned. A thread stays only while another one waits in the epoll set, and
//! only on links whose handlers are quick. Should one take long after all, [`Engine::relieve_stays`] takes the lead away
//! within [`RELIEF`], so that other threads read on; until then that link's stream waits, but not its datagrams, which
//! carry emergencies and keep-alives as well, and no other link.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::error::CloseReason;
use cara_core::services::unit::Call;
use cara_core::time::{Duration, Instant};

use super::calling::pass_lead;
use super::link::{LinkCell, LinkState};
use super::reader::Turn;
use super::workers::Worker;
use super::{Engine, lock};
use crate::sys::stream::{Received, Wait};

/// Threads of the pool that may stay on links.
const MOST_STAYS: usize = 4;
/// A thread stays on a link that is served again after at most this many calls of other links. With more busy links than
/// that, staying would keep threads from those that have something to read.
const FEW: usize = 4;
/// A handler that runs longer than this while its thread has the lead loses it.
const RELIEF: Duration = Duration::from_millis(1);

impl<T: Send + 'static> Engine<T> {
    /// Waits on `link` for more calls, as long as they come and are quick, and another thread looks after the rest.
    pub(super) fn stay(&self, link: &Arc<LinkCell>, worker: &mut Worker) {
        let Some(turn) = self.begin_stay(link) else { return };
        while let Some(call) = self.await_call(link, turn, worker) {
            // It is busy until the last of those that waited behind this call is done.
            self.serve(link, call, &mut worker.arguments);
            if !self.may_stay(link, turn) {
                break;
            }
        }
        self.end_stay(link, turn);
    }

    fn begin_stay(&self, link: &Arc<LinkCell>) -> Option<Turn> {
        let served = self.crew().served.fetch_add(1, Ordering::Relaxed);
        let mut stays = lock(&self.stays);
        if stays.len() >= MOST_STAYS || !self.crew().has_idle() {
            return None;
        }
        let mut state = link.lock();
        let others = served.wrapping_sub(std::mem::replace(&mut state.served, served));
        if others > FEW
            || !state.quick
            || !state.waiters.is_empty()
            || !state.session.is_live()
            || state.is_paused()
            || !state.reader.pool_reads()
        {
            return None;
        }
        let turn = state.reader.take_lead()?;
        stays.push(link.id);
        let first = stays.len() == 1;
        drop(stays);
        self.settle(link, state);
        if first {
            self.wake_clock();
        }
        Some(turn)
    }

    fn may_stay(&self, link: &LinkCell, turn: Turn) -> bool {
        let mut state = link.lock();
        state.reader.set_busy(turn, None);
        let goes_on = state.quick && !state.is_paused() && state.reader.is_leader(turn);
        goes_on && self.crew().has_idle() && !self.is_stopping()
    }

    /// Reads until a call is to be run; `None` when nothing comes any more or the lead is lost.
    fn await_call(&self, link: &Arc<LinkCell>, turn: Turn, worker: &mut Worker) -> Option<Call> {
        loop {
            let received = link.stream.receive(&mut worker.buffer, Wait::Slice);
            worker.fit(self.call_bytes());
            let mut state = link.lock();
            let call = match received {
                Received::Bytes(count) => {
                    let bytes = worker.buffer.get_mut(..count).unwrap_or_default();
                    self.feed(link, &mut state, bytes, Some(&mut worker.arguments), None)
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
                state.reader.set_busy(turn, Some(self.now()));
            }
            let alive = state.session.is_live() && state.waiters.is_empty() && !state.is_paused();
            self.settle(link, state);
            if call.is_some() {
                return call;
            }
            if !alive || !self.crew().has_idle() || self.is_stopping() {
                return None;
            }
        }
    }

    /// A call that came together with others and may begin.
    fn waiting_call(&self, link: &LinkCell, state: &mut LinkState, worker: &mut Worker) -> Option<Call> {
        let has = state.session.has_next_call();
        has.then(|| self.with(link, state, |session, cx| session.next_call(cx, &mut worker.arguments))).flatten()
    }

    fn end_stay(&self, link: &Arc<LinkCell>, turn: Turn) {
        let mut stays = lock(&self.stays);
        // Another thread may stay on the same link since this one lost the lead.
        if let Some(index) = stays.iter().position(|id| *id == link.id) {
            stays.swap_remove(index);
        }
        drop(stays);
        self.leave(link, link.lock(), Some(turn));
    }

    /// Takes the lead from threads whose handlers take long; returns when to look again.
    pub(super) fn relieve_stays(&self) -> Instant {
        let stays = lock(&self.stays).clone();
        if stays.is_empty() {
            return Instant::FAR_FUTURE;
        }
        let now = self.now();
        for link in stays.into_iter().filter_map(|id| self.link(id)) {
            // Whoever holds the lock is not inside a handler; the next look comes soon.
            let Some(mut state) = link.try_lock() else { continue };
            let LinkState { reader, waiters, .. } = &mut *state;
            if reader.relieve(now, RELIEF, || pass_lead(waiters)) {
                self.settle(&link, state);
            }
        }
        now + RELIEF
    }
}
