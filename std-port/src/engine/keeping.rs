//! A link that its caller keeps from one call to the next.
//!
//! Taking a link out of the epoll set before a call and putting it back afterwards costs more than all of the protocol's
//! own work. A caller whose calls follow each other at once, however long a reply takes, leaves it out, and the clock puts
//! it back when no further call has come within [`LOOK`], so after twice that time at most. Meanwhile nobody reads what
//! the peer sends of its own accord: keep-alives and emergencies come as datagrams as well, and a peer that calls here is
//! not kept waiting, since its link is not kept.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::time::Instant;

use super::link::{LinkCell, LinkState, Wake};
use super::staying::LOOK;
use super::{Engine, lock};

impl<T: Send + 'static> Engine<T> {
    /// Whether a caller who has just had its reply to what it asked keeps the link.
    pub(super) fn may_keep(&self, asked: Instant, now: Instant, state: &mut LinkState) -> bool {
        let before = state.replied_at.replace(now);
        let at_once = before.is_some_and(|before| asked < before + LOOK);
        at_once
            && !state.is_called
            && !state.is_paused()
            && state.session.is_live()
            && !state.waiters.iter().any(|waiter| matches!(waiter.wake, Wake::Task(_)))
            && !self.is_stopping()
    }

    /// The clock is to look at a link that is kept from here on.
    pub(super) fn watch_kept(&self, now: Instant, link: &LinkCell, state: &mut LinkState) {
        if std::mem::replace(&mut state.kept, true) {
            self.put_off_look(now);
        } else {
            lock(&self.kept).push(link.id);
            self.crew().watched.fetch_add(1, Ordering::Relaxed);
            self.begin_watch();
        }
    }

    /// Gives links that are kept for nothing to the pool; whether any are left. One that is led is watched anew when it
    /// is next kept.
    pub(super) fn look_at_kept(&self, now: Instant) -> bool {
        let kept = std::mem::take(&mut *lock(&self.kept));
        let before = kept.len();
        let left: Vec<_> =
            kept.into_iter().filter(|id| self.link(*id).is_some_and(|link| self.stays_kept(now, &link))).collect();
        self.crew().watched.fetch_sub(before - left.len(), Ordering::Relaxed);
        let mut kept = lock(&self.kept);
        kept.extend(left);
        !kept.is_empty()
    }

    fn stays_kept(&self, now: Instant, link: &Arc<LinkCell>) -> bool {
        // Whoever has the lock is the caller, who is back.
        let Some(mut state) = link.try_lock() else { return true };
        let waited = state.replied_at.is_none_or(|replied| now >= replied + LOOK);
        let stays = state.reader.is_kept() && !waited;
        state.kept = stays;
        if !stays {
            // One that is led, or with the pool, stays so.
            state.reader.give_up_keeping();
            self.settle(link, state);
        }
        stays
    }
}
