//! Capacities of a unit on Linux, and the constraints that fit it. A link uses little memory when it opens, and grows up to these capacities when its
//! peer publishes more functions, or more calls are in flight.

use cara_core::config::{CHUNK_BYTES, Constraints, LONGEST_KEEP_ALIVE, MINIMUM_CHUNK_BYTES, SHORTEST_KEEP_ALIVE};
use cara_core::error::Error;

/// The longest message that a Linux unit's parameters can hold.
pub(crate) const LONGEST_MESSAGE: u32 = 256 * 1024;

/// Shortest `message_size`: with less nearly every request is refused.
pub(crate) const SHORTEST_MESSAGE: u32 = 16;

/// Sizes of a unit's tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capacities {
    /// Functions in the unit's own list.
    pub functions: usize,
    /// Bytes for their signatures.
    pub signature_bytes: usize,
    /// Functions published to single nodes.
    pub published_to_one: usize,
    /// Functions kept of each peer's list.
    pub their_functions: usize,
    /// Bytes for their signatures, per peer. Help on functions is kept as long as all functions have room.
    pub their_signature_bytes: usize,
    /// Blocking calls in flight to one peer.
    pub calls_in_flight: usize,
    /// Calls of one peer that run here at the same time; more of them wait in their order, up to `calls_per_peer`.
    pub calls_running: usize,
    /// Links that are open beyond the maximum number of nodes: those that have not joined yet.
    pub pending_links: usize,
    /// Message buffers that all links share.
    pub message_buffers: usize,
}

impl Default for Capacities {
    fn default() -> Self {
        Self {
            functions: 64,
            signature_bytes: 8 * 1024,
            published_to_one: 1024,
            their_functions: 48,
            their_signature_bytes: 8 * 1024,
            calls_in_flight: 64,
            calls_running: 16,
            pending_links: 64,
            message_buffers: 256,
        }
    }
}

/// What this port can hold.
pub(crate) fn check(constraints: &Constraints) -> Result<(), Error> {
    let chunk = usize::from(constraints.chunk_size);
    let sound = constraints.maximum_nodes > 0
        && (SHORTEST_MESSAGE..=LONGEST_MESSAGE).contains(&constraints.message_size)
        && constraints.request_timeout.as_millis() > 0
        && (MINIMUM_CHUNK_BYTES..=CHUNK_BYTES).contains(&chunk)
        && (SHORTEST_KEEP_ALIVE..=LONGEST_KEEP_ALIVE).contains(&constraints.keep_alive)
        && constraints.calls_per_peer > 0;
    if sound { Ok(()) } else { Err(Error::BadConstraint) }
}
