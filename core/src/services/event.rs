//! What a unit reports to its application: one type for all ports.

use crate::distribution::claim::Claim;
use crate::distribution::connection_handler::HandOverStage;
use crate::distribution::identity::Identity;
use crate::error::{CloseReason, Error};
use crate::services::lease::{Latch, LeaseEnd};
use crate::services::requests::CallId;
use crate::services::session::{Event, Session};
use crate::services::{OwnFunctions, Port};

/// Something that no call returned.
///
/// A port chooses how it names a function (`F`), what it says of the network (`N`) and how it addresses nodes (`E`), in an alias:
/// `cara_std::UnitEvent` on Linux, `cara_embassy::UnitEvent` on boards.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum UnitEvent<F, N, E> {
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
    /// A link ended before it joined: refused by either end, silent, or not opened. `DuplicateIdentity` with this unit's own
    /// identity in `peer`: another live unit has it, and one of the two waits until the other is gone.
    NotJoined {
        /// The other end.
        address: E,
        /// The identity that it claimed, or that was dialled.
        peer: Option<Identity>,
        /// Why.
        reason: CloseReason,
    },
    /// A live manager with this m_unit's name and id has a higher claim: this one has stepped down. Its links and orders have
    /// ended, and it does nothing more: stop it. Started again while the other one runs, it fails unless it takes over.
    Fenced {
        /// The higher claim.
        claim: Claim,
    },
    /// This manager has raised its claim above one that vehicles obeyed, whose manager is no longer there.
    Raised {
        /// Its claim.
        claim: Claim,
    },
    /// This m_unit stands by: it has started as a standby, or has stepped down for a live manager of its name and id with this
    /// higher claim. Its links and orders have ended.
    StandsBy {
        /// That manager's claim.
        by: Option<Claim>,
    },
    /// This standby commands from now on: no manager of its name and id answers any more.
    TookCommand {
        /// Its claim.
        claim: Claim,
    },
    /// This manager leads from here on: it alone holds its authority's key, and its claim was made under that. Only on Linux.
    Leading {
        /// Its claim.
        claim: Claim,
    },
    /// This manager does not lead any more. Its links and orders go on; calls that are only for a leader fail.
    NotLeading,
    /// The claim of this manager is obeyed until this unit's next start only: it could not be stored, or not in time. Where the unit
    /// was handed over to this manager, nothing moves until it is stored; if it could not be, the unit goes back. With its own identity,
    /// on boards: an m_unit has not raised its claim, because the higher one could not be stored.
    ClaimNotKept {
        /// The manager.
        peer: Identity,
        /// Its claim.
        claim: Claim,
    },
    /// A vehicle goes over to another manager. On boards at the vehicle only, with the feature `hand-over`.
    HandOver {
        /// At the vehicle the manager that it goes to, or back to; at the manager that it leaves, the vehicle.
        peer: Identity,
        /// How far it is; at the manager always [`HandOverStage::Leaves`].
        stage: HandOverStage,
    },
    /// The networks that this unit can use have changed; it searches again by itself. On Linux also reported if there is none at
    /// the start; on a board the first address is not reported, and links end with each change.
    NetworkChanged {
        /// What can be used now. On Linux the names of the interfaces that are up, including `lo`; with `lo` alone no node on
        /// another host can be found. On a board its address, if it has one.
        up: N,
    },
    /// A node published or withdrew functions.
    ListChanged {
        /// Which.
        peer: Identity,
    },
    /// A node has no capacity for some of this unit's functions.
    FunctionsSkipped {
        /// Which.
        peer: Identity,
        /// How many.
        skipped: u16,
    },
    /// A request without a reply was not run, or its service failed.
    RequestFailed {
        /// The node that was asked.
        peer: Identity,
        /// As returned by the request.
        call: CallId,
        /// Why.
        error: Error,
    },
    /// An order of this unit's service ended because its caller no longer wanted it. Its lease is dead. On a board the safe hook
    /// has run; on Linux it runs on its own thread.
    LeaseExpired {
        /// Its caller.
        peer: Identity,
        /// The service.
        function: F,
    },
    /// A node ended an order of this unit's.
    LeaseEnded {
        /// Which.
        peer: Identity,
        /// The service.
        function: F,
        /// The call that held the lease.
        call: CallId,
        /// Why.
        why: LeaseEnd,
    },
    /// An actuator of a node was stopped, so that no order begins, or was reset. Not reported on boards: there a call fails as
    /// inhibited all the same.
    Inhibited {
        /// Which.
        peer: Identity,
        /// The service.
        function: F,
        /// What inhibits it; `None` after a reset.
        latch: Option<Latch>,
    },
}

impl<F, N, E> UnitEvent<F, N, E> {
    /// The application's event for an event of a link; `None` if the application is not notified of it.
    pub fn of<P: Port<Endpoint = E>>(
        event: Event,
        session: &Session<P>,
        functions: &dyn OwnFunctions,
        name: impl FnOnce(&str) -> F,
    ) -> Option<Self> {
        let Some(peer) = session.peer() else {
            let Event::Closed(reason) = event else { return None };
            return Some(Self::NotJoined { address: session.address(), peer: session.identity().cloned(), reason });
        };
        let peer = || peer.clone();
        let own_name = |slot| functions.function(slot).map_or("", |function| function.name());
        let their_name = |slot| session.their_function_list().function(slot).map_or("", |function| function.name());
        Some(match event {
            Event::Joined => Self::Joined { peer: peer() },
            Event::Closed(reason) => Self::Left { peer: peer(), reason },
            Event::ListChanged => Self::ListChanged { peer: peer() },
            Event::Failed(call, error) => Self::RequestFailed { peer: peer(), call, error },
            Event::LeaseExpired(slot) => Self::LeaseExpired { peer: peer(), function: name(own_name(slot)) },
            Event::LeaseEnded { call, slot, why } => {
                Self::LeaseEnded { peer: peer(), function: name(their_name(slot)), call, why }
            }
            Event::Acknowledged { skipped: 0, .. }
            | Event::Answered
            | Event::Incoming(_)
            | Event::Reply(..)
            | Event::Actuator { .. } => {
                return None;
            }
            Event::Progress(..) | Event::Cancelled(_) => return None,
            Event::Sample(_) | Event::Subscribed(..) => return None,
            Event::Acknowledged { skipped, .. } => Self::FunctionsSkipped { peer: peer(), skipped },
        })
    }
}
