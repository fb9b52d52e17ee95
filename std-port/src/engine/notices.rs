//! What happened on a link and is acted upon when its lock has been given up, in the order in which it happened.

use cara_core::services::session::Event;

/// The notices of a link that wait. One thread at a time acts on them, so that nothing is heard of a node's list before
/// the node has joined, or after it has left.
#[derive(Debug, Default)]
pub(crate) struct Notices {
    waiting: Vec<Event>,
    /// A thread acts on earlier ones, and looks for more when it has done so.
    is_acting: bool,
}

impl Notices {
    pub(crate) fn push(&mut self, event: Event) {
        self.waiting.push(event);
    }

    /// Whether the thread that gives the lock up is to act on them.
    pub(crate) fn begin(&self) -> bool {
        !self.waiting.is_empty() && !self.is_acting
    }

    /// What is to be acted upon next; with `None` the thread is done.
    pub(crate) fn next(&mut self) -> Option<Vec<Event>> {
        self.is_acting = !self.waiting.is_empty();
        self.is_acting.then(|| std::mem::take(&mut self.waiting))
    }
}
