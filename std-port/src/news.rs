//! Lets threads and tasks wait until something has happened to a unit, for those that then look for themselves at what it was.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::task::Waker;

use crate::locks::lock;
use cara_core::time::Duration;

/// How many events there have been.
#[derive(Debug, Default)]
pub(crate) struct News {
    count: Mutex<u64>,
    more: Condvar,
    /// Of the tasks that wait, each with the number of its wait.
    tasks: Mutex<Vec<(u64, Waker)>>,
}

impl News {
    /// So many events until now.
    pub(crate) fn count(&self) -> u64 {
        *self.lock()
    }

    /// One more: every thread that waits looks again.
    pub(crate) fn add(&self) {
        let mut count = self.lock();
        *count = count.wrapping_add(1);
        self.more.notify_all();
        drop(count);
        let tasks = std::mem::take(&mut *lock(&self.tasks));
        tasks.into_iter().for_each(|(_, task)| task.wake());
    }

    /// Waits until there are others than those that were `seen`, or for `left`. Returns how many there are.
    pub(crate) fn wait(&self, seen: u64, left: Duration) -> u64 {
        let waited = self.more.wait_timeout_while(self.lock(), left.into(), |count| *count == seen);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Has a task woken by whatever is added from here on, in place of an earlier waker of the same wait.
    #[cfg(feature = "async")]
    pub(crate) fn await_more(&self, wait: u64, waker: &Waker) {
        let mut tasks = lock(&self.tasks);
        let earlier = match tasks.iter_mut().find(|(known, _)| *known == wait) {
            Some((_, known)) if known.will_wake(waker) => return,
            Some((_, known)) => Some(std::mem::replace(known, waker.clone())),
            None => {
                tasks.push((wait, waker.clone()));
                None
            }
        };
        // A waker that is dropped may end a task, which ends its own wait here.
        drop(tasks);
        drop(earlier);
    }

    /// That wait is over.
    #[cfg(feature = "async")]
    pub(crate) fn await_no_more(&self, wait: u64) {
        let mut tasks = lock(&self.tasks);
        let index = tasks.iter().position(|(known, _)| *known == wait);
        let ended = index.map(|index| tasks.swap_remove(index));
        drop(tasks);
        drop(ended);
    }

    fn lock(&self) -> MutexGuard<'_, u64> {
        self.count.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_happens_between_the_look_and_the_wait_is_not_missed() {
        let news = News::default();
        let seen = news.count();
        news.add();
        assert_eq!(news.wait(seen, Duration::MAX), seen + 1);
    }

    #[test]
    fn a_thread_that_waits_is_woken() {
        let news = News::default();
        let seen = news.count();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| news.wait(seen, Duration::MAX));
            news.add();
            assert_eq!(waiting.join().unwrap(), seen + 1);
        });
    }

    #[test]
    fn waiting_ends_when_nothing_happens() {
        let news = News::default();
        assert_eq!(news.wait(news.count(), Duration::from_millis(1)), 0);
    }
}
