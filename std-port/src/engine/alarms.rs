//! Times at which tasks are woken: a future has no thread that could wait, so the clock of its unit wakes it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::task::Waker;

use cara_core::time::Instant;

use super::Engine;
use crate::locks::lock;

/// Names an alarm that is set: its time, and its number among all that were ever set.
type Key = (Instant, u64);

/// The alarms of a unit, the earliest first. Each belongs to a future in the application's memory, which bounds them.
#[derive(Default)]
pub(super) struct Alarms(Mutex<Due>);

#[derive(Default)]
struct Due {
    wakers: BTreeMap<Key, Waker>,
    count: u64,
}

impl Alarms {
    fn set(&self, at: Instant, waker: Waker) -> Key {
        let mut due = lock(&self.0);
        due.count += 1;
        let key = (at, due.count);
        due.wakers.insert(key, waker);
        key
    }

    /// Whether an alarm has not gone off, and is for this task.
    fn is_set(&self, key: Key, waker: &Waker) -> bool {
        lock(&self.0).wakers.get(&key).is_some_and(|known| known.will_wake(waker))
    }

    /// The waker of an alarm that has not gone off, to be dropped without the lock.
    fn cancel(&self, key: Key) -> Option<Waker> {
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

    fn take_due(&self, now: Instant) -> Option<Waker> {
        let mut due = lock(&self.0);
        let first = due.wakers.first_entry().filter(|first| first.key().0 <= now)?;
        Some(first.remove())
    }
}

/// The alarm of one future: at most one is set at a time, and none is left when it is dropped.
pub(crate) struct Alarm<T: Send + 'static> {
    engine: Arc<Engine<T>>,
    key: Option<Key>,
}

impl<T: Send + 'static> Alarm<T> {
    pub(crate) const fn new(engine: Arc<Engine<T>>) -> Self {
        Self { engine, key: None }
    }

    /// Wakes the task at `at`, in place of an earlier alarm of this future.
    pub(crate) fn set(&mut self, at: Instant, waker: &Waker) {
        if self.key.is_some_and(|key| key.0 == at && self.engine.alarms.is_set(key, waker)) {
            return;
        }
        self.cancel();
        self.key = Some(self.engine.alarms.set(at, waker.clone()));
        self.engine.wake_clock_at(at);
    }

    fn cancel(&mut self) {
        if let Some(key) = self.key.take() {
            drop(self.engine.alarms.cancel(key));
        }
    }
}

impl<T: Send + 'static> Drop for Alarm<T> {
    fn drop(&mut self) {
        self.cancel();
    }
}

impl<T: Send + 'static> Engine<T> {
    /// Wakes the tasks whose time has come; returns when the next one's does.
    pub(super) fn sound_alarms(&self) -> Instant {
        let now = self.now();
        while let Some(waker) = self.alarms.take_due(now) {
            waker.wake();
        }
        self.alarms.next()
    }
}

#[cfg(test)]
mod tests {
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
