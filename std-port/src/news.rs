//! Lets threads wait until something has happened to a unit, for those that then look for themselves at what it was.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use cara_core::time::Duration;

/// How many events there have been.
#[derive(Debug, Default)]
pub(crate) struct News {
    count: Mutex<u64>,
    more: Condvar,
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
    }

    /// Waits until there are others than those that were `seen`, or for `left`. Returns how many there are.
    pub(crate) fn wait(&self, seen: u64, left: Duration) -> u64 {
        let waited = self.more.wait_timeout_while(self.lock(), left.into(), |count| *count == seen);
        *waited.unwrap_or_else(PoisonError::into_inner).0
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
