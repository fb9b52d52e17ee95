//! What is known of one node.

use super::table::NONE;
use super::timetable::Task;
use crate::distribution::claim::Claim;
use crate::distribution::hello::{ClaimReport, Limits};
use crate::distribution::identity::{Epoch, Identity};
use crate::host::mailman::LinkId;
use crate::time::Instant;

/// What is known of a node. `E` is the port's [`Endpoint`](crate::host::endpoint::Endpoint).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Known<E> {
    /// Its name, id and role.
    pub identity: Identity,
    /// The other end of its link; while it is away, where it was last heard.
    pub address: E,
    /// The boot that is connected; while it is away, the newest that was heard.
    pub epoch: Epoch,
    /// What it takes, once it has joined.
    pub limits: Option<Limits>,
    /// Where it can be dialled, if that is known.
    pub(super) listens: Option<E>,
    /// The newest answer of it.
    pub(super) newest: Option<(Epoch, u32)>,
    /// It has obeyed this higher claim of another manager of this unit's identity.
    pub(super) under: Option<Claim>,
    /// The highest claim with which it has answered while it was away, and from where.
    pub(super) offered: Option<(Claim, E)>,
    pub(super) state: NodeState,
    /// Its link was opened from here.
    pub(super) dialed: bool,
    /// The link that is being opened to it.
    pub(super) dialing: Option<LinkId>,
    /// A link with its identity that waits for the outcome of the present one's challenge.
    pub(super) newcomer: Option<Newcomer<E>>,
    /// When it joined, or was dialled last.
    pub(super) since: Instant,
    /// Dials that have failed in a row.
    pub(super) attempts: u8,
    /// It has refused for a lasting reason: this boot of it is not dialled earlier.
    pub(super) not_before: Instant,
    pub(super) index: u16,
    pub(super) task: Option<Task>,
    pub(super) due: Instant,
    pub(super) heap: u16,
    pub(super) before: u16,
    pub(super) after: u16,
}

/// A link that waits until the older one of the same identity has been challenged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Newcomer<E> {
    pub(super) link: LinkId,
    pub(super) epoch: Epoch,
    pub(super) claim: Option<ClaimReport>,
    /// It has a higher claim than the one that is connected.
    pub(super) is_higher: bool,
    pub(super) limits: Limits,
    pub(super) address: E,
    /// It takes the place whether the older one answers or not.
    pub(super) decided: bool,
}

/// Whether a node is connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeState {
    /// Heard of, or gone.
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

    /// Whether the node is connected, or about to be.
    pub const fn state(&self) -> NodeState {
        self.state
    }

    /// It is under another manager of this unit's identity, with this claim: it refuses this one.
    pub const fn under(&self) -> Option<Claim> {
        self.under
    }

    /// Where it was heard last.
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

    /// Its place among the nodes of its role, in the order of joining; `None` for a node that has never joined. It keeps
    /// its meaning while other nodes come and go, and while this one is away.
    pub const fn index(&self) -> Option<u16> {
        if self.index == NONE { None } else { Some(self.index) }
    }

    /// Whether an answer is newer than what is known. An earlier boot cannot answer this unit's question; within a boot
    /// sequence numbers rise, so an equal or lower one is a replay.
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
