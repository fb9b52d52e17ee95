//! One link as the threads share it: the session under its lock, the calls that wait, and which thread reads.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, OnceLock};
use std::task::Waker;
use std::thread::Thread;

use cara_core::distribution::failure::Failure;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::services::Port;
#[cfg(feature = "async")]
use cara_core::services::Ticket;
use cara_core::services::lease::ActuatorState;
use cara_core::services::requests::CallId;
use cara_core::time::{Duration, Instant};
use cara_secure::link::Cipher;
use core::net::SocketAddr;

use super::clocks::ClockWatch;
use super::details::Details;
use super::notices::Notices;
use super::peer_cell::PeerCell;
use super::reader::{ReadPolicy, Registration};
use super::tape::TapedSession;
use crate::locks::{Locked, Rank};
use crate::storage::Boxed;
use crate::sys::datagram::Datagrams;
use crate::sys::stream::Stream;
use crate::threads;

/// Linux, as the core's port.
pub(crate) enum Linux {}

impl Port for Linux {
    type Storage = Boxed;
    type Cipher = Cipher;
    type Endpoint = SocketAddr;
}

/// How long calls that use all slots hold up the bytes behind them after the last one has ended.
const STALLED: Duration = Duration::from_millis(20);

/// Bytes of sealed frames that wait for a stream at a time: three messages of 20,000 characters go out with one system
/// call. An emergency that is behind them in the stream has gone out as a datagram as well.
pub(super) const SEALED_AHEAD: usize = 64 * 1024;

/// One link of the unit.
pub(crate) struct LinkCell {
    /// The unit's number among those that its threads drive.
    unit_number: u16,
    pub(crate) id: LinkId,
    /// Tells this link from an earlier one with the same id.
    pub(crate) serial: u32,
    pub(crate) stream: Stream,
    pub(crate) peer: OnceLock<Arc<PeerCell>>,
    /// The peer has told what it offers.
    introduced: AtomicBool,
    /// The peer is subscribed to streams of this unit.
    subscribed: AtomicBool,
    state: Mutex<LinkState>,
    /// The stream took bytes, or the link ended.
    pub(crate) room: Condvar,
}

/// What the lock of a link protects.
pub(crate) struct LinkState {
    pub(crate) session: TapedSession,
    pub(crate) waiters: Vec<Waiter>,
    pub(crate) reading: ReadPolicy,
    /// What the epoll set has been told.
    pub(crate) registration: Registration,
    pub(crate) backlog: Backlog,
    /// The timer that is set for the session.
    pub(crate) timer: Instant,
    /// A thread or a task waits for the answer to a ping.
    pub(crate) pinging: bool,
    /// Tasks that wait for a change of the link, as threads wait at [`LinkCell::room`].
    tasks: Vec<Waker>,
    /// Of the peer's calls that tasks run, to be woken when the link ends.
    #[cfg(feature = "async")]
    serving: Vec<(Ticket, Waker)>,
    /// Wakers that are due. A waker may run code of an executor, so it waits until the link's lock has been given up.
    pub(crate) woken: Vec<Waker>,
    /// What it has counted is among the sums of links that have ended.
    pub(crate) retired: bool,
    pub(crate) notices: Notices,
    /// The state of what functions of the peer move, as far as it has told.
    pub(crate) actuators: BTreeMap<Slot, ActuatorState>,
    pub(crate) details: Details,
    /// The measurements of the peer's clock, where it offers that.
    pub(super) clock: Option<Box<ClockWatch>>,
}

/// Bytes that were read and cannot be looked at yet, because calls that wait leave no room for more.
pub(crate) struct Backlog {
    bytes: Vec<u8>,
    /// So many of them have been looked at.
    position: usize,
    /// When a call last ended, or there was no room for more of them.
    moved_at: Instant,
}

