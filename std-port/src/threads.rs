//! The threads that drive units: a pool that reads links and runs calls, and one that keeps time.
//!
//! A unit has threads of its own unless it is given [`Threads`] that several units of a process share. A token says
//! which unit an event is for, so that the units of a process wait in one epoll set.

use std::cell::Cell;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, OnceLock, PoisonError, RwLock};
use std::thread::JoinHandle;

use cara_core::error::Error;
use cara_core::time::{Duration, Instant};

use crate::clock::Clock;
use crate::engine::worker::Worker;
use crate::error::system_refused;
use crate::executor::Executor;
use crate::locks::{lock, read, write};
use crate::occupancy::Occupancy;
use crate::sys::alarm::Alarm;
use crate::sys::datagram::Socket;
use crate::sys::epoll::{Epoll, Events, Interest, Ready, Waker};
use crate::timers::Timers;

/// Threads of the pool to begin with.
const FIRST_WORKERS: usize = 2;
/// Most threads of a pool, but for the one that the clock starts when all of these are stuck in handlers.
const MOST_WORKERS: usize = 14;
/// Longest datagram that counts, and one byte more.
pub(crate) const DATAGRAM: usize = 2048;
/// The token of both wakers and of the alarm; no unit has this number.
const WAKER: u64 = u64::MAX;
/// The clock looks at the time this often at least.
const LONGEST_WAIT: Duration = Duration::from_millis(250);
/// The clock sleeps through less than this, and sets its alarm for more, which can be put off meanwhile.
const SHORTEST_ALARM: Duration = Duration::from_millis(1);
/// The thread that looks at files and interfaces looks at the time this often at least.
const LONGEST_LOOK: Duration = Duration::from_secs(1);
/// Events of sockets that are taken in one look.
const CLOCK_EVENTS: usize = 64;
/// Bits of a token below the unit's number: what the event is about.
const UNIT_SHIFT: u32 = 48;

/// Threads that several units of one process share: at most 18, however many units there are. Each safe hook and each
/// emergency service has one of its own besides.
///
/// For processes with many s_units, such as simulations of a fleet and gateways. The units also share a limit: if 14
/// handlers wait, calls of all units wait. Units whose handlers call each other need threads of their own, which is what
/// a unit has unless it is given these.
///
/// ```no_run
/// use cara_std::{Threads, Unit};
///
/// let threads = Threads::new()?;
/// for id in 0..1_000 {
///     let agv = Unit::builder("agv", id, "depot", 1)?.threads(&threads).build()?;
///     agv.start()?;
/// #   std::mem::forget(agv);
/// }
/// # Ok::<(), cara_std::BuildError>(())
/// ```
#[derive(Clone)]
pub struct Threads {
    owner: Arc<Owner>,
}

impl std::fmt::Debug for Threads {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Threads").field("running", &lock(&self.owner.thread_pool.threads).len()).finish()
    }
}

/// Ends the threads when the last unit and the last handle are gone.
struct Owner {
    thread_pool: Arc<ThreadPool>,
}

impl Drop for Owner {
    fn drop(&mut self) {
        self.thread_pool.stop();
    }
}

impl Threads {
    /// Threads for any number of units; they begin with the first unit that starts, and end with the last one.
    ///
    /// Raises the process's soft limit of open files to the hard one: an s_unit takes three.
    /// [`Error::Network`] where the system refuses descriptors for the threads themselves.
    pub fn new() -> Result<Self, Error> {
        crate::sys::limits::raise();
        Self::of_one()
    }

    /// Threads for one unit.
    pub(crate) fn of_one() -> Result<Self, Error> {
        ThreadPool::new()
            .map(|thread_pool| Self { owner: Arc::new(Owner { thread_pool: Arc::new(thread_pool) }) })
            .map_err(system_refused)
    }

    pub(crate) fn thread_pool(&self) -> &Arc<ThreadPool> {
        &self.owner.thread_pool
    }
}

