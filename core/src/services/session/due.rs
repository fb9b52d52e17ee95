//! When each part of a session has something to do.

use crate::ability::{DETAILS, STREAMS};
use crate::time::Instant;

/// What has something to do when its time has come. Parts that a build can leave out stand last.
#[derive(Clone, Copy)]
pub(super) enum Part {
    /// A granted lease ends.
    Leases,
    /// A call of this unit times out.
    Calls,
    /// A release is tried again that the stream had no room for.
    Releases,
    /// One-way messages have gathered long enough.
    Gathered,
    /// A held lease is renewed.
    Renewals,
    KeepAlive,
    /// The link gets new keys, or a step of that has taken too long.
    Keys,
    /// A claim is waited for, or a link gives way.
    Claims,
    /// The peer was to be heard.
    Liveness,
    /// A sample follows.
    Streams,
    /// A handler is told that its call was cancelled, or a caller how far its call is.
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

/// One deadline for each part, and the earliest of them.
pub(super) struct Due {
    at: [Instant; PARTS],
    next: Instant,
}

impl Due {
    pub(super) const fn new() -> Self {
        Self { at: [Instant::FAR_FUTURE; PARTS], next: Instant::FAR_FUTURE }
    }

    /// The earliest deadline of all.
    pub(super) const fn next(&self) -> Instant {
        self.next
    }

    /// When a part has something to do.
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

    /// A part has something to do no later than at this time.
    #[inline(never)]
    pub(super) fn hasten(&mut self, part: Part, at: Instant) {
        self.set(part, self.at(part).min(at));
    }

    pub(super) fn earliest(&self) -> Instant {
        self.at.iter().copied().min().unwrap_or(Instant::FAR_FUTURE)
    }
}
