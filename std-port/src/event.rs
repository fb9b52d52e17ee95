//! What a unit tells its subscribers.

use cara_core::distribution::identity::Identity;
use cara_core::error::{CloseReason, Error};
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;
use core::net::SocketAddr;

/// Something happened that no call returned.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum UnitEvent {
    /// A node is connected.
    Joined {
        /// Which.
        peer: Identity,
    },
    /// A node is no longer connected.
    Left {
        /// Which.
        peer: Identity,
        /// Why.
        reason: CloseReason,
    },
    /// A link ended before it joined: refused here or there, silent, or it could not be opened. `DuplicateIdentity` with
    /// this unit's own identity in `peer`: another live unit has it, and one of the two waits for the other's end.
    NotJoined {
        /// The other end.
        address: SocketAddr,
        /// The identity that it claimed, or that was expected.
        peer: Option<Identity>,
        /// Why.
        reason: CloseReason,
    },
    /// The interfaces that can be used have changed, or the unit has found none at its start. It searches again by itself.
    InterfacesChanged {
        /// Names of those that are up, `lo` among them. Where there is no other one, no node on another host can be found;
        /// where there is none at all, no node.
        up: Vec<String>,
    },
    /// A node published or withdrew functions.
    ListChanged {
        /// Which.
        peer: Identity,
    },
    /// A node keeps no room for some of this unit's functions.
    FunctionsSkipped {
        /// Which.
        peer: Identity,
        /// How many.
        skipped: u16,
    },
    /// An asynchronous request was not run, or its service failed.
    RequestFailed {
        /// Asked of this node.
        peer: Identity,
        /// As returned by the request.
        call: CallId,
        /// Why.
        error: Error,
    },
    /// A service of this unit stopped because its caller no longer wanted it. Its lease is dead, and its safe hook runs,
    /// or runs as soon as the method that holds the state leaves it.
    LeaseExpired {
        /// Whose call it was.
        peer: Identity,
        /// The service.
        function: String,
    },
    /// A node ended what this unit's call of a leased service started.
    LeaseEnded {
        /// Which.
        peer: Identity,
        /// The service.
        function: String,
        /// The call that held the lease.
        call: CallId,
        /// Why.
        why: LeaseEnd,
    },
}
