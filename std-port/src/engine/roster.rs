//! The roster: the s_units that a manager is to have, whether they are connected or not. A secured manager expects those that
//! its keys name; a plain one those that have joined since its start.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use cara_core::distribution::identity::{Identity, Role};

use super::peer_cell::PeerCell;
use crate::keys::KeyRing;

/// Most nodes of a plain manager that are expected beyond those that have a place: names cost nothing there, so that
/// a host that joins under many would take up memory without end.
const MOST_ABSENT: usize = 4096;

/// The nodes that are expected and have no place among those that have joined.
#[derive(Default)]
pub(super) struct Roster {
    absent: HashMap<Identity, Arc<PeerCell>>,
    keyed: Option<Keyed>,
}

/// The s_units of the keys that a manager has now.
struct Keyed {
    ring: Arc<KeyRing>,
    s_units: HashSet<Identity>,
}

impl Roster {
    /// The node of an identity, which gets a place.
    pub(super) fn take(&mut self, identity: &Identity) -> Option<Arc<PeerCell>> {
        self.absent.remove(identity)
    }

    /// A node has lost its place to another one.
    pub(super) fn keep(&mut self, peer: Arc<PeerCell>) {
        if peer.identity.role() != Role::SUnit || !self.belongs(&peer.identity) {
            return;
        }
        if self.absent.len() >= MOST_ABSENT && self.keyed.is_none() {
            tracing::warn!(node = %peer.identity, "more s_units have joined than a roster holds: it is not expected any more");
            return;
        }
        self.absent.insert(peer.identity.clone(), peer);
    }

    pub(super) fn belongs(&self, identity: &Identity) -> bool {
        self.keyed.as_ref().is_none_or(|keyed| keyed.s_units.contains(identity))
    }

    /// The s_units of this ring are expected, and no others.
    pub(super) fn expect(&mut self, ring: &Arc<KeyRing>, is_placed: impl Fn(&Identity) -> bool) {
        if self.keyed.as_ref().is_some_and(|keyed| Arc::ptr_eq(&keyed.ring, ring)) {
            return;
        }
        let peers = ring.peers().into_iter();
        let s_units: HashSet<Identity> = peers.filter(|peer| peer.role() == Role::SUnit).cloned().collect();
        self.absent.retain(|identity, _| s_units.contains(identity));
        for identity in s_units.iter().filter(|identity| !is_placed(identity)).cloned().collect::<Vec<_>>() {
            self.absent.entry(identity).or_insert_with_key(PeerCell::new);
        }
        self.keyed = Some(Keyed { ring: ring.clone(), s_units });
    }

    /// Those that are expected and have no place.
    pub(super) fn absent(&self) -> impl Iterator<Item = &Arc<PeerCell>> {
        self.absent.values()
    }

    pub(super) fn get(&self, identity: &Identity) -> Option<&Arc<PeerCell>> {
        self.absent.get(identity)
    }
}