/// A call that waits for its reply.
pub(crate) struct Waiter {
    pub(crate) id: CallId,
    pub(crate) wake: Wake,
    pub(crate) outcome: Option<Outcome>,
    /// The newest progress that its caller has not heard.
    pub(crate) progress: Option<Box<ParametersView>>,
    /// What the service has said of its failure.
    pub(crate) failure: Option<Box<Failure>>,
}

impl Waiter {
    pub(crate) fn finish(&mut self, outcome: Outcome, woken: &mut Vec<Waker>) {
        self.outcome = Some(outcome);
        self.wake.wake(woken);
    }
}

/// How to wake the thread or the task of a call.
pub(crate) enum Wake {
    Thread(Thread),
    Task(Option<Waker>),
}

/// How a call ended: the function and the block of its results, or why there are none.
pub(crate) type Outcome = Result<(Slot, Generation, Box<[u8]>), Error>;

impl LinkCell {
    pub(crate) fn new(
        unit_number: u16,
        id: LinkId,
        serial: u32,
        stream: Stream,
        session: TapedSession,
        connecting: bool,
    ) -> Self {
        let state = LinkState {
            session,
            waiters: Vec::new(),
            reading: ReadPolicy::new(connecting),
            registration: Registration { readable: true, writable: connecting, is_out: false },
            backlog: Backlog { bytes: Vec::new(), position: 0, moved_at: Instant::START },
            timer: Instant::FAR_FUTURE,
            pinging: false,
            tasks: Vec::new(),
            #[cfg(feature = "async")]
            serving: Vec::new(),
            woken: Vec::new(),
            retired: false,
            notices: Notices::default(),
            actuators: BTreeMap::new(),
            details: Details::default(),
            clock: None,
        };
        Self {
            unit_number,
            id,
            serial,
            stream,
            peer: OnceLock::new(),
            introduced: AtomicBool::new(false),
            subscribed: AtomicBool::new(false),
            state: Mutex::new(state),
            room: Condvar::new(),
        }
    }

    /// Whether the peer is subscribed to streams of this unit, as it was told when the lock was given up last.
    pub(crate) fn has_subscriptions(&self) -> bool {
        self.subscribed.load(Ordering::SeqCst)
    }

    /// Notes whether it is.
    pub(super) fn note_subscriptions(&self, any: bool) {
        if self.subscribed.load(Ordering::Relaxed) != any {
            self.subscribed.store(any, Ordering::SeqCst);
        }
    }

    /// The peer has told what it offers.
    pub(crate) fn introduce(&self) {
        self.introduced.store(true, Ordering::Release);
    }

    /// Whether the peer has told what it offers.
    pub(crate) fn is_introduced(&self) -> bool {
        self.introduced.load(Ordering::Acquire)
    }

    /// The epoll token: unit, id and serial, so that an event of an earlier link with the same id is known.
    pub(crate) fn token(&self) -> u64 {
        threads::token(self.unit_number, u64::from(self.serial) << 16 | u64::from(self.id.0))
    }

    /// Handlers run outside of this lock, and no code under it leaves the state half changed.
    #[track_caller]
    pub(crate) fn lock(&self) -> Locked<'_, LinkState> {
        Rank::Link.lock(&self.state)
    }

    /// Holds the link up, from a test that goes on with the other end: two links of one unit are never locked.
    #[cfg(test)]
    pub(super) fn freeze(&self) -> std::sync::MutexGuard<'_, LinkState> {
        crate::locks::lock(&self.state)
    }

    /// What threads and tasks wait for may have come. The link is not locked by this thread.
    pub(crate) fn notify(&self) {
        let mut state = self.lock();
        state.wake_tasks();
        let woken = std::mem::take(&mut state.woken);
        drop(state);
        self.room.notify_all();
        woken.into_iter().for_each(Waker::wake);
    }

    /// The name of a function of the peer.
    pub(super) fn their_function(&self, slot: Slot) -> Option<String> {
        let state = self.lock();
        state.session.their_function_list().function(slot).map(|function| function.name().to_owned())
    }

    /// The state, unless a thread has it now.
    #[track_caller]
    pub(crate) fn try_lock(&self) -> Option<Locked<'_, LinkState>> {
        Rank::Link.try_lock(&self.state)
    }
}

