//! How many threads of a pool are inside handlers, and whether one more handler may begin.
//!
//! Some thread must always return to reading. That holds while another one waits in the epoll set. Without one, a
//! handler that has been quick may begin all the same, since starting a thread costs more than such a handler; should
//! it take long after all, the clock finds that no thread has come back and starts one. The clock has one slot more
//! than the others that start threads, so that it always can.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::locks::lock;
use cara_core::time::{Duration, Instant};

/// What the threads of a pool are about.
#[derive(Debug)]
pub(crate) struct Occupancy {
    occupied: AtomicUsize,
    /// How often a thread has come back to the epoll set.
    turns: AtomicUsize,
    /// The turns that the clock last saw, and when it first saw them.
    seen: Mutex<(usize, Instant)>,
}

/// A thread is inside a handler, or stays on a link, until this is dropped.
pub(crate) struct Occupied<'o>(&'o Occupancy);

impl Drop for Occupied<'_> {
    fn drop(&mut self) {
        self.0.occupied.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Occupancy {
    pub(crate) fn new() -> Self {
        Self { occupied: AtomicUsize::new(0), turns: AtomicUsize::new(0), seen: Mutex::new((0, Instant::START)) }
    }

    /// A thread enters a handler, or begins to stay on a link.
    pub(crate) fn enter(&self) -> Occupied<'_> {
        self.occupied.fetch_add(1, Ordering::AcqRel);
        Occupied(self)
    }

    /// Whether some thread of a pool of `most` is left after one more has entered a handler.
    pub(crate) fn leaves_one(&self, most: usize) -> bool {
        self.occupied.load(Ordering::Acquire) + 1 < most
    }

    /// A thread has come back to the epoll set.
    pub(crate) fn turn(&self) {
        self.turns.fetch_add(1, Ordering::Relaxed);
    }

    /// Whether handlers run and no thread has come back for `limit`; only a clock that looks regularly can tell.
    pub(crate) fn is_stuck(&self, now: Instant, limit: Duration) -> bool {
        let turns = self.turns.load(Ordering::Relaxed);
        let mut seen = lock(&self.seen);
        if seen.0 != turns || self.occupied.load(Ordering::Acquire) == 0 {
            *seen = (turns, now);
        }
        now >= seen.1 + limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_micros(10);

    fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    #[test]
    fn the_last_thread_is_left() {
        let occupancy = Occupancy::new();
        assert!(occupancy.leaves_one(3));
        let first = occupancy.enter();
        assert!(occupancy.leaves_one(3));
        let _second = occupancy.enter();
        assert!(!occupancy.leaves_one(3));
        drop(first);
        assert!(occupancy.leaves_one(3));
    }

    #[test]
    fn threads_are_stuck_when_none_of_them_has_come_back_for_long() {
        let occupancy = Occupancy::new();
        assert!(!occupancy.is_stuck(at(100), LIMIT));
        assert!(!occupancy.is_stuck(at(200), LIMIT), "no handler runs");
        let _occupied = occupancy.enter();
        assert!(!occupancy.is_stuck(at(209), LIMIT));
        occupancy.turn();
        assert!(!occupancy.is_stuck(at(215), LIMIT), "one has come back");
        assert!(!occupancy.is_stuck(at(224), LIMIT));
        assert!(occupancy.is_stuck(at(225), LIMIT));
        occupancy.turn();
        assert!(!occupancy.is_stuck(at(300), LIMIT));
    }
}