/// What the threads do for a unit, whatever its application's state is.
pub(crate) trait Driven: Send + Sync {
    /// One of the unit's links can be read or written.
    fn ready(&self, ready: Ready, worker: &mut Worker);
    /// A call may begin on the link of a token.
    fn serve_waiting(&self, token: u64, worker: &mut Worker);
    /// Does what is due; returns when it is to be called again. It waits for nothing outside of the process.
    fn keep_time(&self) -> Instant;
    /// Looks at files and interfaces, which may take long; returns when to look again.
    fn look_around(&self) -> Instant;
    /// Datagrams have come.
    fn read_datagrams(&self, socket: Socket, buffer: &mut [u8]);
    /// Connections have come.
    fn accept(&self);
}

/// What a socket of a unit tells the clock's thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    Datagrams(Socket),
    Listener,
}

impl Source {
    const fn code(self) -> u64 {
        match self {
            Self::Datagrams(Socket::Shared) => 1,
            Self::Datagrams(Socket::Own) => 2,
            Self::Listener => 3,
        }
    }

    const fn of(token: u64) -> Self {
        match token & 0xff {
            1 => Self::Datagrams(Socket::Shared),
            2 => Self::Datagrams(Socket::Own),
            _ => Self::Listener,
        }
    }
}

/// A unit among those that the threads drive.
struct DrivenUnit {
    driven: Arc<dyn Driven>,
    /// Held for reading by each thread that is inside the unit; stopping the unit waits for them.
    gate: RwLock<()>,
}

thread_local! {
    /// The address of the thread pool whose clock this thread is.
    static CLOCK_OF: Cell<usize> = const { Cell::new(0) };
}

/// The threads themselves and what they share.
pub(crate) struct ThreadPool {
    pub(crate) clock: Clock,
    /// The links of all units.
    pub(crate) epoll: Epoll,
    clock_epoll: Epoll,
    clock_waker: Waker,
    pool_waker: Waker,
    units: RwLock<Vec<Option<Arc<DrivenUnit>>>>,
    /// When each unit's time has come.
    due: Mutex<Timers>,
    /// Wakes the clock for the first of them; set under the lock of `due`.
    alarm: Alarm,
    /// Links that a clock looks at: those that threads stay on, and those that are kept for callers.
    pub(crate) watched: AtomicUsize,
    /// Links with a call that may begin and that no thread runs yet.
    ready: Mutex<VecDeque<u64>>,
    /// Threads of the pool that wait for something to do.
    idle: AtomicUsize,
    workers: AtomicUsize,
    pub(crate) occupancy: Occupancy,
    /// Calls that the pool has read and served, to tell a few busy links from many.
    pub(crate) served: AtomicUsize,
    started: OnceLock<Result<(), Error>>,
    threads: Mutex<Vec<JoinHandle<()>>>,
    /// When files and interfaces are looked at next, for each unit.
    looks: (Mutex<Timers>, Condvar),
    /// Where emergencies run that are for no emergency service.
    executor: OnceLock<Arc<Executor>>,
    stopping: AtomicBool,
}

/// A unit's number and what the event is about, as an epoll set carries it.
pub(crate) const fn token(unit_number: u16, what: u64) -> u64 {
    ((unit_number as u64) << UNIT_SHIFT) | (what & ((1 << UNIT_SHIFT) - 1))
}

const fn unit_of(token: u64) -> u16 {
    (token >> UNIT_SHIFT) as u16
}

