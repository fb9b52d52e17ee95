//! Which links the clock looks at, and when: those that are read by no thread for a moment, because a handler runs or a
//! caller is expected back. Run by the model of the hand-over as well, which is why locks and atomics come from outside.

use std::sync::PoisonError;

use cara_core::time::Instant;

use super::Mutex;
use super::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use super::reader::LOOK;

/// Threads of the pool that may stay on links of one unit.
const MOST_STAYING: usize = 4;

/// The clock's list of links. It looks as long as something happens that may need it, and need not be told of each call.
#[derive(Debug)]
pub(super) struct Watch {
    /// Something has happened since the clock last looked.
    used: AtomicBool,
    looking: AtomicBool,
    /// Tokens of the links, as the epoll set has them.
    links: Mutex<Vec<u64>>,
    /// When it looks next, for threads that put that off.
    next: AtomicU64,
    /// What is due beside links.
    others: AtomicU64,
    staying: AtomicUsize,
}

/// A thread of the pool stays on a link until this is dropped.
pub(super) struct Staying<'w>(&'w AtomicUsize);

impl Drop for Staying<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Watch {
    pub(super) fn new() -> Self {
        Self {
            used: AtomicBool::new(false),
            looking: AtomicBool::new(false),
            links: Mutex::new(Vec::new()),
            next: AtomicU64::new(u64::MAX),
            others: AtomicU64::new(u64::MAX),
            staying: AtomicUsize::new(0),
        }
    }

    /// Something happens. `true` where the clock must be told to look again.
    pub(super) fn begins(&self) -> bool {
        // Where it has been noted already, that thread has told the clock or found it looking.
        !self.used.swap(true, Ordering::SeqCst) && !self.looking.swap(true, Ordering::SeqCst)
    }

    /// Puts a link on the list; [`begins`](Self::begins) follows.
    pub(super) fn enlist(&self, link: u64) {
        self.links.lock().unwrap_or_else(PoisonError::into_inner).push(link);
    }

    /// Empties the list, when the unit stops; how many links there were.
    pub(super) fn clear(&self) -> usize {
        std::mem::take(&mut *self.links.lock().unwrap_or_else(PoisonError::into_inner)).len()
    }

    /// Looks at each link; `stays` tells whether it remains on the list. Whether the clock is to come back: if not,
    /// whatever happens next tells it to.
    pub(super) fn look(&self, mut stays: impl FnMut(u64) -> bool) -> bool {
        // Both before the list is read: a link that is added after this wakes the clock itself.
        self.looking.store(false, Ordering::SeqCst);
        let used = self.used.swap(false, Ordering::SeqCst);
        let mut links = std::mem::take(&mut *self.links.lock().unwrap_or_else(PoisonError::into_inner));
        // Without the list's lock, which is taken under that of a link.
        links.retain(|link| stays(*link));
        let again = used || !links.is_empty();
        self.links.lock().unwrap_or_else(PoisonError::into_inner).append(&mut links);
        if again {
            self.go_on();
        }
        again
    }

    /// The clock comes back without being told.
    pub(super) fn go_on(&self) {
        self.looking.store(true, Ordering::SeqCst);
    }

    pub(super) fn is_on(&self) -> bool {
        self.looking.load(Ordering::SeqCst)
    }

    /// One more thread stays on a link, unless as many do as may.
    pub(super) fn stay(&self) -> Option<Staying<'_>> {
        let more = |staying: usize| (staying < MOST_STAYING).then_some(staying + 1);
        let stays = self.staying.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
        stays.ok().map(|_| Staying(&self.staying))
    }

    /// The clock looks at `next`, and is about to wait for that or for `others`, which is due beside links.
    pub(super) fn set_next(&self, next: Instant, others: Instant) {
        self.others.store(others.as_micros(), Ordering::Relaxed);
        self.next.store(next.as_micros(), Ordering::Release);
    }

    pub(super) fn next(&self) -> Instant {
        Instant::from_micros(self.next.load(Ordering::Acquire))
    }

    pub(super) fn others(&self) -> Instant {
        Instant::from_micros(self.others.load(Ordering::Relaxed))
    }

    /// The next look is put off, unless the clock has looked meanwhile.
    pub(super) fn put_off(&self, from: Instant, to: Instant) {
        let _ = self.next.compare_exchange(from.as_micros(), to.as_micros(), Ordering::AcqRel, Ordering::Relaxed);
    }
}

/// The same moment for all units that share a clock, so that it wakes once for all of them.
pub(super) fn next_look(now: Instant) -> Instant {
    let every = LOOK.as_micros();
    Instant::from_micros((now.as_micros() / every + 1) * every)
}
