//! A latch: after a stop no order begins until a reset that was requested later (docs/concepts.md, "Stop and reset").

use core::sync::atomic::{AtomicBool, AtomicU16, AtomicU32, Ordering};

use crate::distribution::message::Latch;
use crate::time::Instant;

/// The latch of one actuator or of a whole unit. Each write is a single store: the smallest boards have no compare-and-swap, and
/// a stop may interrupt a reset.
#[derive(Debug, Default)]
pub struct LatchWord {
    /// Time of the last stop, as [`odd_millis`]; 0 before the first. Written by a stop and by [`inherit`](Self::inherit), not by a reset.
    inhibited: AtomicU32,
    /// The value of `inhibited` at the last reset. If the two differ, the latch is set.
    cleared: AtomicU32,
    /// The ID number of the unit that stopped it; 0 for the vehicle itself.
    inhibitor: AtomicU32,
    /// The reason.
    reason: AtomicU16,
    /// Of a unit: an actuator was stopped when its last function was removed or replaced.
    holds_removed: AtomicBool,
}

impl LatchWord {
    /// A latch that is not set.
    pub const fn new() -> Self {
        Self {
            inhibited: AtomicU32::new(0),
            cleared: AtomicU32::new(0),
            inhibitor: AtomicU32::new(0),
            reason: AtomicU16::new(0),
            holds_removed: AtomicBool::new(false),
        }
    }

    /// Records who stops and why, unless the latch is set: the first cause stays.
    pub(crate) fn note(&self, latch: Latch) {
        if !self.is_inhibited() {
            self.inhibitor.store(latch.by, Ordering::Release);
            self.reason.store(latch.reason, Ordering::Release);
        }
    }

    /// Sets the latch, as of `now`.
    pub(crate) fn close(&self, now: Instant) {
        let at = odd_millis(now) as u32;
        let at = if at == self.cleared.load(Ordering::Acquire) { at.wrapping_add(2) } else { at };
        self.inhibited.store(at, Ordering::Release);
    }

    /// Sets the latch. If it is set already, keeps its cause but takes the new time.
    pub fn inhibit(&self, now: Instant, latch: Latch) {
        self.note(latch);
        self.close(now);
    }

    /// Clears the latch if it was set before `made`: an earlier request does not undo a later stop, nor one within 3 ms of it.
    pub fn reset(&self, now: Instant, made: Instant) {
        // If a stop interrupts this, it stays in effect: it stores another time.
        let inhibited = self.inhibited.load(Ordering::Acquire);
        if is_behind(now, made, inhibited) {
            self.cleared.store(inhibited, Ordering::Release);
            self.holds_removed.store(false, Ordering::Release);
        }
    }

    /// Copies the latch of something that is removed.
    pub(crate) fn inherit_removed(&self, removed: &Self) {
        self.inherit(removed);
        if removed.is_inhibited() && self.is_inhibited() {
            self.holds_removed.store(true, Ordering::Release);
        }
    }

    /// Of a unit: each actuator in its list has been reset, which ends a stop of all unless one was removed while it was stopped.
    pub fn reset_by_parts(&self, now: Instant, made: Instant) {
        if !self.holds_removed.load(Ordering::Acquire) {
            self.reset(now, made);
        }
    }

    /// Copies another latch if it is set, unless this one was reset after that very stop. If this one is set already, keeps its
    /// cause, and the later time of both.
    pub(crate) fn inherit(&self, from: &Self) {
        let Some(latch) = from.latch() else { return };
        // Load this behind the latch: a stop of `from` in between then counts with its own time.
        let at = from.inhibited.load(Ordering::Acquire);
        let own = self.inhibited.load(Ordering::Acquire);
        if at == own || at == self.cleared.load(Ordering::Acquire) {
            return;
        }
        self.note(latch);
        // Stops that are more than 24 days apart count as if the later one came first.
        if at.wrapping_sub(own) < 1 << 31 || !self.is_inhibited() {
            self.inhibited.store(at, Ordering::Release);
        }
    }

    /// Whether something was made after the last stop, reset or not.
    pub(crate) fn is_behind_stop(&self, now: Instant, made: Instant) -> bool {
        let inhibited = self.inhibited.load(Ordering::Acquire);
        inhibited == 0 || is_behind(now, made, inhibited)
    }

    /// The cause, if the latch is set.
    pub fn latch(&self) -> Option<Latch> {
        self.is_inhibited()
            .then(|| Latch { by: self.inhibitor.load(Ordering::Acquire), reason: self.reason.load(Ordering::Acquire) })
    }

    /// Whether the latch is set.
    pub fn is_inhibited(&self) -> bool {
        self.changes() != 0
    }

    /// Differs whenever the latch does; 0 if it is not set.
    pub(crate) fn changes(&self) -> u32 {
        self.inhibited.load(Ordering::Acquire) ^ self.cleared.load(Ordering::Acquire)
    }
}

/// Whether something was made later than a stop at this [`odd_millis`] time.
fn is_behind(now: Instant, made: Instant, stop: u32) -> bool {
    // Valid within the 49 days after which the word wraps; then a request may have to be repeated a minute later. Its age is
    // seconds. What is made by `now` is not later than a stop that has come since, as of an interrupt.
    let since = ((now.as_micros() / 1_000) as u32).wrapping_sub(stop);
    let age = now.since(made).as_millis();
    // `odd_millis` rounds down by up to 2 ms, but up at the start of the clock.
    stop != 0 && since < u32::MAX - 60_000 && age.saturating_add(2) < u64::from(since)
}

/// A time in milliseconds, rounded down to an odd number, so that it is never 0, which means "none".
pub(crate) const fn odd_millis(time: Instant) -> u64 {
    let millis = time.as_micros() / 1_000;
    if millis & 1 == 0 { millis.saturating_sub(1) | 1 } else { millis }
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects)]
mod tests {
    use super::*;

