//! The bounded pool of full message buffers that all links of a unit share.
//!
//! Buffers are allocated when they are first asked for and kept only up to a few: a unit with a thousand idle links
//! holds no more than one with ten. When all are in use, `take` answers `None`, and the link that asked stops reading.

use std::sync::{Mutex, MutexGuard, PoisonError};

use cara_core::storage::Buffers;

use crate::storage::{Boxed, filled};

/// Buffers of one size, at most `capacity` in use at a time; shared by all threads of a unit.
#[derive(Debug)]
pub(crate) struct MessagePool {
    state: Mutex<State>,
    capacity: usize,
    keep: usize,
}

#[derive(Debug)]
struct State {
    /// The last buffer given back is the first one taken: its memory is the warmest.
    idle: Vec<Box<[u8]>>,
    size: usize,
    in_use: usize,
    peak: usize,
    exhausted: u64,
}

/// What a pool has done so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PoolCounters {
    /// Buffers that are out now.
    pub in_use: usize,
    /// Most buffers that were out at one time.
    pub peak: usize,
    /// Buffers that are kept for the next `take`.
    pub idle: usize,
    /// How often all buffers were out when one was asked for.
    pub exhausted: u64,
}

impl MessagePool {
    /// A pool of at most `capacity` buffers of `size` bytes, which keeps at most `keep` of them while idle.
    pub(crate) fn new(size: usize, capacity: usize, keep: usize) -> Self {
        let state = State { idle: Vec::new(), size, in_use: 0, peak: 0, exhausted: 0 };
        Self { state: Mutex::new(state), capacity, keep }
    }

    /// Takes a buffer of zeros or of an earlier message's bytes; `None` when `capacity` are out.
    pub(crate) fn take(&self) -> Option<Box<[u8]>> {
        self.take_leaving(0)
    }

    /// Takes a buffer if `left` others may still be taken after it.
    pub(crate) fn take_leaving(&self, left: usize) -> Option<Box<[u8]>> {
        let mut state = self.lock();
        if state.in_use.saturating_add(left) >= self.capacity {
            state.exhausted = state.exhausted.saturating_add(1);
            return None;
        }
        state.in_use += 1;
        state.peak = state.peak.max(state.in_use);
        let size = state.size;
        if let Some(buffer) = state.idle.pop() {
            return Some(buffer);
        }
        drop(state); // Another thread need not wait for the allocation.
        Some(filled(size, 0))
    }

    /// Gives a buffer back; it is freed when enough are kept, or when the size has changed since.
    pub(crate) fn give(&self, buffer: Box<[u8]>) {
        let mut state = self.lock();
        state.in_use = state.in_use.saturating_sub(1);
        if state.idle.len() < self.keep && buffer.len() == state.size {
            state.idle.push(buffer);
            return;
        }
        drop(state);
        drop(buffer);
    }

    /// Changes the size of the buffers that are taken from now on; those that are out keep theirs.
    pub(crate) fn resize(&self, size: usize) {
        let mut state = self.lock();
        if state.size != size {
            state.size = size;
            state.idle.clear();
        }
    }

    /// Frees every buffer that is kept. For a unit that has been idle for a while.
    pub(crate) fn shrink(&self) {
        self.lock().idle = Vec::new();
    }

    /// The counters as they are now.
    pub(crate) fn counters(&self) -> PoolCounters {
        let state = self.lock();
        PoolCounters { in_use: state.in_use, peak: state.peak, idle: state.idle.len(), exhausted: state.exhausted }
    }

    /// No code that runs under this lock can leave the state half changed, so a poisoned lock is as good as any.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Buffers<Boxed> for &MessagePool {
    fn take(&mut self) -> Option<Box<[u8]>> {
        MessagePool::take(self)
    }

    fn give(&mut self, buffer: Box<[u8]>) {
        MessagePool::give(self, buffer);
    }

    fn take_leaving(&mut self, left: usize) -> Option<Box<[u8]>> {
        MessagePool::take_leaving(self, left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pool_is_bounded_and_counts() {
        let pool = MessagePool::new(16, 2, 1);
        assert_eq!(pool.counters(), PoolCounters { in_use: 0, peak: 0, idle: 0, exhausted: 0 });
        let first = pool.take().unwrap();
        let second = pool.take().unwrap();
        assert_eq!((first.len(), second.len()), (16, 16));
        assert!(pool.take().is_none());
        pool.give(first);
        pool.give(second);
        assert_eq!(pool.counters(), PoolCounters { in_use: 0, peak: 2, idle: 1, exhausted: 1 });
        assert!(pool.take().is_some());
    }

    #[test]
    fn the_last_buffer_given_is_the_first_one_taken() {
        let pool = MessagePool::new(1, 2, 2);
        let (mut first, mut second) = (pool.take().unwrap(), pool.take().unwrap());
        (first[0], second[0]) = (1, 2);
        pool.give(first);
        pool.give(second);
        assert_eq!(*pool.take().unwrap(), [2]);
        assert_eq!(*pool.take().unwrap(), [1]);
    }

    #[test]
    fn a_buffer_of_an_earlier_size_is_not_handed_out_again() {
        let pool = MessagePool::new(16, 4, 4);
        let old = pool.take().unwrap();
        pool.give(pool.take().unwrap());
        pool.resize(32);
        pool.give(old);
        assert_eq!(pool.counters().idle, 0);
        assert_eq!(pool.take().unwrap().len(), 32);
    }

    /// Those of the earlier size that come back make room as any other.
    #[test]
    fn a_resize_costs_no_room() {
        let pool = MessagePool::new(16, 2, 2);
        for size in [32, 16, 64] {
            let out = [pool.take().unwrap(), pool.take().unwrap()];
            pool.resize(size);
            assert!(pool.take().is_none());
            out.into_iter().for_each(|buffer| pool.give(buffer));
            assert_eq!((pool.counters().in_use, pool.counters().idle), (0, 0));
        }
    }

    #[test]
    fn an_idle_pool_can_be_emptied() {
        let pool = MessagePool::new(16, 4, 4);
        pool.give(pool.take().unwrap());
        assert_eq!(pool.counters().idle, 1);
        pool.shrink();
        assert_eq!(pool.counters().idle, 0);
    }

    #[test]
    fn threads_never_hold_more_than_the_capacity() {
        let pool = MessagePool::new(8, 3, 2);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    let mut buffers = &pool;
                    for _ in 0..1_000 {
                        if let Some(buffer) = Buffers::take(&mut buffers) {
                            Buffers::give(&mut buffers, buffer);
                        }
                    }
                });
            }
        });
        let counters = pool.counters();
        assert_eq!(counters.in_use, 0);
        assert!((1..=3).contains(&counters.peak), "{counters:?}");
        assert!(counters.idle <= 2, "{counters:?}");
    }
}
