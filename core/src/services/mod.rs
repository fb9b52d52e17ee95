//! COMMON SERVICES (paper, section 2): requesting, serving, publishing; the m_unit's and the s_unit's view of a peer.

pub mod access;
mod calls;
pub mod lease;
pub mod publications;
pub mod requests;
pub mod unit;

pub use calls::{CallHead, Ticket, slots_for};

use crate::distribution::function_list::FunctionList;
use crate::host::mailman::Mailman;
use crate::storage::{Buffers, Storage};
use crate::time::Instant;

/// What a port lends to each call of a [`Session`](unit::Session).
pub struct Context<'c, S: Storage, M: Mailman, B: Buffers<S>, H: 'static> {
    /// The time now.
    pub now: Instant,
    /// Writes to links and sends datagrams.
    pub mailman: &'c mut M,
    /// The unit's message buffers.
    pub buffers: &'c mut B,
    /// The unit's own functions.
    pub functions: &'c FunctionList<S, H>,
    /// Who may do what; without a table whoever has joined may do everything.
    pub access: Option<&'c dyn access::Access>,
}
