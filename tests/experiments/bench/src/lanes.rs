//! Work that mostly waits, done side by side.

use std::sync::{Mutex, PoisonError};
use std::thread;

/// Does each piece of work, at most `lanes` at the same time; the results are in the order of the work.
pub(crate) fn side_by_side<W: Send, T: Send>(work: Vec<W>, lanes: usize, act: impl Fn(W) -> T + Sync) -> Vec<T> {
    let count = work.len();
    let (left, done) = (Mutex::new(work.into_iter().enumerate()), Mutex::new(Vec::with_capacity(count)));
    let next = || left.lock().unwrap_or_else(PoisonError::into_inner).next();
    thread::scope(|scope| {
        for _ in 0..lanes.clamp(1, count.max(1)) {
            scope.spawn(|| {
                while let Some((place, work)) = next() {
                    let result = act(work);
                    done.lock().unwrap_or_else(PoisonError::into_inner).push((place, result));
                }
            });
        }
    });
    let mut done = done.into_inner().unwrap_or_else(PoisonError::into_inner);
    done.sort_unstable_by_key(|(place, _)| *place);
    done.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Barrier;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn results_are_in_the_order_of_the_work() {
        for lanes in [0, 1, 3, 100] {
            assert_eq!(
                side_by_side((0..20).collect(), lanes, |number| number * 2),
                (0..40).step_by(2).collect::<Vec<_>>()
            );
        }
        assert!(side_by_side(Vec::<u8>::new(), 4, |number| number).is_empty());
    }

    #[test]
    fn as_many_are_under_way_as_there_are_lanes() {
        let (barrier, now, most) = (Barrier::new(4), AtomicUsize::new(0), AtomicUsize::new(0));
        side_by_side((0..8).collect(), 4, |_: u8| {
            most.fetch_max(now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            barrier.wait();
            now.fetch_sub(1, Ordering::SeqCst);
        });
        assert_eq!(most.into_inner(), 4);
    }
}