    const CAUSE: Latch = Latch { by: 7, reason: 3 };
    /// After so many milliseconds the words wrap.
    const WRAP: u64 = 1 << 32;

    const fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    fn stopped(now: u64) -> LatchWord {
        let latch = LatchWord::new();
        latch.inhibit(at(now), CAUSE);
        latch
    }

    #[test]
    fn only_a_reset_requested_after_the_last_stop_clears_it() {
        // A time is an odd millisecond in the latch, and an age is whole milliseconds: each phase of both counts.
        for start in [0, 5_000, 1_000_000, WRAP * 1_000 - 4_000] {
            for phase in (0..4_000).step_by(90) {
                let stop = start + phase;
                for later in (0..3_000).step_by(110).map(|later| stop + 5_000 + later) {
                    let latch = stopped(stop);
                    latch.reset(at(later), at(stop));
                    latch.reset(at(later), at(stop.saturating_sub(1_000)));
                    assert!(latch.is_inhibited() && !latch.is_behind_stop(at(later), at(stop)), "{stop} {later}");
                    assert_eq!(latch.latch(), Some(CAUSE));
                    assert!(latch.is_behind_stop(at(later), at(stop + 4_000)), "{stop} {later}");
                    latch.reset(at(later), at(stop + 4_000));
                    assert!(!latch.is_inhibited() && latch.latch().is_none(), "{stop} {later}");
                    assert!(!latch.is_behind_stop(at(later), at(stop)), "a stop counts when it was reset, too");
                }
            }
        }
    }

    #[test]
    fn a_stop_that_comes_while_a_reset_is_under_way_stays() {
        for later in [3_000, 5_000, 2_000_000] {
            let latch = stopped(1_000_000 + later);
            latch.reset(at(1_000_000), at(999_000));
            assert!(latch.is_inhibited() && !latch.is_behind_stop(at(1_000_000), at(999_000)), "{later}");
            latch.reset(at(9_000_000), at(8_000_000));
            assert!(!latch.is_inhibited());
        }
    }

    #[test]
    fn a_reset_at_the_start_of_the_clock_is_not_later_than_a_stop_there() {
        let latch = stopped(0);
        latch.reset(at(0), at(0));
        assert!(latch.is_inhibited());
        let latch = LatchWord::new();
        assert!(
            latch.is_behind_stop(at(0), at(0)) && latch.is_behind_stop(at(9_000), at(9_000)),
            "nothing was stopped"
        );
        latch.reset(at(9_000), at(9_000));
        assert!(!latch.is_inhibited());
    }

    #[test]
    fn a_latch_keeps_its_first_cause_and_the_time_of_its_last_stop() {
        let latch = stopped(1_000_000);
        latch.inhibit(at(2_000_000), Latch { by: 8, reason: 4 });
        assert_eq!(latch.latch(), Some(CAUSE));
        latch.reset(at(3_000_000), at(1_500_000));
        assert!(latch.is_inhibited(), "the second stop was later");
        latch.reset(at(3_000_000), at(2_500_000));
        latch.inhibit(at(4_000_000), Latch { by: 8, reason: 4 });
        assert_eq!(latch.latch(), Some(Latch { by: 8, reason: 4 }));
    }

    #[test]
    fn a_stop_whose_time_reads_as_that_of_one_that_was_reset_stops() {
        let latch = stopped(1_000_000);
        latch.reset(at(2_000_000), at(1_500_000));
        latch.inhibit(at(1_000_000 + WRAP * 1_000), CAUSE);
        assert!(latch.is_inhibited());
    }

    #[test]
    fn a_latch_is_inherited_unless_that_very_stop_was_reset() {
        let (unit, service) = (stopped(1_000_000), LatchWord::new());
        service.inherit(&LatchWord::new());
        assert!(!service.is_inhibited());
        service.inherit(&unit);
        assert_eq!(service.latch(), Some(CAUSE));
        service.reset(at(2_000_000), at(500_000));
        assert!(service.is_inhibited(), "the stop is inherited with its time");
        service.reset(at(2_000_000), at(1_500_000));
        service.inherit(&unit);
        assert!(!service.is_inhibited());
        unit.inhibit(at(2_500_000), CAUSE);
        service.inherit(&unit);
        assert!(service.is_inhibited());
        // What is set already keeps its cause.
        let own = LatchWord::new();
        own.inhibit(at(3_000_000), Latch { by: 0, reason: 1 });
        own.inherit(&unit);
        assert_eq!(own.latch(), Some(Latch { by: 0, reason: 1 }));
    }

    #[test]
    fn of_what_is_removed_and_its_unit_the_later_stop_counts() {
        for (unit, removed) in
            [(1_000_000, 2_000_000), (2_000_000, 1_000_000), (WRAP * 1_000 - 1, WRAP * 1_000 + 999_999)]
        {
            let (unit, early) = (stopped(unit), unit.min(removed));
            unit.inherit_removed(&stopped(removed));
            let later = at(early + 5_000_000);
            unit.reset(later, at(early + 500_000));
            assert!(unit.is_inhibited(), "{early}");
            unit.reset(later, at(early + 2_000_000));
            assert!(!unit.is_inhibited(), "{early}");
        }
    }

    #[test]
    fn times_are_odd_and_never_later() {
        for millis in 1..40 {
            let odd = odd_millis(at(millis * 1_000 + 999));
            assert!(odd % 2 == 1 && odd <= millis && odd + 1 >= millis, "{millis}");
        }
        assert_eq!(odd_millis(at(999)), 1, "there is no earlier one");
    }
}
