//! The table of nodes: lent slots in the order of joining, an index by identity, and one by link.

use core::net::SocketAddr;

use crate::distribution::hello::Limits;
use crate::distribution::identity::{Epoch, Identity};
use crate::host::mailman::LinkId;
use crate::storage::Storage;
use crate::time::Instant;

/// What is known of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Known {
    /// Its name, id and role.
    pub identity: Identity,
    /// Where it was last heard: for a listener the address to dial, otherwise the other end of its link.
    pub address: SocketAddr,
    /// The newest life of it that was heard.
    pub epoch: Epoch,
    /// What it takes, once it has joined.
    pub limits: Option<Limits>,
    pub(super) sequence: u32,
    pub(super) state: NodeState,
    pub(super) dial: Option<Instant>,
    pub(super) attempts: u8,
}

/// Whether a node is connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeState {
    /// Heard of, or gone.
    Away,
    /// A link to it is being opened.
    Dialing(LinkId),
    /// Connected.
    Joined(LinkId),
}

impl Known {
    /// Whether the node is connected.
    pub const fn is_joined(&self) -> bool {
        matches!(self.state, NodeState::Joined(_))
    }

    /// Whether the node is connected, or about to be.
    pub const fn state(&self) -> NodeState {
        self.state
    }

    pub(super) const fn attempts(&self) -> u8 {
        self.attempts
    }
}

pub(super) struct Table<S: Storage> {
    nodes: S::Slice<Option<Known>>,
    /// Places of the nodes, ordered by identity; the first `len` count.
    order: S::Slice<u16>,
    len: usize,
    links: S::Slice<Option<u16>>,
    joined: usize,
    /// No node is to be dialled earlier.
    next_dial: Instant,
}

impl<S: Storage> Table<S> {
    pub(super) fn new(nodes: S::Slice<Option<Known>>, order: S::Slice<u16>, links: S::Slice<Option<u16>>) -> Self {
        Self { nodes, order, len: 0, links, joined: 0, next_dial: Instant::FAR_FUTURE }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Known> {
        self.nodes.iter().flatten()
    }

    pub(super) fn node(&self, place: usize) -> Option<&Known> {
        self.nodes.get(place)?.as_ref()
    }

    pub(super) fn node_mut(&mut self, place: usize) -> Option<&mut Known> {
        self.nodes.get_mut(place)?.as_mut()
    }

    pub(super) const fn joined(&self) -> usize {
        self.joined
    }

    pub(super) fn of_link(&self, link: LinkId) -> Option<usize> {
        self.links.get(usize::from(link.0)).copied().flatten().map(usize::from)
    }

    pub(super) fn find(&self, identity: &Identity) -> Option<usize> {
        let at = self.search(identity).ok()?;
        self.order.get(at).copied().map(usize::from)
    }

    fn search(&self, identity: &Identity) -> Result<usize, usize> {
        let order = self.order.get(..self.len).unwrap_or(&[]);
        order.binary_search_by(|&place| match self.node(usize::from(place)) {
            Some(known) => known.identity.cmp(identity),
            None => core::cmp::Ordering::Less,
        })
    }

    /// The place of an identity, new if need be; `true` when another node that was away had to be forgotten for it.
    /// `None` when every place is taken by a connected node.
    pub(super) fn place_of(&mut self, identity: &Identity, address: SocketAddr, epoch: Epoch) -> Option<(usize, bool)> {
        if let Some(place) = self.find(identity) {
            return Some((place, false));
        }
        let (place, forgotten) = match self.nodes.iter().position(Option::is_none) {
            Some(place) => (place, false),
            None => {
                let place = self.nodes.iter().flatten().position(|known| known.state == NodeState::Away)?;
                self.remove(place);
                (place, true)
            }
        };
        let at = self.search(identity).err()?;
        let end = self.len.checked_add(1)?;
        let order = self.order.get_mut(at..end)?;
        order.rotate_right(1);
        *order.first_mut()? = u16::try_from(place).ok()?;
        *self.nodes.get_mut(place)? = Some(Known {
            identity: identity.clone(),
            address,
            epoch,
            limits: None,
            sequence: 0,
            state: NodeState::Away,
            dial: None,
            attempts: 0,
        });
        self.len = end;
        Some((place, forgotten))
    }

    fn remove(&mut self, place: usize) {
        let Some(identity) = self.node(place).map(|known| known.identity.clone()) else { return };
        if let Ok(at) = self.search(&identity)
            && let Some(order) = self.order.get_mut(at..self.len)
        {
            order.rotate_left(1);
            self.len = self.len.saturating_sub(1);
        }
        if let Some(slot) = self.nodes.get_mut(place) {
            *slot = None;
        }
    }

    /// Notes which link a node has.
    pub(super) fn set_link(&mut self, place: usize, link: LinkId, state: NodeState) {
        let Some(known) = self.nodes.get_mut(place).and_then(Option::as_mut) else { return };
        let was_joined = known.is_joined();
        known.state = state;
        known.dial = None;
        if known.is_joined() {
            known.attempts = 0;
        }
        match (was_joined, known.is_joined()) {
            (false, true) => self.joined = self.joined.saturating_add(1),
            (true, false) => self.joined = self.joined.saturating_sub(1),
            _ => {}
        }
        if let Some(slot) = self.links.get_mut(usize::from(link.0)) {
            *slot = u16::try_from(place).ok();
        }
    }

    /// The link has ended; a node that has a newer one keeps it.
    pub(super) fn leave(&mut self, place: usize, link: LinkId) {
        if let Some(slot) = self.links.get_mut(usize::from(link.0)) {
            *slot = None;
        }
        let Some(known) = self.nodes.get_mut(place).and_then(Option::as_mut) else { return };
        match known.state {
            NodeState::Joined(current) if current == link => self.joined = self.joined.saturating_sub(1),
            NodeState::Dialing(current) if current == link => known.attempts = known.attempts.saturating_add(1),
            _ => return,
        }
        known.state = NodeState::Away;
    }

    pub(super) fn dial_later(&mut self, place: usize, at: Instant) {
        let Some(known) = self.nodes.get_mut(place).and_then(Option::as_mut) else { return };
        if known.state == NodeState::Away && known.dial.is_none_or(|earlier| at < earlier) {
            known.dial = Some(at);
            self.next_dial = self.next_dial.min(at);
        }
    }

    pub(super) const fn next_dial(&self) -> Instant {
        self.next_dial
    }

    /// A node whose time to be dialled has come.
    pub(super) fn take_due_dial(&mut self, now: Instant) -> Option<(SocketAddr, Identity)> {
        if now < self.next_dial {
            return None;
        }
        for known in self.nodes.iter_mut().flatten() {
            if known.state == NodeState::Away && known.dial.take_if(|at| *at <= now).is_some() {
                return Some((known.address, known.identity.clone()));
            }
        }
        let dials = self.nodes.iter().flatten().filter_map(|known| known.dial);
        self.next_dial = dials.min().unwrap_or(Instant::FAR_FUTURE);
        None
    }
}