impl LinkState {
    /// Bytes that were read cannot be processed yet, so nothing more is read, and TCP slows the peer down.
    pub(crate) fn is_paused(&self) -> bool {
        self.backlog.is_waiting()
    }

    /// Whether to stop processing what was read, because waiting calls use all slots: the bytes behind them stay unread, and
    /// TCP slows the peer down. Not while a call of this unit waits: its reply may be among these bytes, so they are
    /// processed, and requests without a slot are refused.
    pub(crate) fn holds_back(&self) -> bool {
        self.waiters.is_empty() && self.session.is_live() && !self.session.has_call_room()
    }

    /// A caller that waits for its reply, and could read the link for it.
    #[inline]
    pub(crate) fn next_reader(&self) -> Option<CallId> {
        let waits = |waiter: &&Waiter| waiter.outcome.is_none() && matches!(waiter.wake, Wake::Thread(_));
        self.waiters.iter().find(waits).map(|waiter| waiter.id)
    }

    /// Whether a call waits for its reply that does not read for it.
    #[inline]
    pub(crate) fn has_task(&self) -> bool {
        self.waiters.iter().any(|waiter| matches!(waiter.wake, Wake::Task(_)))
    }

    /// A call has been sent, and its reply is waited for.
    pub(crate) fn await_reply(&mut self, id: CallId, wake: Wake) {
        // One at a time is usual, and a list begins with room for four.
        self.waiters.reserve_exact(usize::from(self.waiters.is_empty()));
        self.waiters.push(Waiter { id, wake, outcome: None, progress: None, failure: None });
    }

    /// What waits for a call from here on, and what did before, to be dropped without the lock. `None` when nothing waits for it.
    pub(crate) fn await_reply_by(&mut self, id: CallId, wake: Wake) -> Option<Wake> {
        self.waiter(id).map(|waiter| std::mem::replace(&mut waiter.wake, wake))
    }

    pub(crate) fn waiter(&mut self, id: CallId) -> Option<&mut Waiter> {
        self.waiters.iter_mut().find(|waiter| waiter.id == id)
    }

    /// Notes why a call has no results and wakes what waits for it.
    pub(crate) fn fail(&mut self, id: CallId, error: Error) {
        if let Some(waiter) = self.waiters.iter_mut().find(|waiter| waiter.id == id) {
            waiter.finish(Err(error), &mut self.woken);
        }
        self.wake_tasks();
    }

    /// Wakes the thread or the task that waits for a call.
    pub(crate) fn wake(&mut self, id: CallId) {
        let woken = &mut self.woken;
        self.waiters.iter_mut().filter(|waiter| waiter.id == id).for_each(|waiter| waiter.wake.wake(woken));
    }

    /// Takes a call out that has ended.
    pub(crate) fn take_ended(&mut self, id: CallId) -> Option<Waiter> {
        let index = self.waiters.iter().position(|waiter| waiter.id == id && waiter.outcome.is_some())?;
        Some(self.waiters.swap_remove(index))
    }

    /// The newest progress of a call, once.
    pub(crate) fn take_progress(&mut self, id: CallId) -> Option<Box<ParametersView>> {
        self.waiter(id)?.progress.take()
    }

    /// Nothing waits for a call any more, and there may be room for another. What the service has said of its failure.
    pub(crate) fn forget(&mut self, id: CallId) -> Option<Box<Failure>> {
        let index = self.waiters.iter().position(|waiter| waiter.id == id)?;
        let Waiter { wake, failure, .. } = self.waiters.swap_remove(index);
        if let Wake::Task(Some(waker)) = wake {
            // Dropped under the lock, the last one of a task would run the end of that task's calls.
            self.woken.push(waker);
        }
        self.wake_tasks();
        failure
    }

