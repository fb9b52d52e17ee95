//! A thread that looks at the clock and does nothing else: where it has no turn, the host holds the process up, and what a test
//! measures there is the host.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Between two looks.
const TICK: Duration = Duration::from_millis(10);

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
    use super::{TICK, Ticker};
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
}
