//! Spinning: a thread that waits for a stream polls it for a while before it sleeps, as long as that brings something.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Instant;

use cara_core::time::Duration;

use super::stream::{Received, Wait};

/// The longest that a thread may poll before it sleeps.
pub(crate) const LONGEST_SPIN: Duration = Duration::from_millis(1);

/// After so many waits in vain one in 256 spins, which costs a wait 4 us in the mean at most.
const MOST_MISSES: u32 = 8;

/// How long waits for one stream spin, and how often it was in vain lately. One thread waits at a time; where a second one
/// does, a wait more or less spins.
#[derive(Debug, Default)]
pub(super) struct Spinning {
    span: Duration,
    misses: AtomicU32,
    skipped: AtomicU32,
}

impl Spinning {
    /// Waits spin for so long.
    pub(super) fn lasting(span: Duration) -> Self {
        Self { span: span.min(LONGEST_SPIN), ..Self::default() }
    }

    /// Polls with `receive` until something comes or the time is over; returns what is left of the wait as well. Polls not
    /// at all where it is off, has not helped lately, or would outlast the wait.
    pub(super) fn spin(&self, wait: Wait, mut receive: impl FnMut() -> Received) -> (Received, Wait) {
        let spins = match wait {
            Wait::Not => false,
            Wait::Slice => true,
            Wait::AtMost(left) => left > self.span,
        };
        if !spins || self.span == Duration::ZERO || !self.is_worth_it() {
            return (Received::WouldBlock, wait);
        }
        let received = receive();
        if received != Received::WouldBlock {
            // It was there: a thread would not have slept, and on one CPU it often is.
            return (received, wait);
        }
        let began = Instant::now();
        let misses = self.misses.load(Ordering::Relaxed);
        let (received, spun) = loop {
            let (received, spun) = (receive(), Duration::from(began.elapsed()));
            if received != Received::WouldBlock || spun >= self.span {
                break (received, spun);
            }
            // Not `yield_now`: where others want this CPU, the thread would wait behind them all, and one that sleeps need not.
            std::hint::spin_loop();
        };
        // What comes after that time comes to a thread that has lost its CPU, as it would by sleeping.
        let misses = if spun < self.span { misses / 2 } else { (misses + 1).min(MOST_MISSES) };
        self.misses.store(misses, Ordering::Relaxed);
        match wait {
            Wait::AtMost(left) if received == Received::WouldBlock => (received, Wait::AtMost(left - spun)),
            _ => (received, wait),
        }
    }

    #[cfg(test)]
    pub(super) fn misses(&self) -> u32 {
        self.misses.load(Ordering::Relaxed)
    }

    /// One wait in `2^misses`.
    fn is_worth_it(&self) -> bool {
        let skipped = self.skipped.load(Ordering::Relaxed) + 1;
        let is_due = skipped >> self.misses.load(Ordering::Relaxed) > 0;
        self.skipped.store(if is_due { 0 } else { skipped }, Ordering::Relaxed);
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPAN: Duration = Duration::from_micros(10);

    /// How many of so many waits spin, where nothing comes.
    fn in_vain(spinning: &Spinning, waits: usize) -> usize {
        let spins = |_: &usize| {
            let mut polled = false;
            let (received, _) = spinning.spin(Wait::Slice, || {
                polled = true;
                Received::WouldBlock
            });
            assert_eq!(received, Received::WouldBlock);
            polled
        };
        (0..waits).filter(spins).count()
    }

    #[test]
    fn it_is_off_unless_it_has_a_span() {
        assert_eq!(in_vain(&Spinning::default(), 100), 0);
    }

    #[test]
    fn what_does_not_help_is_tried_seldom_and_begins_again_when_it_helps() {
        let spinning = Spinning::lasting(SPAN);
        assert_eq!(in_vain(&spinning, 511), 9, "after 1, 2, 4 … 256 waits");
        assert_eq!(in_vain(&spinning, 2_560), 10);
        let spinning = Spinning { span: LONGEST_SPIN, ..spinning };
        for _ in 0..1_000 {
            spinning.spin(Wait::Slice, || Received::Bytes(1));
        }
        assert!(spinning.misses() > 0, "what was there before has not helped");
        while spinning.misses() > 0 {
            let mut polls = [Received::Bytes(1), Received::WouldBlock].into_iter();
            spinning.spin(Wait::Slice, || polls.next_back().unwrap());
        }
        assert_eq!(in_vain(&spinning, 1), 1, "each wait spins as long as it helps");
    }

    #[test]
    fn what_comes_late_has_not_helped() {
        let spinning = Spinning::lasting(SPAN);
        let mut polls = [Received::Bytes(1), Received::WouldBlock].into_iter();
        let (received, _) = spinning.spin(Wait::Slice, || {
            std::thread::sleep(SPAN.into());
            polls.next_back().unwrap()
        });
        assert_eq!((received, spinning.misses()), (Received::Bytes(1), 1));
    }

    #[test]
    fn no_spin_outlasts_the_wait_and_what_it_took_is_off_the_wait() {
        let spinning = Spinning::lasting(Duration::from_secs(9));
        assert_eq!(spinning.span, LONGEST_SPIN);
        for wait in [Wait::Not, Wait::AtMost(LONGEST_SPIN)] {
            let (_, left) = spinning.spin(wait, || panic!("it polls"));
            assert_eq!(left, wait);
        }
        let all = Duration::from_millis(30);
        let (_, left) = spinning.spin(Wait::AtMost(all), || Received::WouldBlock);
        let Wait::AtMost(left) = left else { panic!("{left:?}") };
        assert!(left <= all - LONGEST_SPIN, "{left:?}");
    }
}
