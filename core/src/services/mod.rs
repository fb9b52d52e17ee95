//! COMMON SERVICES (paper, section 2): requesting, serving, publishing; the m_unit's and the s_unit's view of a peer.

pub mod access;
mod calls;
pub mod lease;
pub mod publications;
pub mod requests;
pub mod unit;

pub use calls::{CallHead, Ticket, slots_for};

use crate::distribution::function_list::{Function, FunctionList, Generation, Slot};
use crate::error::Error;
use crate::host::mailman::Mailman;
use crate::host::secure::Secure;
use crate::storage::{Buffers, Storage};
use crate::time::Instant;
use lease::Service;

/// What a port is made of: the one type parameter of the machines that it holds. What is only lent for a call is `dyn`.
pub trait Port: 'static {
    /// Where tables and buffers live.
    type Storage: Storage;
    /// How links are secured; [`Plain`](crate::host::secure::Plain) where they are not.
    type Cipher: Secure;
}

/// What a port lends to each call of a [`Session`](unit::Session).
pub struct Context<'c, P: Port> {
    /// The time now.
    pub now: Instant,
    /// Writes to links and sends datagrams.
    pub mailman: &'c mut dyn Mailman,
    /// The unit's message buffers.
    pub buffers: &'c mut dyn Buffers<P::Storage>,
    /// The unit's own functions.
    pub functions: &'c dyn OwnFunctions,
    /// Who may do what; without a table whoever has joined may do everything.
    pub access: Option<&'c dyn access::Access>,
}

/// A unit's own [`FunctionList`], whatever runs its services.
pub trait OwnFunctions {
    /// [`FunctionList::function`]
    fn function(&self, slot: Slot) -> Option<Function<'_, dyn Service>>;
    /// [`FunctionList::lookup`]
    fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, dyn Service>, Error>;
    /// [`FunctionList::generation`]
    fn generation(&self, slot: Slot) -> Option<Generation>;
}

impl<S: Storage, H: Service + 'static> OwnFunctions for FunctionList<S, H> {
    fn function(&self, slot: Slot) -> Option<Function<'_, dyn Service>> {
        Self::function(self, slot).map(erased)
    }

    fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, dyn Service>, Error> {
        Self::lookup(self, slot, generation).map(erased)
    }

    fn generation(&self, slot: Slot) -> Option<Generation> {
        Self::generation(self, slot)
    }
}

fn erased<H: Service + 'static>(function: Function<'_, H>) -> Function<'_, dyn Service> {
    let Function { slot, generation, signature, attributes, handler } = function;
    Function { slot, generation, signature, attributes, handler }
}
