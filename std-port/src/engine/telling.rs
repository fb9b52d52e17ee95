//! Acting on what happened on a link, in the order in which it happened, one thread at a time for each link. So nothing
//! is heard of a node's list before the node has joined, or after it has left. Safe hooks have run, or are about to, by then:
//! they wait for nothing that happens here.

use std::sync::{Arc, MutexGuard};

use super::Engine;
use super::link::{LinkCell, LinkState};

impl<T: Send + 'static> Engine<T> {
    /// Gives up a link's lock and acts on what happened under it. What happens meanwhile is left to the thread that is
    /// acting on earlier things.
    pub(super) fn act<'l>(&self, link: &'l Arc<LinkCell>, mut state: MutexGuard<'l, LinkState>) {
        if !state.notices.begin() {
            return;
        }
        while let Some(notices) = state.notices.next() {
            drop(state);
            notices.into_iter().for_each(|notice| self.act_on(link, notice));
            state = link.lock();
        }
    }
}
