//! Which link is due next: one deadline per link, in order, so that the work of a wake-up does not grow with the links.

use std::collections::BTreeSet;

use cara_core::time::Instant;

/// The deadline of each link, by its index. Every change costs O(log n).
#[derive(Debug, Default)]
pub(crate) struct Timers {
    ordered: BTreeSet<(Instant, u32)>,
    /// By link; what stands here stands in `ordered` as well.
    deadlines: Vec<Option<Instant>>,
}

impl Timers {
    /// No timers.
    pub(crate) fn new() -> Self {
        Self::default()
    }

    /// Sets the deadline of `link`, in place of an earlier one. [`Instant::FAR_FUTURE`] cancels it.
    ///
    /// Returns whether the earliest deadline of all is now earlier than before, so that a waiting thread must be woken.
    pub(crate) fn set(&mut self, link: u32, deadline: Instant) -> bool {
        if self.deadline(link) == Some(deadline) {
            return false;
        }
        let earliest = self.next();
        self.cancel(link);
        if deadline == Instant::FAR_FUTURE {
            return false;
        }
        let place = link as usize;
        if self.deadlines.len() <= place {
            self.deadlines.resize(place + 1, None);
        }
        if let Some(slot) = self.deadlines.get_mut(place) {
            *slot = Some(deadline);
        }
        self.ordered.insert((deadline, link));
        earliest.is_none_or(|earliest| deadline < earliest)
    }

    /// As [`set`](Self::set), unless the deadline of `link` is earlier already.
    pub(crate) fn bring_forward(&mut self, link: u32, deadline: Instant) -> bool {
        let earlier = self.deadline(link).is_none_or(|known| deadline < known);
        earlier && self.set(link, deadline)
    }

    /// Every deadline becomes this one.
    pub(crate) fn bring_all_forward(&mut self, deadline: Instant) {
        let links = self.ordered.iter().map(|&(_, link)| link).collect::<Vec<_>>();
        for link in links {
            self.bring_forward(link, deadline);
        }
    }

    /// Forgets the deadline of `link`, if it has one.
    pub(crate) fn cancel(&mut self, link: u32) {
        if let Some(old) = self.deadlines.get_mut(link as usize).and_then(Option::take) {
            self.ordered.remove(&(old, link));
        }
    }

    /// The deadline of `link`.
    pub(crate) fn deadline(&self, link: u32) -> Option<Instant> {
        self.deadlines.get(link as usize).copied().flatten()
    }

    /// The earliest deadline of all.
    pub(crate) fn next(&self) -> Option<Instant> {
        self.ordered.first().map(|&(deadline, _)| deadline)
    }

    /// Takes out the link whose deadline is the earliest, if it is not after `now`.
    pub(crate) fn pop_due(&mut self, now: Instant) -> Option<u32> {
        let &(deadline, link) = self.ordered.first()?;
        if deadline > now {
            return None;
        }
        self.cancel(link);
        Some(link)
    }

    /// How many links have a deadline.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.ordered.len()
    }

    /// Whether no link has a deadline.
    #[cfg(test)]
    pub(crate) fn is_empty(&self) -> bool {
        self.ordered.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    #[test]
    fn links_come_due_in_the_order_of_their_deadlines() {
        let mut timers = Timers::new();
        assert!(timers.set(0, at(30)));
        assert!(timers.set(7, at(10)));
        assert!(!timers.set(3, at(20)));
        assert_eq!(timers.next(), Some(at(10)));
        assert_eq!(timers.pop_due(at(9)), None);
        assert_eq!(timers.pop_due(at(20)), Some(7));
        assert_eq!(timers.pop_due(at(20)), Some(3));
        assert_eq!(timers.pop_due(at(20)), None);
        assert_eq!(timers.len(), 1);
    }

    #[test]
    fn a_new_deadline_replaces_the_old_one() {
        let mut timers = Timers::new();
        timers.set(1, at(10));
        assert!(!timers.set(1, at(10)), "unchanged");
        assert!(!timers.set(1, at(50)), "later than before");
        assert_eq!(timers.pop_due(at(49)), None);
        assert_eq!(timers.pop_due(at(50)), Some(1));
        assert!(timers.is_empty());
    }

    #[test]
    fn a_deadline_is_brought_forward_and_never_put_off() {
        let mut timers = Timers::new();
        assert!(timers.bring_forward(1, at(10)));
        assert!(!timers.bring_forward(1, at(20)));
        assert_eq!(timers.deadline(1), Some(at(10)));
        assert!(timers.bring_forward(1, at(5)));
        assert!(!timers.bring_forward(1, Instant::FAR_FUTURE));
        assert_eq!(timers.pop_due(at(5)), Some(1));
    }

    #[test]
    fn cancelled_links_do_not_come_due() {
        let mut timers = Timers::new();
        timers.set(1, at(10));
        timers.set(2, at(10));
        timers.cancel(1);
        assert!(!timers.set(2, Instant::FAR_FUTURE));
        timers.cancel(99);
        assert_eq!(timers.pop_due(at(1_000)), None);
        assert_eq!(timers.deadline(1), None);
    }

    /// Against a plain table, with a fixed sequence of pseudo-random operations.
    #[test]
    fn it_agrees_with_a_plain_table() {
        let mut random = cara_core::random::Random::new(2);
        let mut timers = Timers::new();
        let mut table = [None::<Instant>; 16];
        for now in 0..20_000u64 {
            let link = random.below(16) as u32;
            match random.below(3) {
                0 => {
                    let deadline = at(now + random.below(100));
                    timers.set(link, deadline);
                    table[link as usize] = Some(deadline);
                }
                1 => {
                    timers.cancel(link);
                    table[link as usize] = None;
                }
                _ => {
                    while let Some(due) = timers.pop_due(at(now)) {
                        let deadline = table[due as usize].take().expect("a link that was set");
                        assert!(deadline <= at(now));
                    }
                    assert!(table.iter().flatten().all(|deadline| *deadline > at(now)));
                }
            }
            assert_eq!(timers.next(), table.iter().flatten().min().copied());
            assert_eq!(timers.len(), table.iter().flatten().count());
        }
    }
}
