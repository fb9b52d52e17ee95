//! The paper's `Mailman`: the one trait between the core and a port.
//!
//! It is synchronous and never blocks; a port lends it to each call that may write. Reading goes the other way: the port
//! reads (a Linux thread blocks in the read without any lock), lends what it has to
//! [`Session::receive`](crate::services::session::Session::receive) or
//! [`Node::datagram`](crate::distribution::connection_handler::Node::datagram), and is told how much was consumed.
//!
//! # Contract
//! - [`write`](Mailman::write) takes the slices in order and may take only a part; it returns how many bytes it took,
//!   0 for "would block". After a short write the port calls the session's `writable` when there is room again.
//! - A message that cannot be kept is refused before its first byte is written; what `write` did not take, the link
//!   keeps in its own bounded buffer.
//! - Readiness is drained until would-block or a budget; what remains is polled again.
//! - A port bounds the unsent bytes in the kernel or stack, so that an emergency is not stuck behind them.

use crate::error::CloseReason;

/// Names one link of a unit: an index that the port chose, below its number of links.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkId(pub u16);

/// Sends bytes for the core: TCP streams, UDP datagrams, broadcasts. `E` is the port's [`Endpoint`](super::endpoint::Endpoint).
pub trait Mailman<E> {
    /// Writes to the stream of `link`; returns how many bytes were taken in all, 0 when the stream would block.
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason>;

    /// Most bytes of sealed frames that wait for the stream at a time; one frame may be longer, and 0 means the peer's
    /// longest chunk. More bytes mean fewer writes per message. Sealed frames are not overtaken, not even by an
    /// emergency: then only its datagram is in time.
    fn seals_ahead(&self) -> usize {
        0
    }

    /// Sends one datagram from the unit's own UDP port. `false` when the network refused it.
    fn send_to(&mut self, to: E, datagram: &[u8]) -> bool;

    /// Sends one datagram to the discovery port of every node on every interface. `false` when none took it.
    fn broadcast(&mut self, datagram: &[u8]) -> bool;
}
