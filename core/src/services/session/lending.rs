//! Longer tables for a session that is open: a port with an allocator begins with short ones, so that a link costs what
//! its peer needs and no more.

use super::publishing::Publication;
use super::{CallHead, Entry, Pending, Session};
use crate::services::Port;
use crate::storage::Storage;

/// A peer's list: one entry per function, and the bytes of their signatures.
pub type ListSlices<S> = (<S as Storage>::Slice<Entry>, <S as Storage>::Slice<u8>);

impl<P: Port> Session<P> {
    /// How many calls of this unit may be in flight.
    pub fn call_slots(&self) -> usize {
        self.requests.slots()
    }

    /// Lends more slots for calls of this unit, a multiple of those before. Returns the slots that are not needed any
    /// more: the new ones if they are no such multiple.
    pub fn lend_calls(
        &mut self,
        pending: <P::Storage as Storage>::Slice<Option<Pending>>,
    ) -> <P::Storage as Storage>::Slice<Option<Pending>> {
        self.requests.grow(pending)
    }

    /// Slots for calls of the peer that run here, and how many calls of it run or wait.
    pub fn running_slots(&self) -> (usize, u16) {
        (self.calls.slots(), self.calls.held())
    }

    /// Lends more slots for calls of the peer that run here. Returns the slots that are not needed any more: the new ones if
    /// they are fewer than before.
    pub fn lend_running(
        &mut self,
        running: <P::Storage as Storage>::Slice<Option<CallHead>>,
    ) -> <P::Storage as Storage>::Slice<Option<CallHead>> {
        self.calls.grow(running)
    }

    /// Lends more room for the peer's list; functions that were skipped before stay so until the peer tells them again.
    /// Returns the slices that are not needed any more: the new ones if one of them is shorter than before.
    pub fn lend_functions(&mut self, (entries, bytes): ListSlices<P::Storage>) -> ListSlices<P::Storage> {
        self.theirs.grow(entries, bytes)
    }

    /// Functions of this unit's own list that the peer can be told of.
    pub fn publication_slots(&self) -> usize {
        self.publishing.slots()
    }

    /// Lends more slots for functions of this unit's own list. Returns the slots that are not needed any more: the new
    /// ones if they are fewer.
    pub fn lend_publications(
        &mut self,
        publications: <P::Storage as Storage>::Slice<Publication>,
    ) -> <P::Storage as Storage>::Slice<Publication> {
        self.publishing.grow(publications)
    }
}
