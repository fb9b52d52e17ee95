//! Times at which tasks are woken: a future has no thread that could wait, so the clock of its unit wakes it.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::task::Waker;

use cara_core::time::Instant;

use crate::locks::lock;

/// Names an alarm that is set: its time, and its number among all that were ever set.
pub(super) type Key = (Instant, u64);

/// The alarms of a unit, the earliest first. Each belongs to a future in the application's memory, which bounds them.
#[derive(Default)]
pub(super) struct Alarms(Mutex<Due>);

#[derive(Default)]
struct Due {
    wakers: BTreeMap<Key, Waker>,
    count: u64,
}

impl Alarms {
    pub(super) fn set(&self, at: Instant, waker: Waker) -> Key {
        let mut due = lock(&self.0);
        due.count += 1;
        let key = (at, due.count);
        due.wakers.insert(key, waker);
        key
    }

    /// Whether an alarm has not gone off, and is for this task.
    pub(super) fn is_set(&self, key: Key, waker: &Waker) -> bool {
        lock(&self.0).wakers.get(&key).is_some_and(|known| known.will_wake(waker))
    }

    /// The waker of an alarm that has not gone off, to be dropped without the lock.
    pub(super) fn cancel(&self, key: Key) -> Option<Waker> {
        lock(&self.0).wakers.remove(&key)
    }

    /// None goes off any more.
    pub(super) fn clear(&self) {
        let wakers = std::mem::take(&mut lock(&self.0).wakers);
        // Without the lock: a task that ends here cancels its own.
        drop(wakers);
    }

    /// When the next one goes off.
    pub(super) fn next(&self) -> Instant {
        lock(&self.0).wakers.first_key_value().map_or(Instant::FAR_FUTURE, |((at, _), _)| *at)
    }

    /// Wakes the tasks whose time has come; returns when the next one's does.
    pub(super) fn sound(&self, now: Instant) -> Instant {
        while let Some(waker) = self.take_due(now) {
            waker.wake();
        }
        self.next()
    }

    fn take_due(&self, now: Instant) -> Option<Waker> {
        let mut due = lock(&self.0);
        let first = due.wakers.first_entry().filter(|first| first.key().0 <= now)?;
        Some(first.remove())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::task::Wake;

    use super::*;

    #[derive(Default)]
    struct Count(AtomicUsize);

    impl Wake for Count {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::SeqCst);
        }
    }

    #[test]
    fn alarms_go_off_in_the_order_of_their_times_and_those_that_are_cancelled_do_not() {
        let (alarms, counts): (_, [Arc<Count>; 3]) = (Alarms::default(), Default::default());
        let at = Instant::from_micros;
        let keys: Vec<Key> = counts
            .iter()
            .zip([30, 10, 30])
            .map(|(count, micros)| alarms.set(at(micros), count.clone().into()))
            .collect();
        assert_eq!(alarms.next(), at(10));
        assert!(alarms.take_due(at(9)).is_none());
        alarms.take_due(at(30)).unwrap().wake();
        assert_eq!(counts.each_ref().map(|count| count.0.load(Ordering::SeqCst)), [0, 1, 0]);
        assert!(alarms.cancel(keys[0]).is_some() && alarms.cancel(keys[1]).is_none());
        alarms.take_due(at(30)).unwrap().wake();
        assert_eq!(counts.each_ref().map(|count| count.0.load(Ordering::SeqCst)), [0, 1, 1]);
        assert_eq!(alarms.next(), Instant::FAR_FUTURE);
    }
}