impl ThreadPool {
    fn new() -> std::io::Result<Self> {
        let (epoll, clock_epoll, pool_waker, clock_waker) =
            (Epoll::new()?, Epoll::new()?, Waker::new()?, Waker::new()?);
        epoll.add(&pool_waker, WAKER, Interest::READ_LEVEL)?;
        clock_epoll.add(&clock_waker, WAKER, Interest::READ_LEVEL)?;
        let alarm = Alarm::new()?;
        clock_epoll.add(&alarm, WAKER, Interest::READ_EDGE)?;
        Ok(Self {
            clock: Clock::new(),
            epoll,
            clock_epoll,
            clock_waker,
            pool_waker,
            units: RwLock::new(Vec::new()),
            due: Mutex::new(Timers::new()),
            alarm,
            watched: AtomicUsize::new(0),
            ready: Mutex::new(VecDeque::new()),
            idle: AtomicUsize::new(0),
            workers: AtomicUsize::new(0),
            occupancy: Occupancy::new(),
            served: AtomicUsize::new(0),
            started: OnceLock::new(),
            threads: Mutex::new(Vec::new()),
            looks: (Mutex::new(Timers::new()), Condvar::new()),
            executor: OnceLock::new(),
            stopping: AtomicBool::new(false),
        })
    }

    /// Gives a unit its number. Nothing happens to it before its sockets are watched and its clock is woken.
    pub(crate) fn register(&self, driven: Arc<dyn Driven>) -> Result<u16, Error> {
        let mut units = write(&self.units);
        let free = units.iter().position(Option::is_none).unwrap_or(units.len());
        let number = u16::try_from(free).ok().filter(|number| *number < u16::MAX).ok_or(Error::BadConstraint)?;
        let unit_number = Some(Arc::new(DrivenUnit { driven, gate: RwLock::new(()) }));
        match units.get_mut(free) {
            Some(place) => *place = unit_number,
            None => units.push(unit_number),
        }
        Ok(number)
    }

    /// Watches one of the unit's sockets.
    pub(crate) fn watch(&self, unit_number: u16, source: Source, fd: impl std::os::fd::AsFd) -> std::io::Result<()> {
        self.clock_epoll.add(fd, token(unit_number, source.code()), Interest::READ_LEVEL)
    }

    /// Watches a socket no more.
    pub(crate) fn unwatch(&self, fd: impl std::os::fd::AsFd) {
        let _ = self.clock_epoll.remove(fd);
    }

    /// The unit has something to do at `at`.
    pub(crate) fn wake_at(&self, unit_number: u16, at: Instant) {
        if lock(&self.due).bring_forward(u32::from(unit_number), at) && !self.keeps_time_here() {
            self.clock_waker.wake();
        }
    }

    /// What the unit was to do at `from` is put off until the time that `to` gives, without waking the clock. `None` where
    /// the unit has something else to do before, or the clock has begun.
    pub(crate) fn put_off(&self, unit_number: u16, from: Instant, to: impl FnOnce() -> Instant) -> Option<Instant> {
        let mut due = self.due.try_lock().ok()?;
        if due.deadline(u32::from(unit_number)) != Some(from) {
            return None;
        }
        // Under the lock: what comes to be due from here on brings the new time forward again.
        let to = to();
        let before = due.next();
        due.set(u32::from(unit_number), to);
        // Also where another unit comes first: `to` may be before its time.
        if let Some(next) = due.next().filter(|next| before != Some(*next)) {
            self.alarm.set(self.clock.boot_time_of(next));
        }
        Some(to)
    }

    /// This thread is the thread pool's clock, which looks at what is due before it next waits.
    fn keeps_time_here(&self) -> bool {
        CLOCK_OF.get() == std::ptr::from_ref(self).addr()
    }

    /// Leaves a link's calls to another thread of the pool.
    pub(crate) fn hand_over(&self, link: u64) {
        self.note_waiting(link);
        self.pool_waker.wake();
    }

    /// The same without waking a thread: the clock does where the call still waits when it looks.
    pub(crate) fn note_waiting(&self, link: u64) {
        let mut ready = lock(&self.ready);
        if !ready.contains(&link) {
            ready.push_back(link);
        }
    }

    /// Whether calls wait that no thread runs yet.
    pub(crate) fn has_waiting(&self) -> bool {
        !lock(&self.ready).is_empty()
    }

