//! What a unit sees happen, kept with its time in the unit's log.

use cara_core::distribution::identity::Identity;
use cara_core::error::{CloseReason, Error};
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;

/// Something that happened to a unit.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum UnitEvent {
    /// The unit began a life.
    Started,
    /// The life ended, in an orderly way or not.
    Stopped,
    /// A peer is connected.
    Joined {
        /// The peer.
        peer: Identity,
    },
    /// A connected peer is no longer.
    Left {
        /// The peer.
        peer: Identity,
        /// Why.
        reason: CloseReason,
    },
    /// A link ended before its peer had joined, or another live unit has this one's identity.
    LinkEnded {
        /// Why.
        reason: CloseReason,
    },
    /// The unit's host has lost its interface, has it back, or has another address.
    InterfaceChanged {
        /// It can be used now.
        up: bool,
    },
    /// A peer's list of functions has been read again.
    ListChanged {
        /// The peer.
        peer: Identity,
    },
    /// A service of the unit was called.
    Called {
        /// The function.
        function: String,
        /// The caller.
        caller: Identity,
    },
    /// An asynchronous request failed at the peer.
    Failed {
        /// The peer.
        peer: Identity,
        /// The request, as returned by it.
        id: CallId,
        /// Why.
        error: Error,
    },
    /// A lease on a service of the unit ended without being renewed; its safe hook has run.
    LeaseExpired {
        /// The function.
        function: String,
    },
    /// A lease that the unit held on a function of a peer ended there.
    LeaseEnded {
        /// The peer.
        peer: Identity,
        /// The function; empty where the peer has withdrawn it meanwhile.
        function: String,
        /// The call that held it.
        call: CallId,
        /// Why.
        why: LeaseEnd,
    },
}

impl UnitEvent {
    /// What the trace of a run has of it: the same text whatever types and variants are called.
    pub(super) fn words(&self) -> String {
        match self {
            Self::Started => "started".to_owned(),
            Self::Stopped => "stopped".to_owned(),
            Self::Joined { peer } => format!("{peer} joined"),
            Self::Left { peer, reason } => format!("{peer} left: {reason:?}"),
            Self::LinkEnded { reason } => format!("a link ended: {reason:?}"),
            Self::InterfaceChanged { up } => format!("interface up: {up}"),
            Self::ListChanged { peer } => format!("{peer} has another list"),
            Self::Called { function, caller } => format!("{caller} called {function}"),
            Self::Failed { peer, id, error } => format!("{} failed at {peer}: {error:?}", id.0),
            Self::LeaseExpired { function } => format!("the lease of {function} expired"),
            Self::LeaseEnded { peer, function, call, why } => {
                format!("the lease of {function} at {peer} for {} ended: {why:?}", call.0)
            }
        }
    }
}
