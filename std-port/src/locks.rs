//! Taking locks: poisoned ones as well, since no code under a lock leaves what it protects half changed, and those of a
//! unit in one order, which a debug build asserts each time.

use std::ops::{Deref, DerefMut};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard, TryLockError};

use cara_core::time::Duration;

/// The locks of a unit in the order in which a thread may take them; never two of one rank, so never two links. What a
/// module of its own locks for a moment, and takes nothing under, has no rank: [`lock`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Rank {
    /// The sums of what links have counted.
    Accounts,
    /// The table of links.
    Links,
    /// One link.
    Link,
    /// The unit's own functions.
    Functions,
    /// The node and what it publishes.
    Hub,
    /// Peers, timers, keys, subscribers: no lock of this list is taken under one of these.
    Leaf,
}

/// A lock that is held, and its rank.
pub(crate) struct Held<G> {
    // Before the mark, so that the lock is given up first.
    guard: G,
    mark: Mark,
}

/// What a link's lock protects.
pub(crate) type Locked<'l, V> = Held<MutexGuard<'l, V>>;

impl<G> Held<G> {
    /// Marks the rank, then waits for the lock: an order that is wrong is found also where no other thread is in the way.
    #[track_caller]
    fn new(rank: Rank, take: impl FnOnce() -> G) -> Self {
        let mark = Mark::new(rank);
        Self { guard: take(), mark }
    }
}

impl<V> Held<MutexGuard<'_, V>> {
    /// Gives the lock up until `changed` is notified, or for so long.
    pub(crate) fn wait(self, changed: &Condvar, at_most: Duration) -> Self {
        let Self { guard, mark } = self;
        let waited = changed.wait_timeout(guard, at_most.into());
        Self { guard: waited.unwrap_or_else(PoisonError::into_inner).0, mark }
    }
}

impl<G: Deref> Deref for Held<G> {
    type Target = G::Target;
    fn deref(&self) -> &G::Target {
        &self.guard
    }
}

impl<G: DerefMut> DerefMut for Held<G> {
    fn deref_mut(&mut self) -> &mut G::Target {
        &mut self.guard
    }
}

impl Rank {
    #[track_caller]
    pub(crate) fn lock<V>(self, mutex: &Mutex<V>) -> Held<MutexGuard<'_, V>> {
        Held::new(self, || lock(mutex))
    }

    /// `None` where another thread has it.
    #[track_caller]
    pub(crate) fn try_lock<V>(self, mutex: &Mutex<V>) -> Option<Held<MutexGuard<'_, V>>> {
        let guard = match mutex.try_lock() {
            Ok(guard) => guard,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return None,
        };
        Some(Held::new(self, || guard))
    }

    #[track_caller]
    pub(crate) fn read<V>(self, lock: &RwLock<V>) -> Held<RwLockReadGuard<'_, V>> {
        Held::new(self, || read(lock))
    }

    #[track_caller]
    pub(crate) fn write<V>(self, lock: &RwLock<V>) -> Held<RwLockWriteGuard<'_, V>> {
        Held::new(self, || write(lock))
    }
}

/// That this thread holds a lock of a rank; nothing in a release build.
#[cfg(not(debug_assertions))]
struct Mark;

#[cfg(not(debug_assertions))]
impl Mark {
    const fn new(_: Rank) -> Self {
        Self
    }
}

#[cfg(debug_assertions)]
struct Mark(Rank);

#[cfg(debug_assertions)]
thread_local! {
    /// A bit for each rank of which this thread holds a lock.
    static HELD: std::cell::Cell<u8> = const { std::cell::Cell::new(0) };
}

#[cfg(debug_assertions)]
impl Mark {
    #[track_caller]
    fn new(rank: Rank) -> Self {
        let held = HELD.get();
        assert!(held >> rank as u8 == 0, "a lock of rank {rank:?} is taken under one that comes later: {held:#b}");
        HELD.set(held | 1 << rank as u8);
        Self(rank)
    }
}

#[cfg(debug_assertions)]
impl Drop for Mark {
    fn drop(&mut self) {
        HELD.set(HELD.get() & !(1 << self.0 as u8));
    }
}

/// A lock that is taken for a moment, and under which no other is.
pub(crate) fn lock<V>(mutex: &Mutex<V>) -> MutexGuard<'_, V> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn read<V>(lock: &RwLock<V>) -> RwLockReadGuard<'_, V> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn write<V>(lock: &RwLock<V>) -> RwLockWriteGuard<'_, V> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn locks_are_taken_in_order_and_given_up_in_any() {
        let (link, hub) = (Mutex::new(1), RwLock::new(2));
        let first = Rank::Link.lock(&link);
        let second = Rank::Hub.read(&hub);
        drop(first);
        assert_eq!(*second, 2);
        drop(second);
        assert_eq!(*Rank::Link.lock(&link), 1);
    }

    #[test]
    #[cfg(debug_assertions)]
    fn a_lock_out_of_order_is_found_though_it_is_free() {
        let (links, hub) = ([Mutex::new(()), Mutex::new(())], Mutex::new(()));
        let fails = |first: Rank, second: Rank| {
            let out_of_order = || {
                let _first = first.lock(&hub);
                drop(second.lock(&links[0]));
            };
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(out_of_order)).is_err()
        };
        assert!(fails(Rank::Hub, Rank::Link));
        assert!(fails(Rank::Link, Rank::Link), "two links");
        assert!(!fails(Rank::Link, Rank::Hub));
    }
}
