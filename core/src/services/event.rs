//! What a unit tells its application: one type for all ports.

use crate::distribution::claim::Claim;
use crate::distribution::identity::Identity;
use crate::error::{CloseReason, Error};
use crate::services::lease::{Latch, LeaseEnd};
use crate::services::requests::CallId;
use crate::services::session::{Event, Session};
use crate::services::{OwnFunctions, Port};

/// Something happened that no call returned.
///
/// A port fills in how it names a function (`F`), what can be used of the network (`N`) and how it addresses nodes (`E`),
/// and gives the whole a short name: a program for Linux sees `cara_std::UnitEvent`, one for a board `cara_embassy::UnitEvent`.
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
    /// A link ended before it joined: refused here or there, silent, or it could not be opened. `DuplicateIdentity` with
    /// this unit's own identity in `peer`: another live unit has it, and one of the two waits for the other's end.
    NotJoined {
        /// The other end.
        address: E,
        /// The identity that it claimed, or is expected to have.
        peer: Option<Identity>,
        /// Why.
        reason: CloseReason,
    },
    /// A live manager with this m_unit's name and id and a higher claim has shown itself: this one has stepped down. Its links
    /// have ended, and with them what it ordered; it does nothing more, and is to be stopped. Where it is started again while
    /// the other one runs, it does not start unless it is to take over.
    Fenced {
        /// The higher claim.
        claim: Claim,
    },
    /// This manager has raised its claim above one that vehicles obeyed and whose manager is not there any more.
    Raised {
        /// Its claim.
        claim: Claim,
    },
    /// This m_unit stands by: it has just started, or has stepped down for a live manager of its name and id with this higher
    /// claim. Its links have ended, and with them what it ordered.
    StandsBy {
        /// That manager's claim.
        by: Option<Claim>,
    },
    /// This standby commands from here on: no manager of its name and id is there any more.
    TookCommand {
        /// Its claim.
        claim: Claim,
    },
    /// The claim of this manager is obeyed until this unit's next start only: it could not be stored, or not in time.
    ClaimNotKept {
        /// The manager.
        peer: Identity,
        /// Its claim.
        claim: Claim,
    },
    /// The network that this unit can use has changed, and it searches again by itself. On Linux also when the unit finds
    /// none at its start; a board's first address is not reported, and its links have ended.
    NetworkChanged {
        /// What can be used now. On Linux the names of the interfaces that are up, `lo` among them: where there is no other
        /// one, no node on another host can be found. On a board its address, if it has one.
        up: N,
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
    /// A service of this unit stopped because its caller no longer wanted it. Its lease is dead. On a board its safe hook
    /// has run; on Linux it runs, on a thread of its own.
    LeaseExpired {
        /// Its caller.
        peer: Identity,
        /// The service.
        function: F,
    },
    /// A node ended what this unit's call of a leased service started.
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
    /// What a service of a node moves was stopped, so that no order begins, or has been reset. Boards are not told: a call
    /// is refused as inhibited all the same.
    Inhibited {
        /// Which.
        peer: Identity,
        /// The service.
        function: F,
        /// What inhibits it; `None` once it has been reset.
        latch: Option<Latch>,
    },
}

impl<F, N, E> UnitEvent<F, N, E> {
    /// What the application is told of an event on a link; `None` where it is told nothing.
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
