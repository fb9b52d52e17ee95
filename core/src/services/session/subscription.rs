//! The state of one peer's subscriptions.

use crate::ability::Begins;
use crate::distribution::function_list::Generation;
use crate::distribution::message::{NO_SUBSCRIPTION, SubscriptionRefusal};
use crate::time::Instant;

/// The peer's subscription to a stream of this unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Subscription {
    /// Least interval between values in milliseconds, or [`NO_SUBSCRIPTION`].
    pub(super) interval: u32,
    /// The version that was sent last; 0 before the first.
    pub(super) version: u32,
    pub(super) generation: Generation,
    /// An answer that has yet to be sent to the peer.
    pub(super) answer: Option<SubscriptionRefusal>,
    /// When the next value may follow.
    pub(super) due: Instant,
}

impl Subscription {
    pub(super) const NONE: Self =
        Self { interval: NO_SUBSCRIPTION, version: 0, generation: Generation(0), answer: None, due: Instant::START };

    pub(super) const fn is_active(&self) -> bool {
        self.interval != NO_SUBSCRIPTION
    }
}

impl Begins for Subscription {
    const BEGIN: &'static Self = &Self::NONE;
}

/// When samples are sent next.
#[derive(Clone, Copy)]
pub(super) struct Pace {
    /// When the next sample is due.
    pub(super) due: Instant,
    /// Since when samples wait for the send queue to drain; in the far future if they do not.
    pub(super) blocked: Instant,
}

impl Begins for Pace {
    const BEGIN: &'static Self = &Self { due: Instant::FAR_FUTURE, blocked: Instant::FAR_FUTURE };
}

impl Pace {
    /// When the next sample can be sent, if `queued` bytes wait on the link.
    pub(super) fn deadline(&self, queued: usize) -> Instant {
        // The queue may have drained with another write, without a writable notification: samples are due at once.
        if queued == 0 && self.blocked != Instant::FAR_FUTURE { self.blocked } else { self.due }
    }
}