    /// The task of `waker` looks again when the link has changed: room, a reply, an answer, its end.
    pub(crate) fn await_change(&mut self, waker: &Waker) {
        if !self.tasks.iter().any(|task| task.will_wake(waker)) {
            self.tasks.push(waker.clone());
        }
    }

    /// The task of `waker` runs a call of the peer, and looks again when the link has ended.
    #[cfg(feature = "async")]
    pub(crate) fn await_end(&mut self, call: Ticket, waker: &Waker) {
        match self.serving.iter_mut().find(|(known, _)| *known == call) {
            Some((_, known)) if known.will_wake(waker) => {}
            Some((_, known)) => self.woken.push(std::mem::replace(known, waker.clone())),
            None => self.serving.push((call, waker.clone())),
        }
    }

    /// That call has been answered.
    #[cfg(feature = "async")]
    pub(crate) fn await_no_end(&mut self, call: Ticket) {
        if let Some(index) = self.serving.iter().position(|(known, _)| *known == call) {
            self.woken.push(self.serving.swap_remove(index).1);
        }
    }

    /// The caller of a call that a task runs has given it up: the task looks again.
    #[cfg(feature = "async")]
    pub(crate) fn wake_serving(&mut self, call: Ticket) {
        self.woken.extend(self.serving.iter().filter(|(known, _)| *known == call).map(|(_, waker)| waker.clone()));
    }

    /// The link has ended: whatever waits for that, or for anything else of it, looks again.
    pub(crate) fn wake_all(&mut self) {
        self.wake_tasks();
        #[cfg(feature = "async")]
        self.woken.extend(self.serving.drain(..).map(|(_, waker)| waker));
    }

    /// The link has changed: tasks that wait for it look again, when the lock has been given up.
    #[inline]
    pub(crate) fn wake_tasks(&mut self) {
        if !self.tasks.is_empty() {
            self.woken.append(&mut self.tasks);
        }
    }
}

impl Backlog {
    pub(crate) fn is_waiting(&self) -> bool {
        self.position < self.bytes.len()
    }

    /// The calls that use all slots make no progress: the bytes behind them are to be processed.
    pub(crate) fn is_stalled(&self, now: Instant) -> bool {
        self.is_waiting() && now >= self.moved_at + STALLED
    }

    /// A call has ended, or the calls have just been found to make no progress.
    pub(crate) fn moved(&mut self, now: Instant) {
        self.moved_at = now;
    }

    /// The bytes, and how many of them have been looked at.
    pub(crate) fn take(&mut self) -> (Vec<u8>, usize) {
        (std::mem::take(&mut self.bytes), std::mem::take(&mut self.position))
    }

    /// Looked at up to `position`.
    pub(crate) fn put(&mut self, bytes: Vec<u8>, position: usize) {
        (self.bytes, self.position) = (bytes, position);
    }
}

impl Wake {
    /// Unparks the thread; the task's waker is left to the thread that gives the link's lock up.
    pub(super) fn wake(&mut self, woken: &mut Vec<Waker>) {
        match self {
            Self::Thread(thread) => thread.unpark(),
            Self::Task(waker) => woken.extend(waker.take()),
        }
    }
}

/// The port's `Mailman`, lent to the core for one call on one link, or for the node without a link.
pub(crate) struct StdMailman<'a> {
    pub(crate) stream: Option<&'a Stream>,
    pub(crate) datagrams: &'a Datagrams,
}

impl Mailman<SocketAddr> for StdMailman<'_> {
    fn write(&mut self, _link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.stream.map_or(Ok(0), |stream| stream.send(slices))
    }

    fn seals_ahead(&self) -> usize {
        SEALED_AHEAD
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        // The peer knows this end by the address of the stream, which need not be the host's first one.
        match self.stream.and_then(Stream::local_host) {
            Some(from) => self.datagrams.send_from(from, to, datagram),
            None => self.datagrams.send_to(to, datagram),
        }
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.datagrams.broadcast(datagram)
    }
}
