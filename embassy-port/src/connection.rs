//! What every kind of connection shares.

use core::net::SocketAddrV4;

/// Progress of a connection's operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Progress {
    /// Nothing new.
    None,
    /// The connection that was dialled is there.
    Connected,
    /// A connection was accepted.
    Accepted(SocketAddrV4),
    /// The connection that was dialled could not be opened.
    Broken,
}

/// Copies as much as both hold.
pub(crate) fn copy(from: &[u8], to: &mut [u8]) -> usize {
    let count = from.len().min(to.len());
    if let (Some(from), Some(to)) = (from.get(..count), to.get_mut(..count)) {
        to.copy_from_slice(from);
    }
    count
}