    /// Wakes a thread for calls that wait.
    pub(crate) fn wake_for_waiting(&self) {
        if self.has_waiting() {
            self.pool_waker.wake();
        }
    }

    /// Whether calls of other links wait and no thread of the pool is idle.
    pub(crate) fn others_wait(&self, link: u64) -> bool {
        !self.has_idle() && lock(&self.ready).iter().any(|ready| *ready != link)
    }

    /// Whether a thread of the pool waits for something to do.
    pub(crate) fn has_idle(&self) -> bool {
        self.idle.load(Ordering::Acquire) > 0
    }

    /// Whether a call may be run: another thread goes on reading.
    pub(crate) fn may_run(self: &Arc<Self>) -> bool {
        self.has_idle() || self.start_worker(MOST_WORKERS)
    }

    /// Whether a quick handler may be run while no thread waits: the clock can help if it takes long.
    pub(crate) fn may_run_quickly(&self) -> bool {
        self.occupancy.leaves_one(MOST_WORKERS)
    }

    /// Starts a thread if all have been inside handlers for `limit`; whether that may come to be.
    pub(crate) fn relieve(self: &Arc<Self>, now: Instant, limit: Duration) -> bool {
        if self.has_idle() {
            return false;
        }
        !self.occupancy.is_stuck(now, limit) || self.start_worker(MOST_WORKERS + 1)
    }

    /// Takes a unit out. When it returns no thread is inside the unit any more, except one of the thread pool that does it itself.
    pub(crate) fn leave(&self, unit_number: u16) {
        // Before the unit_number is free: the next one on it may set its time at once.
        lock(&self.due).cancel(u32::from(unit_number));
        lock(&self.looks.0).cancel(u32::from(unit_number));
        let place = write(&self.units).get_mut(usize::from(unit_number)).and_then(Option::take);
        if let Some(unit_number) = place.filter(|_| !self.is_own_thread()) {
            drop(write(&unit_number.gate));
        }
    }

    /// Starts the threads, once.
    pub(crate) fn start(self: &Arc<Self>) -> Result<(), Error> {
        *self.started.get_or_init(|| {
            let thread_pool = self.clone();
            let clock = std::thread::Builder::new().name("cara-clock".into());
            let clock = clock.spawn(move || thread_pool.keep_time()).map_err(system_refused)?;
            lock(&self.threads).push(clock);
            let thread_pool = self.clone();
            let looker = std::thread::Builder::new().name("cara-files".into());
            let looker = looker.spawn(move || thread_pool.look_around()).map_err(system_refused)?;
            lock(&self.threads).push(looker);
            let _ = self.executor.set(Arc::new(Executor::start("cara-emergency")?));
            if (0..FIRST_WORKERS).all(|_| self.start_worker(MOST_WORKERS)) { Ok(()) } else { Err(Error::Network) }
        })
    }

