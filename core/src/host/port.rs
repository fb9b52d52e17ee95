//! What a port is made of.

use super::endpoint::Endpoint;
use super::secure::Secure;
use crate::storage::Storage;

/// What a port is made of: the one type parameter of the machines that it holds. What is only lent for a call is `dyn`.
pub trait Port: 'static {
    /// Where tables and buffers live.
    type Storage: Storage;
    /// How links are secured; [`Plain`](crate::host::secure::Plain) where they are not.
    type Cipher: Secure;
    /// How nodes are addressed: [`SocketAddr`](core::net::SocketAddr) or the smaller [`SocketAddrV4`](core::net::SocketAddrV4)
    /// over IP.
    type Endpoint: Endpoint;
    /// Whether its units may be m_units. Where none is, what only they do (answers to searches, links that are accepted, claims that
    /// are raised) is left out of the program.
    const MANAGES: bool = true;
    /// Whether its m_units may stand by for another one. Where none does, [`Node::stand_by`](crate::distribution::connection_handler::Node::stand_by)
    /// does nothing.
    const STANDS_BY: bool = true;
    /// Whether its units call functions of others. Where none does, it keeps none of their functions, and counts them as skipped.
    const CALLS: bool = true;
    /// Whether its units search, answer searches and dial what they find. Where they do not, each has a manager at a fixed address.
    const DISCOVERS: bool = true;
    /// Whether an access table is asked. Where none is, a joined node may do everything.
    const HAS_ACCESS: bool = true;
    /// Whether a live link gets new keys. Where it does not, a link ends when its keys are worn, and is dialled again.
    const RENEWS_KEYS: bool = true;
    /// Whether requests in datagrams are taken: best-effort ones, and the second copies of emergencies.
    const TAKES_DATAGRAM_REQUESTS: bool = true;
}

/// Slices of a port's storage.
pub type Slice<P, T> = <<P as Port>::Storage as Storage>::Slice<T>;

/// The port of tests without links.
#[cfg(test)]
pub(crate) enum InMemory {}

#[cfg(test)]
impl Port for InMemory {
    type Storage = crate::storage::Boxed;
    type Cipher = super::secure::Plain;
    type Endpoint = core::net::SocketAddr;
}
