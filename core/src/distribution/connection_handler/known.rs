//! The state of one node.

use super::claims::claim_of;
use super::table::NONE;
use super::timetable::Task;
use crate::distribution::claim::Claim;
use crate::distribution::hello::{ClaimReport, Limits};
use crate::distribution::identity::{Epoch, Identity};
use crate::host::mailman::LinkId;
use crate::time::Instant;

/// The state of one node. `E` is the port's [`Endpoint`](crate::host::endpoint::Endpoint).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Known<E> {
    /// Its name, id and role.
    pub identity: Identity,
    /// The other end of its link; while away, the address from which it was last heard.
    pub address: E,
    /// The connected boot; while away, the newest boot that was heard.
    pub epoch: Epoch,
    /// What it accepts, once it has joined.
    pub limits: Option<Limits>,
    /// The address at which it can be dialled, if known.
    pub(super) listens: Option<E>,
    /// Epoch and sequence number of its newest answer.
    pub(super) newest: Option<(Epoch, u32)>,
    /// The higher claim of another manager of this unit's identity, if the node obeys one.
    pub(super) under: Option<Claim>,
    /// The highest claim with which it has answered since it last joined, and the address.
    pub(super) offered: Option<(Claim, E)>,
    pub(super) state: NodeState,
    /// An s_unit whose last link to this m_unit ended in no orderly way.
    pub(super) is_missing: bool,
    /// Its link was opened from here.
    pub(super) dialed: bool,
    /// The link to it that is being opened.
    pub(super) dialing: Option<LinkId>,
    /// A second link with its identity, which waits until the present one has been challenged.
    pub(super) newcomer: Option<Newcomer<E>>,
    /// When it joined, or was last dialled.
    pub(super) since: Instant,
    /// Dials that have failed in a row.
    pub(super) attempts: u8,
    /// Earliest time to dial this boot of it, after a refusal for a lasting reason.
    pub(super) not_before: Instant,
    pub(super) index: u16,
    pub(super) task: Option<Task>,
    pub(super) due: Instant,
    pub(super) heap: u16,
    pub(super) before: u16,
    pub(super) after: u16,
}

/// A link that waits until the older one with the same identity has been challenged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Newcomer<E> {
    pub(super) link: LinkId,
    pub(super) epoch: Epoch,
    pub(super) claim: Option<ClaimReport>,
    pub(super) limits: Limits,
    pub(super) address: E,
    /// It replaces the older link even if that answers.
    pub(super) decided: bool,
}

impl<E> Newcomer<E> {
    pub(super) fn claim(&self) -> Claim {
        claim_of(self.claim.as_ref())
    }
}

/// Whether a node is connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeState {
    /// Only heard of, or disconnected.
    Away,
    /// A link to it is being opened.
    Dialing,
    /// Connected.
    Joined(LinkId),
}

impl<E> Known<E> {
    /// Whether the node is connected.
    pub const fn is_joined(&self) -> bool {
        matches!(self.state, NodeState::Joined(_))
    }

    /// Whether the node is connected, being dialled, or away.
    pub const fn state(&self) -> NodeState {
        self.state
    }

    /// The claim of the other manager of this unit's identity that the node obeys, so that it refuses this one.
    pub const fn under(&self) -> Option<Claim> {
        self.under
    }

    /// Its address, as last heard.
    pub const fn address(&self) -> &E {
        &self.address
    }

    /// The node's link, while it is connected.
    pub const fn link(&self) -> Option<LinkId> {
        match self.state {
            NodeState::Joined(link) => Some(link),
            NodeState::Away | NodeState::Dialing => None,
        }
    }

    /// Its stable index among the nodes of its role, in the order of joining; `None` if it has never joined. It does not change
    /// while other nodes come and go, or while this one is away.
    pub const fn index(&self) -> Option<u16> {
        if self.index == NONE { None } else { Some(self.index) }
    }

    /// Whether an answer is newer than the last. An earlier boot cannot have answered this unit's question; within a boot
    /// sequence numbers increase, so an equal or lower one is a replay.
    pub(super) fn is_news(&self, epoch: Epoch, sequence: u32) -> bool {
        self.newest.is_none_or(|(newest, last)| newest != epoch || sequence > last)
    }

    pub(super) fn new(identity: Identity, address: E, epoch: Epoch) -> Self {
        Self {
            identity,
            address,
            epoch,
            limits: None,
            listens: None,
            newest: None,
            under: None,
            offered: None,
            state: NodeState::Away,
            is_missing: false,
            dialed: false,
            dialing: None,
            newcomer: None,
            since: Instant::START,
            attempts: 0,
            not_before: Instant::START,
            index: NONE,
            task: None,
            due: Instant::FAR_FUTURE,
            heap: NONE,
            before: NONE,
            after: NONE,
        }
    }
}
