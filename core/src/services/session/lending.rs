//! Longer tables for a session that is open: a port with an allocator begins with short ones, so that a link costs what
//! its peer needs and no more.

use super::publishing::Publication;
use super::{Pending, RunningCall, Session};
use crate::services::Port;
use crate::storage::Storage;

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
        running: <P::Storage as Storage>::Slice<Option<RunningCall>>,
    ) -> <P::Storage as Storage>::Slice<Option<RunningCall>> {
        self.calls.grow(running)
    }

    /// Lets the peer's list grow to so many functions, and so many bytes of signatures, where the storage has an allocator.
    pub const fn let_list_grow(&mut self, functions: usize, bytes: usize) {
        self.theirs.let_grow(functions, bytes);
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