    fn start_worker(self: &Arc<Self>, most: usize) -> bool {
        let started = self.workers.fetch_add(1, Ordering::AcqRel) < most;
        let thread_pool = self.clone();
        let thread = std::thread::Builder::new().name("cara-pool".into());
        match started.then(|| thread.spawn(move || thread_pool.work())) {
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

    fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }

    fn is_own_thread(&self) -> bool {
        let own = std::thread::current().id();
        lock(&self.threads).iter().any(|thread| thread.thread().id() == own)
    }

    pub(crate) fn executor(&self) -> Option<Arc<Executor>> {
        self.executor.get().cloned()
    }

    /// Ends all threads, and waits for it unless one of them calls.
    pub(crate) fn stop(&self) {
        if self.stopping.swap(true, Ordering::AcqRel) {
            return;
        }
        self.clock_waker.wake();
        self.pool_waker.wake();
        // Under the lock: the looker has seen that the thread pool stops, or waits.
        drop(lock(&self.looks.0));
        self.looks.1.notify_all();
        let own = self.is_own_thread();
        let threads = std::mem::take(&mut *lock(&self.threads));
        // A handler that stops its unit does not wait for the others: one of them may wait for it.
        if !own {
            if let Some(executor) = self.executor.get() {
                executor.end();
            }
            threads.into_iter().for_each(|thread| drop(thread.join()));
        }
    }

    /// Does something in the unit that a token means, unless it is gone or going.
    fn enter<R>(&self, token: u64, act: impl FnOnce(&dyn Driven) -> R) -> Option<R> {
        let unit_number = read(&self.units).get(usize::from(unit_of(token))).cloned().flatten()?;
        let _inside = match unit_number.gate.try_read() {
            Ok(inside) => inside,
            Err(std::sync::TryLockError::Poisoned(poisoned)) => PoisonError::into_inner(poisoned),
            Err(std::sync::TryLockError::WouldBlock) => return None,
        };
        Some(act(&*unit_number.driven))
    }

    fn work(self: Arc<Self>) {
        let mut events = Events::new(1);
        let mut worker = Worker::new();
        while !self.is_stopping() {
            self.idle.fetch_add(1, Ordering::AcqRel);
            let waited = self.epoll.wait(&mut events, None);
            self.idle.fetch_sub(1, Ordering::AcqRel);
            self.occupancy.turn();
            if let Err(error) = waited {
                tracing::error!(%error, "waiting for links failed");
                return;
            }
            match events.iter().next() {
                // While the thread pool stops, the waker stays set, so that every thread wakes.
                Some(ready) if ready.token == WAKER && self.is_stopping() => return,
                Some(ready) if ready.token == WAKER => {
                    self.pool_waker.reset();
                }
                Some(ready) => drop(self.enter(ready.token, |driven| driven.ready(ready, &mut worker))),
                None => {}
            }
            self.serve_waiting(&mut worker);
        }
    }

    /// Runs the calls of links that no thread has run yet.
    fn serve_waiting(self: &Arc<Self>, worker: &mut Worker) {
        while let Some(link) = self.take_ready() {
            self.enter(link, |driven| driven.serve_waiting(link, worker));
        }
    }

    fn take_ready(self: &Arc<Self>) -> Option<u64> {
        let mut ready = lock(&self.ready);
        if ready.is_empty() || !self.may_run() {
            return None;
        }
        ready.pop_front()
    }

    /// The thread that looks at files and interfaces looks at those of this unit now.
    pub(crate) fn wake_looker(&self, unit_number: u16) {
        lock(&self.looks.0).bring_forward(u32::from(unit_number), Instant::START);
        self.looks.1.notify_all();
    }

    /// One unit at a time, each when it is due: where a thousand units start, a look at all for each would be a million.
    fn look_around(&self) {
        while let Some(unit_number) = self.wait_for_look() {
            if let Some(next) = self.enter(token(unit_number, 0), |driven| driven.look_around()) {
                lock(&self.looks.0).bring_forward(u32::from(unit_number), next);
            }
        }
    }

    /// The unit whose files and interfaces are to be looked at; `None` when the thread pool stops.
    fn wait_for_look(&self) -> Option<u16> {
        let mut looks = lock(&self.looks.0);
        while !self.is_stopping() {
            let now = self.clock.now();
            if let Some(unit_number) = looks.pop_due(now) {
                return Some(unit_number as u16);
            }
            let wait = looks.next().unwrap_or(Instant::FAR_FUTURE).since(now).min(LONGEST_LOOK);
            looks = self.looks.1.wait_timeout(looks, wait.into()).unwrap_or_else(PoisonError::into_inner).0;
        }
        None
    }

    fn keep_time(&self) {
        CLOCK_OF.set(std::ptr::from_ref(self).addr());
        let mut events = Events::new(CLOCK_EVENTS);
        let mut buffer = vec![0; DATAGRAM];
        while !self.is_stopping() {
            let wait = self.poll_due();
            if let Err(error) = self.clock_epoll.wait(&mut events, Some(wait)) {
                tracing::error!(%error, "waiting for time failed");
                return;
            }
            for ready in events.iter() {
                if ready.token == WAKER {
                    self.clock_waker.reset();
                    continue;
                }
                self.enter(ready.token, |driven| match Source::of(ready.token) {
                    Source::Datagrams(socket) => driven.read_datagrams(socket, &mut buffer),
                    Source::Listener => driven.accept(),
                });
                // What was read may be acted upon at once.
                lock(&self.due).bring_forward(u32::from(unit_of(ready.token)), Instant::START);
            }
        }
    }

    /// Lets every unit whose time has come do what is due; returns how long to wait at most for the next one's.
    fn poll_due(&self) -> Duration {
        loop {
            let unit_number = {
                let mut due = lock(&self.due);
                let now = self.clock.now();
                match due.pop_due(now) {
                    Some(unit_number) => unit_number as u16,
                    None => return self.set_alarm(now, due.next().unwrap_or(Instant::FAR_FUTURE)),
                }
            };
            if let Some(next) = self.enter(token(unit_number, 0), |driven| driven.keep_time()) {
                lock(&self.due).bring_forward(u32::from(unit_number), next);
            }
        }
    }

    /// Sets the alarm for what is due first; returns how long to wait at most. The wait itself stands still while the system
    /// is suspended, and the alarm goes on.
    fn set_alarm(&self, now: Instant, first: Instant) -> Duration {
        let left = first.since(now);
        if left < SHORTEST_ALARM {
            return left;
        }
        if left < LONGEST_WAIT {
            self.alarm.set(self.clock.boot_time_of(first));
        }
        LONGEST_WAIT
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::until;

    /// Counts what it is asked to do, and waits in it as long as the gate is closed.
    #[derive(Default)]
    struct Counting {
        polls: AtomicUsize,
        looks: AtomicUsize,
        closed: Mutex<()>,
    }

    impl Driven for Counting {
        fn ready(&self, _: Ready, _: &mut Worker) {}
        fn serve_waiting(&self, _: u64, _: &mut Worker) {}
        fn keep_time(&self) -> Instant {
            self.polls.fetch_add(1, Ordering::SeqCst);
            drop(lock(&self.closed));
            Instant::FAR_FUTURE
        }
        fn look_around(&self) -> Instant {
            self.looks.fetch_add(1, Ordering::SeqCst);
            Instant::FAR_FUTURE
        }
        fn read_datagrams(&self, _: Socket, _: &mut [u8]) {}
        fn accept(&self) {}
    }

    #[test]
    fn tokens_keep_unit_and_meaning_apart() {
        let longest = (u64::from(u32::MAX) << 16) | u64::from(u16::MAX);
        assert_eq!(unit_of(token(7, longest)), 7);
        assert_eq!(token(7, longest) & ((1 << UNIT_SHIFT) - 1), longest);
        for source in [Source::Datagrams(Socket::Shared), Source::Datagrams(Socket::Own), Source::Listener] {
            assert_eq!(Source::of(token(65_534, source.code())), source);
        }
    }

    #[test]
    fn a_unit_is_polled_when_its_time_comes_and_not_after_it_left() {
        let threads = Threads::new().unwrap();
        let thread_pool = threads.thread_pool();
        thread_pool.start().unwrap();
        let (first, second) = (Arc::new(Counting::default()), Arc::new(Counting::default()));
        let units = [&first, &second].map(|unit| thread_pool.register(unit.clone()).unwrap());
        assert_eq!(units, [0, 1]);
        thread_pool.wake_at(1, thread_pool.clock.now());
        until(|| second.polls.load(Ordering::SeqCst) == 1);
        thread_pool.leave(1);
        thread_pool.wake_at(1, Instant::START);
        thread_pool.wake_at(0, Instant::START);
        until(|| first.polls.load(Ordering::SeqCst) == 1);
        assert_eq!(second.polls.load(Ordering::SeqCst), 1);
        assert_eq!(Arc::strong_count(&second), 1, "a unit that has left is held no more");
        assert_eq!(thread_pool.register(second).unwrap(), 1, "its number is free again");
    }

    #[test]
    fn only_what_a_unit_waits_for_is_put_off() {
        let threads = Threads::new().unwrap();
        let thread_pool = threads.thread_pool();
        let at = |seconds| thread_pool.clock.now() + Duration::from_secs(seconds);
        let (look, later, between) = (at(100), at(300), at(200));
        thread_pool.wake_at(4, look);
        assert_eq!(thread_pool.put_off(4, between, || later), None, "it waits for something else");
        assert_eq!(thread_pool.put_off(4, look, || later), Some(later));
        assert_eq!(thread_pool.put_off(4, look, || later), None, "it was put off already");
        thread_pool.wake_at(4, between);
        assert_eq!(thread_pool.put_off(4, later, || later), None, "something is due before");
        assert_eq!(lock(&thread_pool.due).next(), Some(between));
    }

    /// The clock waits with the alarm set to what is due first, and is not woken.
    #[test]
    fn the_alarm_is_set_to_what_is_due_first_whichever_unit_it_is_for() {
        let threads = Threads::new().unwrap();
        let thread_pool = threads.thread_pool();
        let (hour, now) = (Duration::from_secs(3_600), thread_pool.clock.now());
        let (first, later) = (now + hour, now + hour + hour);
        for (unit_number, at) in [(1, first), (4, later)] {
            thread_pool.wake_at(unit_number, at);
        }
        thread_pool.clock_waker.reset();
        let goes_off = |within: Duration| {
            let mut events = Events::new(1);
            thread_pool.clock_epoll.wait(&mut events, Some(within)).unwrap();
            events.iter().next().is_some()
        };
        assert!(!goes_off(Duration::ZERO));
        let soon = thread_pool.clock.now() + Duration::from_millis(20);
        assert_eq!(thread_pool.put_off(4, later, || soon), Some(soon));
        assert!(goes_off(Duration::from_secs(20)), "unit 4 is due before unit 1, and the alarm is not set");
        assert_eq!(thread_pool.put_off(4, soon, || later), Some(later));
        assert_eq!(thread_pool.put_off(1, first, || later + hour), Some(later + hour));
        assert!(!goes_off(Duration::from_millis(40)), "both are put off");
    }

    /// The work of a thousand starts is that of a thousand looks, and not of a million.
    #[test]
    fn a_unit_that_starts_is_looked_at_alone() {
        let threads = Threads::new().unwrap();
        let thread_pool = threads.thread_pool();
        thread_pool.start().unwrap();
        let units: [Arc<Counting>; 20] = Default::default();
        for unit in &units {
            thread_pool.wake_looker(thread_pool.register(unit.clone()).unwrap());
            until(|| unit.looks.load(Ordering::SeqCst) > 0);
        }
        assert_eq!(units.map(|unit| unit.looks.load(Ordering::SeqCst)), [1; 20]);
    }

    #[test]
    fn leaving_waits_for_the_threads_that_are_inside() {
        let threads = Threads::new().unwrap();
        let thread_pool = threads.thread_pool();
        thread_pool.start().unwrap();
        let unit = Arc::new(Counting::default());
        let unit_number = thread_pool.register(unit.clone()).unwrap();
        let inside = lock(&unit.closed);
        thread_pool.wake_at(unit_number, Instant::START);
        until(|| unit.polls.load(Ordering::SeqCst) == 1);
        let left = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                thread_pool.leave(unit_number);
                left.store(true, Ordering::SeqCst);
            });
            until(|| read(&thread_pool.units).iter().all(Option::is_none));
            std::thread::sleep(std::time::Duration::from_millis(20));
            assert!(!left.load(Ordering::SeqCst));
            drop(inside);
        });
        assert!(left.load(Ordering::SeqCst));
    }
}
