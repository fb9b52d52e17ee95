//! Acting on what happened on a link: safe hooks at once, everything else in the order in which it happened, one thread
//! at a time for each link. So nobody hears of a node's list before the node has joined, or after it has left.

use std::sync::{Arc, MutexGuard};

use cara_core::distribution::function_list::Slot;

use super::Engine;
use super::link::{LinkCell, LinkState, Notice};

impl LinkState {
    /// Takes out the leases that have expired, whose services are to be made safe.
    fn take_expired(&mut self) -> Vec<Slot> {
        let mut expired = Vec::new();
        self.notices.retain(|notice| match notice {
            Notice::LeaseExpired(slot) => {
                expired.push(*slot);
                false
            }
            _ => true,
        });
        expired
    }

    /// What is to be acted upon next; `None` ends the turn of whoever tells.
    fn next_notices(&mut self) -> Option<Vec<Notice>> {
        self.telling = !self.notices.is_empty();
        self.telling.then(|| std::mem::take(&mut self.notices))
    }
}

impl<T: Send + 'static> Engine<T> {
    /// Gives up a link's lock and acts on what happened under it. What happens meanwhile is left to the thread that is
    /// acting on earlier things; only safe hooks wait for nobody.
    pub(super) fn act<'l>(&self, link: &'l Arc<LinkCell>, mut state: MutexGuard<'l, LinkState>) {
        let expired = state.take_expired();
        if !expired.is_empty() {
            drop(state);
            expired.iter().for_each(|slot| self.make_safe(*slot));
            state = link.lock();
            // Before the end of the link, which may be among them.
            state.notices.splice(0..0, expired.into_iter().map(Notice::MadeSafe));
        }
        if state.telling {
            return;
        }
        while let Some(notices) = state.next_notices() {
            drop(state);
            notices.into_iter().for_each(|notice| self.act_on(link, notice));
            state = link.lock();
        }
    }
}
