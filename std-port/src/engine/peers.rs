//! The nodes that this unit knows, in the order in which they joined: a node keeps its place when another one leaves,
//! and finds it again when it comes back.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use cara_core::distribution::identity::{Identity, Role};

use super::link::LinkCell;

/// A node, connected or not.
pub(crate) struct PeerCell {
    pub(crate) identity: Identity,
    link: Mutex<Option<Arc<LinkCell>>>,
}

impl PeerCell {
    /// The link to the node while it is connected.
    pub(crate) fn link(&self) -> Option<Arc<LinkCell>> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn is_connected(&self) -> bool {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    fn join(&self, link: Arc<LinkCell>) {
        *self.link.lock().unwrap_or_else(PoisonError::into_inner) = Some(link);
    }

    /// The link has ended; a newer one stays.
    pub(crate) fn leave(&self, link: &LinkCell) {
        let mut current = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if current.as_ref().is_some_and(|current| current.serial == link.serial) {
            *current = None;
        }
    }
}

/// All nodes that have joined.
#[derive(Default)]
pub(crate) struct Peers {
    list: Vec<Arc<PeerCell>>,
    by_identity: HashMap<Identity, usize>,
}

impl Peers {
    /// The node of an identity is connected by `link`. A new one gets the next place, or that of the first node that is
    /// away when there are `limit` of them.
    pub(crate) fn join(&mut self, identity: &Identity, limit: usize, link: &Arc<LinkCell>) -> Arc<PeerCell> {
        let peer = self.of(identity, limit);
        peer.join(link.clone());
        peer
    }

    fn of(&mut self, identity: &Identity, limit: usize) -> Arc<PeerCell> {
        if let Some(peer) = self.by_identity.get(identity).and_then(|&index| self.list.get(index)) {
            return peer.clone();
        }
        let peer = Arc::new(PeerCell { identity: identity.clone(), link: Mutex::new(None) });
        let away = if self.list.len() < limit { None } else { self.list.iter().position(|peer| !peer.is_connected()) };
        let index = match away.and_then(|index| self.list.get_mut(index).map(|place| (index, place))) {
            Some((index, place)) => {
                self.by_identity.remove(&place.identity);
                *place = peer.clone();
                index
            }
            None => {
                self.list.push(peer.clone());
                self.list.len() - 1
            }
        };
        self.by_identity.insert(identity.clone(), index);
        peer
    }

    pub(crate) fn find(&self, wanted: impl Fn(&Identity) -> bool) -> Option<Arc<PeerCell>> {
        self.list.iter().find(|peer| wanted(&peer.identity)).cloned()
    }

    /// All nodes of a role, in the order of their places.
    pub(crate) fn of_role(&self, role: Role) -> impl Iterator<Item = &Arc<PeerCell>> {
        self.list.iter().filter(move |peer| peer.identity.role() == role)
    }

    pub(crate) fn connected(&self) -> impl Iterator<Item = &Arc<PeerCell>> {
        self.list.iter().filter(|peer| peer.is_connected())
    }
}
