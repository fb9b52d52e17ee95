//! A thread of the pool that stays on the link that it has just served, and blocks in reading it.
//!
//! Going back to the epoll set after each call costs a system call, and on a busy CPU a second thread that is woken for
//! the next call while the first has not yet returned. A thread stays only while another one waits in the epoll set, and
//! only on links whose calls follow each other at once and are quick. Should one take long after all, the clock takes the
//! lead away ([`Engine::watch_links`]), so that other threads read on; until then that link's stream waits, but not its
//! datagrams, which carry emergencies and keep-alives as well, and no other link.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, MutexGuard};

use cara_core::error::CloseReason;
use cara_core::time::{Duration, Instant};

use super::calling::pass_lead;
use super::link::{LinkCell, LinkState};
use super::reader::Turn;
use super::serving::Begun;
use super::workers::Worker;
use super::{Engine, lock};
use crate::sys::stream::{Received, Wait};

/// Threads of the pool that may stay on links.
const MOST_STAYS: usize = 4;
/// A thread stays on a link that is served again after at most this many calls of other links. With more busy links than
/// that, staying would keep threads from those that have something to read.
const FEW: usize = 4;
/// Calls that come within this time of each other follow each other at once.
const AT_ONCE: Duration = Duration::from_millis(1);
/// A handler that runs longer than this while its thread has the lead loses it.
const RELIEF: Duration = Duration::from_millis(1);
/// How often the clock looks at links that are led or kept, as long as anything happens there. Calls on a single link put
/// the look off ([`Engine::put_off_look`]).
pub(super) const LOOK: Duration = Duration::from_millis(2);

/// The same moment for all units that share a clock, so that it wakes once for all of them.
fn next_look(now: Instant) -> Instant {
    let every = LOOK.as_micros();
    Instant::from_micros((now.as_micros() / every + 1) * every)
}

/// When the clock looks next, for those who put that off.
#[derive(Debug)]
pub(super) struct NextLook {
    at: AtomicU64,
    /// What is due beside links.
    others: AtomicU64,
}

impl NextLook {
    pub(super) const fn new() -> Self {
        Self { at: AtomicU64::new(u64::MAX), others: AtomicU64::new(u64::MAX) }
    }

    fn at(&self) -> Instant {
        Instant::from_micros(self.at.load(Ordering::Acquire))
    }

    fn others(&self) -> Instant {
        Instant::from_micros(self.others.load(Ordering::Relaxed))
    }

    /// The clock is about to wait.
    fn set(&self, at: Instant, others: Instant) {
        self.others.store(others.as_micros(), Ordering::Relaxed);
        self.at.store(at.as_micros(), Ordering::Release);
    }

    /// Unless the clock has looked meanwhile.
    fn put_off(&self, from: Instant, to: Instant) {
        let _ = self.at.compare_exchange(from.as_micros(), to.as_micros(), Ordering::AcqRel, Ordering::Relaxed);
    }
}

