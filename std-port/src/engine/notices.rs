//! What happened on a link and is acted upon when its lock has been given up, in the order in which it happened.

use cara_core::distribution::function_list::Slot;
use cara_core::error::{CloseReason, Error};
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;
use cara_core::services::unit::Event;

/// What happened under a link's lock and is acted upon without it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Notice {
    /// Its safe hook has been told.
    LeaseExpired(Slot),
    LeaseEnded {
        call: CallId,
        slot: Slot,
        why: LeaseEnd,
    },
    Failed(CallId, Error),
    ListChanged,
    Acknowledged {
        serial: u32,
        skipped: u16,
    },
    Joined,
    Answered,
    Left(CloseReason),
}

/// The notices of a link that wait. One thread at a time acts on them, so that nothing is heard of a node's list before
/// the node has joined, or after it has left.
#[derive(Debug, Default)]
pub(crate) struct Notices {
    waiting: Vec<Notice>,
    /// A thread acts on earlier ones, and looks for more when it has done so.
    is_acting: bool,
}

impl Notices {
    pub(crate) fn push(&mut self, notice: Notice) {
        self.waiting.push(notice);
    }

    /// What an event without borrowed bytes means for the port, if anything.
    pub(crate) fn note(&mut self, event: &Event<'_>) {
        self.waiting.extend(notice(event));
    }

    /// Whether the thread that gives the lock up is to act on them.
    pub(crate) fn begin(&self) -> bool {
        !self.waiting.is_empty() && !self.is_acting
    }

    /// What is to be acted upon next; with `None` the thread is done.
    pub(crate) fn next(&mut self) -> Option<Vec<Notice>> {
        self.is_acting = !self.waiting.is_empty();
        self.is_acting.then(|| std::mem::take(&mut self.waiting))
    }
}

fn notice(event: &Event<'_>) -> Option<Notice> {
    Some(match *event {
        Event::LeaseExpired(slot) => Notice::LeaseExpired(slot),
        Event::LeaseEnded { call, slot, why } => Notice::LeaseEnded { call, slot, why },
        Event::Failed(id, error) => Notice::Failed(id, error),
        Event::ListChanged => Notice::ListChanged,
        Event::Acknowledged { serial, skipped } => Notice::Acknowledged { serial, skipped },
        Event::Answered => Notice::Answered,
        Event::Closed(reason) => Notice::Left(reason),
        Event::Joined | Event::Call(_) | Event::Reply(..) => return None,
    })
}
