//! Named deadlines, one per part of a session. Their minimum is the session's next wake-up.

use crate::ability::{DETAILS, STREAMS};
use crate::time::Instant;

/// The parts with a deadline. Those that a build can leave out come last.
#[derive(Clone, Copy)]
pub(super) enum Part {
    /// A granted lease ends.
    Leases,
    /// A call of this unit times out.
    Calls,
    /// A release is retried that the stream had no capacity for.
    Releases,
    /// Gathered one-way messages are sent.
    Gathered,
    /// A held lease is renewed.
    Renewals,
    KeepAlive,
    /// The keys are renewed, or a renewal has timed out.
    Keys,
    /// Waiting for a claim to be stored, or for a link to give way.
    Claims,
    /// The peer should have been heard.
    Liveness,
    /// A sample is sent.
    Streams,
    /// A handler is notified of a cancellation, or a caller of progress.
    Details,
}

const PARTS: usize = Part::Streams as usize + STREAMS as usize + DETAILS as usize;

impl Part {
    const fn index(self) -> usize {
        match self {
            Self::Streams if !STREAMS => PARTS,
            Self::Details if !DETAILS => PARTS,
            Self::Details => PARTS.saturating_sub(1),
            part => part as usize,
        }
    }
}

/// One deadline per part, and the earliest of them.
pub(super) struct Due {
    at: [Instant; PARTS],
    next: Instant,
}

impl Due {
    pub(super) const fn new() -> Self {
        Self { at: [Instant::FAR_FUTURE; PARTS], next: Instant::FAR_FUTURE }
    }

    /// The earliest deadline.
    pub(super) const fn next(&self) -> Instant {
        self.next
    }

    /// The deadline of one part.
    pub(super) fn at(&self, part: Part) -> Instant {
        self.at.get(part.index()).copied().unwrap_or(Instant::FAR_FUTURE)
    }

    pub(super) fn has_come(&self, part: Part, now: Instant) -> bool {
        now >= self.at(part)
    }

    #[inline(never)]
    pub(super) fn set(&mut self, part: Part, at: Instant) {
        let Some(slot) = self.at.get_mut(part.index()) else { return };
        let before = core::mem::replace(slot, at);
        if at <= self.next {
            self.next = at;
        } else if before == self.next {
            self.next = self.earliest();
        }
    }

    /// Moves a part's deadline forward to `at`, if it is later.
    #[inline(never)]
    pub(super) fn hasten(&mut self, part: Part, at: Instant) {
        self.set(part, self.at(part).min(at));
    }

    pub(super) fn earliest(&self) -> Instant {
        self.at.iter().copied().min().unwrap_or(Instant::FAR_FUTURE)
    }
}