impl<T: Send + 'static> Engine<T> {
    /// Waits on `link` for more calls, as long as they come and are quick, and another thread looks after the rest.
    pub(super) fn stay(&self, link: &Arc<LinkCell>, worker: &mut Worker) {
        let Some(turn) = self.begin_stay(link) else { return };
        let _occupied = self.crew().occupancy.enter();
        while let Some((call, began)) = self.await_call(link, turn, worker) {
            let Some((state, now)) = self.serve_one(began, link, call, worker) else { break };
            if state.session.has_next_call() || state.is_paused() {
                // It is busy until the last of those that waited behind this call is done.
                if let Some(call) = self.next_call(link, state, worker) {
                    self.serve(link, call, worker);
                }
                if !self.goes_on(self.now(), link, link.lock(), turn) {
                    break;
                }
            } else if !self.goes_on(now, link, state, turn) {
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
        let now = self.now();
        let mut state = link.lock();
        let others = served.wrapping_sub(std::mem::replace(&mut state.served, served));
        let before = state.served_at.replace(now);
        if others > FEW
            || before.is_none_or(|before| now >= before + AT_ONCE)
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
        self.crew().watched.fetch_add(1, Ordering::Relaxed);
        drop(stays);
        self.take_out(link, &mut state);
        self.settle_at(now, link, state);
        Some(turn)
    }

    /// The thread has served a call: whether it stays.
    fn goes_on<'l>(
        &self,
        now: Instant,
        link: &'l Arc<LinkCell>,
        mut state: MutexGuard<'l, LinkState>,
        turn: Turn,
    ) -> bool {
        state.reader.set_busy(turn, None);
        let stays = state.quick && !state.is_paused() && state.reader.is_leader(turn);
        self.settle_at(now, link, state);
        stays && self.crew().has_idle() && !self.is_stopping()
    }

    /// Reads until a call is to be run; `None` when nothing comes any more or the lead is lost.
    fn await_call(&self, link: &Arc<LinkCell>, turn: Turn, worker: &mut Worker) -> Option<(Begun, Instant)> {
        loop {
            let received = link.stream.receive(&mut worker.buffer, Wait::Slice);
            let now = self.now();
            worker.fit(self.call_bytes());
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
                state.reader.set_busy(turn, Some(now));
            }
            let alive = state.session.is_live() && state.waiters.is_empty() && !state.is_paused();
            self.settle_at(now, link, state);
            if let Some(call) = call {
                self.begin_watch();
                self.put_off_look(now);
                return Some((call, now));
            }
            if !alive || !self.crew().has_idle() || self.is_stopping() {
                return None;
            }
        }
    }

    /// A call that came together with others and may begin.
    fn waiting_call(&self, link: &Arc<LinkCell>, state: &mut LinkState, worker: &mut Worker) -> Option<Begun> {
        self.dispatch_emergencies(link, state);
        let has = state.session.has_next_call();
        has.then(|| self.take_call(link, state, worker)).flatten()
    }

    fn end_stay(&self, link: &Arc<LinkCell>, turn: Turn) {
        let mut stays = lock(&self.stays);
        // Another thread may stay on the same link since this one lost the lead.
        if let Some(index) = stays.iter().position(|id| *id == link.id) {
            stays.swap_remove(index);
            self.crew().watched.fetch_sub(1, Ordering::Relaxed);
        }
        drop(stays);
        self.leave(link, link.lock(), Some(turn));
    }

    /// The clock is to look at the links that are led or kept, until nothing happens there any more.
    pub(super) fn begin_watch(&self) {
        if self.watch.begins() {
            self.wake_clock();
        }
    }

    /// Gives to the pool what is led by a thread whose handler takes long, and what is kept for a caller who does not come
    /// back; returns when to look again. The unit's `others` are due then.
    pub(super) fn watch_links(&self, others: Instant) -> Instant {
        self.next_look.set(Instant::FAR_FUTURE, others);
        if !self.watch.is_on() {
            return Instant::FAR_FUTURE;
        }
        let now = self.now();
        let used = self.watch.look();
        let busy = self.relieve_stays(now) | self.crew().relieve(now, RELIEF);
        if !self.look_at_kept(now) && !busy && !used {
            return Instant::FAR_FUTURE;
        }
        self.watch.go_on();
        let next = next_look(now);
        self.next_look.set(next, others);
        next
    }

    /// A call comes or ends at `now`. Where the clock looks at no other link, it need not look before the next one is
    /// overdue: a wake-up every 2 ms would be in the way of each hundredth call.
    pub(super) fn put_off_look(&self, now: Instant) {
        let look = self.next_look.at();
        if look >= now + LOOK.divided_by(2)
            || self.crew().watched.load(Ordering::Relaxed) != 1
            || !self.crew().has_idle()
        {
            return;
        }
        let Some(seat) = self.seat() else { return };
        let due = || lock(&self.timers).next().unwrap_or(Instant::FAR_FUTURE).min(self.next_look.others());
        if let Some(at) = self.crew().put_off(seat, look, || due().min(now + LOOK)) {
            self.next_look.put_off(look, at);
        }
    }

    /// Takes the lead from threads whose handlers take long; whether others may soon take as long.
    fn relieve_stays(&self, now: Instant) -> bool {
        let stays = lock(&self.stays).clone();
        let mut busy = false;
        for link in stays.into_iter().filter_map(|id| self.link(id)) {
            // Whoever holds the lock is not inside a handler; the next look comes soon.
            let Some(mut state) = link.try_lock() else {
                busy = true;
                continue;
            };
            let LinkState { reader, waiters, .. } = &mut *state;
            if reader.relieve(now, RELIEF, || pass_lead(waiters)) {
                self.settle(&link, state);
            } else {
                busy |= reader.is_busy();
            }
        }
        busy
    }
}
