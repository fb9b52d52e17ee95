//! A thread that looks at the clock and does nothing else: where it has no turn, the host holds the process up, and what a test
//! measures there is the host.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Between two looks.
const TICK: Duration = Duration::from_millis(10);
/// How often a test begins at most.
const TRIES: usize = 5;

/// Runs a test in which a lease is renewed in time; again where it fails and the host [may have ended](Ticker::may_have_ended) that
/// lease. What fails without that, or each time, fails.
pub fn unless_held_up(lease: Duration, test: impl Fn()) {
    for _ in 1..TRIES {
        let ticker = Ticker::start();
        match catch_unwind(AssertUnwindSafe(&test)) {
            Ok(()) => return,
            Err(failed) if !ticker.may_have_ended(lease) => resume_unwind(failed),
            Err(_) => {}
        }
    }
    test();
}

/// For how long this process had no turn since this was started; dropping it ends it.
pub struct Ticker {
    gaps: Arc<Mutex<Gaps>>,
}

struct Gaps {
    last: Instant,
    longest: Duration,
    together: Duration,
}

impl Ticker {
    /// Begins to look.
    pub fn start() -> Self {
        let gaps = Gaps { last: Instant::now(), longest: Duration::ZERO, together: Duration::ZERO };
        let gaps = Arc::new(Mutex::new(gaps));
        let wanted = Arc::downgrade(&gaps);
        std::thread::spawn(move || {
            while let Some(gaps) = wanted.upgrade() {
                drop(look(&gaps));
                drop(gaps);
                std::thread::sleep(TICK);
            }
        });
        Self { gaps }
    }

    /// Whether a lease may have ended because this process had no turn for an eighth of it, or longer. A renewal is sent each quarter
    /// of it and passes several threads, which are late one after the other.
    pub fn may_have_ended(&self, lease: Duration) -> bool {
        self.longest() >= lease / 8
    }

    /// The longest time without a turn.
    pub fn longest(&self) -> Duration {
        look(&self.gaps).longest
    }

    /// All of them together.
    pub fn together(&self) -> Duration {
        look(&self.gaps).together
    }
}

/// Also called by who asks: the gap that goes on counts.
fn look(gaps: &Mutex<Gaps>) -> MutexGuard<'_, Gaps> {
    let mut gaps = gaps.lock().unwrap_or_else(PoisonError::into_inner);
    let gap = gaps.last.elapsed().saturating_sub(TICK);
    gaps.last = Instant::now();
    gaps.longest = gaps.longest.max(gap);
    gaps.together += gap;
    gaps
}

#[cfg(test)]
mod tests {
    use super::{TICK, TRIES, Ticker, unless_held_up};
    use std::cell::Cell;
    use std::time::Duration;

    #[test]
    fn a_time_without_a_turn_is_seen() {
        const HELD_UP: Duration = Duration::from_millis(100);
        let ticker = Ticker::start();
        let before = ticker.together();
        let held_up = ticker.gaps.lock().unwrap();
        std::thread::sleep(HELD_UP);
        drop(held_up);
        assert!(ticker.longest() >= HELD_UP - TICK);
        assert!(ticker.together() >= before + HELD_UP - TICK);
    }

    #[test]
    fn a_test_that_was_held_up_begins_again() {
        let runs = Cell::new(0);
        unless_held_up(Duration::ZERO, || {
            runs.set(runs.get() + 1);
            assert_eq!(runs.get(), TRIES, "it fails until then");
        });
    }

    #[test]
    #[should_panic = "it fails once"]
    fn a_test_that_was_not_held_up_fails_at_once() {
        let runs = Cell::new(0);
        unless_held_up(Duration::MAX, || {
            runs.set(runs.get() + 1);
            assert!(runs.get() > 1, "it fails once");
        });
    }
}
