//! The unit among those that its threads drive: what wakes it, when its futures are woken, and how the threads let go of it.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::task::Waker;

use cara_core::time::{Duration, Instant};

use super::alarms::{Alarms, Key};
use super::sockets::Sockets;
use crate::clock::Clock;
use crate::error::{StartError, system_refused};
use crate::locks::lock;
use crate::sys::stream::Listener;
use crate::threads::{Driven, Source, ThreadPool, Threads};

/// The threads that drive the unit, and whether they do.
pub(crate) struct Driver {
    /// Its own, or those of several units.
    threads: Threads,
    clock: Clock,
    /// No other unit has them.
    own_threads: bool,
    /// The unit's number among those that the threads drive, once it has been started.
    unit_number: OnceLock<u16>,
    /// A manager looks for a live one of its identity before it starts.
    pub(super) asks_for_itself: bool,
    stopping: AtomicBool,
    /// How often its clock has done what was due.
    rounds: AtomicUsize,
    /// When the unit was made.
    born: Instant,
    pub(super) alarms: Alarms,
    /// When connections are taken again, where there were no descriptors for them.
    listens_at: Mutex<Option<Instant>>,
}

/// A unit for which there are no descriptors takes no connections for so long. Its clock goes on.
const PAUSE: Duration = Duration::from_millis(100);
/// How often a watchdog looks whether the clock has gone round.
const LOOK: std::time::Duration = std::time::Duration::from_millis(1);

impl Driver {
    pub(super) fn new(threads: Threads, own_threads: bool, asks_for_itself: bool) -> Self {
        let clock = threads.thread_pool().clock;
        Self {
            threads,
            clock,
            own_threads,
            unit_number: OnceLock::new(),
            asks_for_itself,
            stopping: AtomicBool::new(false),
            rounds: AtomicUsize::new(0),
            born: clock.now(),
            alarms: Alarms::default(),
            listens_at: Mutex::new(None),
        }
    }

    pub(crate) const fn clock(&self) -> Clock {
        self.clock
    }

    pub(super) const fn born(&self) -> Instant {
        self.born
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }

    /// The unit stops; whether it did already.
    pub(super) fn stop(&self) -> bool {
        self.stopping.swap(true, Ordering::AcqRel)
    }

    pub(super) fn pool(&self) -> &Arc<ThreadPool> {
        self.threads.thread_pool()
    }

    pub(crate) fn unit_number(&self) -> Option<u16> {
        self.unit_number.get().copied()
    }

    /// The threads do from here on what there is to do for the unit.
    pub(super) fn start(&self, unit: Arc<dyn Driven>, sockets: &Sockets) -> Result<(), StartError> {
        self.pool().start()?;
        let unit_number = self.pool().register(unit)?;
        let _ = self.unit_number.set(unit_number);
        let mut watched = sockets.sources().map(|(source, fd)| self.pool().watch(unit_number, source, fd));
        Ok(watched.try_for_each(|watched| watched).map_err(system_refused)?)
    }

    /// Something is to be done now, or the time of the next thing has changed.
    pub(super) fn wake(&self) {
        self.wake_at(Instant::START);
    }

    pub(super) fn wake_at(&self, at: Instant) {
        if let Some(unit_number) = self.unit_number() {
            self.pool().wake_at(unit_number, at);
        }
    }

    /// The clock has done what was due.
    pub(super) fn went_round(&self) {
        self.rounds.fetch_add(1, Ordering::Relaxed);
    }

    /// Wakes the clock; whether it has done what is due before this time is over.
    pub(crate) fn goes_round(&self, within: Duration) -> bool {
        let (before, until) = (self.rounds.load(Ordering::Relaxed), self.clock.now() + within);
        self.wake();
        while self.rounds.load(Ordering::Relaxed) == before {
            if self.clock.now() >= until {
                return false;
            }
            std::thread::sleep(LOOK);
        }
        true
    }

    /// Files and interfaces are looked at now.
    pub(super) fn wake_looker(&self) {
        if let Some(unit_number) = self.unit_number() {
            self.pool().wake_looker(unit_number);
        }
    }

    /// The unit takes no connections for a while.
    pub(super) fn pause_listening(&self, listener: &Listener) {
        self.pool().unwatch(listener);
        *lock(&self.listens_at) = Some(self.clock.now() + PAUSE);
    }

    /// Takes connections again when the pause is over; returns when that is.
    pub(super) fn go_on_listening(&self, sockets: &Sockets) -> Instant {
        let mut at = lock(&self.listens_at);
        match *at {
            Some(due) if due <= self.clock.now() => {
                if let Some((listener, unit_number)) = sockets.listener.as_ref().zip(self.unit_number())
                    && self.pool().watch(unit_number, Source::Listener, listener).is_err()
                {
                    let again = self.clock.now() + PAUSE;
                    *at = Some(again);
                    return again;
                }
                *at = None;
                Instant::FAR_FUTURE
            }
            Some(due) => due,
            None => Instant::FAR_FUTURE,
        }
    }

    /// From here on no thread works for the unit any more, except the one that calls. Then no thread puts a link on the
    /// clock's list, which `clear` empties.
    pub(super) fn release_threads(&self, sockets: &Sockets, clear: impl FnOnce() -> usize) {
        sockets.sources().for_each(|(_, fd)| self.pool().unwatch(fd));
        if let Some(unit_number) = self.unit_number() {
            self.pool().leave(unit_number);
        }
        self.pool().watched.fetch_sub(clear(), Ordering::Relaxed);
        if self.own_threads {
            self.pool().stop();
        }
    }
}

/// The alarm of one future: at most one is set at a time, and none is left when it is dropped.
pub(crate) struct Alarm {
    driver: Arc<Driver>,
    key: Option<Key>,
}

impl Alarm {
    pub(crate) const fn new(driver: Arc<Driver>) -> Self {
        Self { driver, key: None }
    }

    /// Wakes the task at `at`, in place of an earlier alarm of this future.
    pub(crate) fn set(&mut self, at: Instant, waker: &Waker) {
        if self.key.is_some_and(|key| key.0 == at && self.driver.alarms.is_set(key, waker)) {
            return;
        }
        self.cancel();
        self.key = Some(self.driver.alarms.set(at, waker.clone()));
        self.driver.wake_at(at);
    }

    fn cancel(&mut self) {
        if let Some(key) = self.key.take() {
            drop(self.driver.alarms.cancel(key));
        }
    }
}

impl Drop for Alarm {
    fn drop(&mut self) {
        self.cancel();
    }
}
