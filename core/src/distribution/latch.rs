//! A latch: what was stopped stays stopped until a reset that was asked for later.

use core::sync::atomic::{AtomicU16, AtomicU32, Ordering};

use crate::distribution::message::Latch;
use crate::time::Instant;

/// The word of a latch, of one actuator or of a whole unit. Each write is one store: there is no compare-and-swap on the
/// smallest boards, and a stop may interrupt a reset.
#[derive(Debug, Default)]
pub struct LatchWord {
    /// When it was inhibited last, as [`odd_millis`]; 0 when it never was. Written by a stop alone.
    inhibited: AtomicU32,
    /// What `inhibited` was when it was reset last. Where the two differ, it is latched.
    cleared: AtomicU32,
    /// The ID number of the unit that inhibited it; 0 for this one.
    inhibitor: AtomicU32,
    /// Why.
    reason: AtomicU16,
}

impl LatchWord {
    /// One that nothing has stopped.
    pub const fn new() -> Self {
        Self {
            inhibited: AtomicU32::new(0),
            cleared: AtomicU32::new(0),
            inhibitor: AtomicU32::new(0),
            reason: AtomicU16::new(0),
        }
    }

    /// Who stops it, and why, unless it is latched: the first one stays.
    pub(crate) fn note(&self, latch: Latch) {
        if !self.is_inhibited() {
            self.inhibitor.store(latch.by, Ordering::Release);
            self.reason.store(latch.reason, Ordering::Release);
        }
    }

    /// It is latched, as of `now`.
    pub(crate) fn close(&self, now: Instant) {
        let at = odd_millis(now) as u32;
        let at = if at == self.cleared.load(Ordering::Acquire) { at.wrapping_add(2) } else { at };
        self.inhibited.store(at, Ordering::Release);
    }

    /// Latches it. The first latch stays when there is one, but with the time of the newest.
    pub fn inhibit(&self, now: Instant, latch: Latch) {
        self.note(latch);
        self.close(now);
    }

    /// Opens it, if it was inhibited before `made`: an earlier wish does not undo a later stop, nor one made within 3 ms of it.
    pub fn reset(&self, now: Instant, made: Instant) {
        // A stop that interrupts this is not undone: it writes another time.
        let inhibited = self.inhibited.load(Ordering::Acquire);
        if is_behind(now, made, inhibited) {
            self.cleared.store(inhibited, Ordering::Release);
        }
    }

    /// Takes the latch of another one along, unless it was reset from just that stop.
    pub(crate) fn inherit(&self, from: &Self) {
        let at = from.inhibited.load(Ordering::Acquire);
        let Some(latch) = from.latch().filter(|_| !self.is_inhibited()) else { return };
        // What is not latched was cleared of the last stop that it has seen, so this differs from that.
        if at != self.inhibited.load(Ordering::Acquire) {
            self.note(latch);
            self.inhibited.store(at, Ordering::Release);
        }
    }

    /// Whether what was `made` then was made after the last stop, reset or not.
    pub(crate) fn is_behind_stop(&self, now: Instant, made: Instant) -> bool {
        let inhibited = self.inhibited.load(Ordering::Acquire);
        inhibited == 0 || is_behind(now, made, inhibited)
    }

    /// What latches it.
    pub fn latch(&self) -> Option<Latch> {
        self.is_inhibited()
            .then(|| Latch { by: self.inhibitor.load(Ordering::Acquire), reason: self.reason.load(Ordering::Acquire) })
    }

    /// Whether it is latched.
    pub fn is_inhibited(&self) -> bool {
        self.changes() != 0
    }

    /// Differs when the latch does; 0 where there is none.
    pub(crate) fn changes(&self) -> u32 {
        self.inhibited.load(Ordering::Acquire) ^ self.cleared.load(Ordering::Acquire)
    }
}

/// Whether what was `made` then is later than a stop, of which the time is one of [`odd_millis`].
fn is_behind(now: Instant, made: Instant, stop: u32) -> bool {
    // As long as the word's 49 days, after which a wish may have to be made twice; its age is seconds.
    let since = ((now.as_micros() / 1_000) as u32).wrapping_sub(stop);
    let age = now.since(made).as_millis();
    // The moment is rounded down by up to 2 ms; at the clock's beginning it is rounded up.
    stop != 0 && since != u32::MAX && age.saturating_add(2) < u64::from(since)
}

/// A time in milliseconds, rounded down to an odd number, which is never the 0 of "none".
pub(crate) const fn odd_millis(time: Instant) -> u64 {
    let millis = time.as_micros() / 1_000;
    if millis & 1 == 0 { millis.saturating_sub(1) | 1 } else { millis }
}
