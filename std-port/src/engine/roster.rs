//! The roster: the s_units that a manager is to have, whether they are connected or not. A secured manager expects those that
//! its keys name; a plain one those that have joined since its start.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use cara_core::distribution::identity::{Identity, Role};
use cara_core::error::Error;

use super::Engine;
use super::peers::{PeerCell, Peers};
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

    fn belongs(&self, identity: &Identity) -> bool {
        self.keyed.as_ref().is_none_or(|keyed| keyed.s_units.contains(identity))
    }
}

impl Peers {
    /// The s_units of this ring are expected, and no others.
    fn expect(&mut self, ring: &Arc<KeyRing>) {
        if self.roster.keyed.as_ref().is_some_and(|keyed| Arc::ptr_eq(&keyed.ring, ring)) {
            return;
        }
        let peers = ring.peers().into_iter();
        let s_units: HashSet<Identity> = peers.filter(|peer| peer.role() == Role::SUnit).cloned().collect();
        self.roster.absent.retain(|identity, _| s_units.contains(identity));
        for identity in s_units.iter().filter(|identity| self.placed(identity).is_none()).cloned().collect::<Vec<_>>() {
            self.roster.absent.entry(identity).or_insert_with_key(PeerCell::new);
        }
        self.roster.keyed = Some(Keyed { ring: ring.clone(), s_units });
    }

    /// Those that have joined in the order of their places, then the others by name and id.
    fn expected(&self) -> Vec<Arc<PeerCell>> {
        let mut absent: Vec<_> = self.roster.absent.values().cloned().collect();
        absent.sort_unstable_by(|a, b| a.identity.cmp(&b.identity));
        let placed = self.of_role(Role::SUnit).filter(|peer| self.roster.belongs(&peer.identity)).cloned();
        placed.chain(absent).filter(|peer| !peer.is_retired()).collect()
    }

    /// The only node that is meant, among those that have joined and those that are expected. One that was retired counts
    /// where there is no other.
    fn only(&self, wanted: impl Fn(&Identity) -> bool) -> Result<Arc<PeerCell>, Error> {
        let all = self.all().chain(self.roster.absent.values());
        let mut meant: Vec<_> = all.filter(|peer| wanted(&peer.identity)).collect();
        if meant.len() > 1 {
            meant.retain(|peer| !peer.is_retired());
        }
        meant.sort_unstable_by(|a, b| a.identity.cmp(&b.identity));
        match meant.as_slice() {
            [only] if only.has_joined() => Ok(Arc::clone(only)),
            [] | [_] => Err(Error::NotConnected),
            [first, second, ..] => Err(Error::Ambiguous { ids: [first.identity.id(), second.identity.id()] }),
        }
    }
}

impl<T: Send + 'static> Engine<T> {
    /// The nodes with the roster as the keys are now.
    fn with_roster<R>(&self, act: impl FnOnce(&Peers) -> R) -> R {
        let ring = self.keys().ring().map(|live| live.ring());
        let mut peers = self.peers_mut();
        if let Some(ring) = ring {
            peers.expect(&ring);
        }
        act(&peers)
    }

    /// The s_units that this manager is to have.
    pub(crate) fn roster(&self) -> Vec<Arc<PeerCell>> {
        self.with_roster(Peers::expected)
    }

    /// The only node that is meant; [`Error::Ambiguous`] where several are.
    pub(crate) fn only_node(&self, wanted: impl Fn(&Identity) -> bool) -> Result<Arc<PeerCell>, Error> {
        self.with_roster(|peers| peers.only(wanted))
    }

    /// The node of an identity, if it has joined or is expected.
    pub(crate) fn node_of(&self, identity: &Identity) -> Option<Arc<PeerCell>> {
        self.with_roster(|peers| peers.placed(identity).or_else(|| peers.roster.absent.get(identity)).cloned())
    }
}

#[cfg(test)]
mod tests {
    use super::super::peers::tests::{agv, link};
    use super::*;
    use crate::keys::{FleetKeys, RootKey};
    use cara_core::distribution::identity::Fleet;
    use cara_core::error::CloseReason;

    fn expected(peers: &Peers) -> Vec<u32> {
        peers.expected().iter().map(|peer| peer.identity.id()).collect()
    }

    fn ring(s_units: &[Identity]) -> Arc<KeyRing> {
        let mut keys = FleetKeys::of_root(Fleet(7), RootKey::new([1; 32]));
        let depot = Identity::m_unit("depot", 1).unwrap();
        keys.add(&depot, &[]).unwrap();
        s_units.iter().for_each(|agv| keys.add(agv, &[]).unwrap());
        Arc::new(keys.ring(&depot).unwrap())
    }

    #[test]
    fn in_plain_mode_who_has_joined_stays_expected_also_without_a_place() {
        let mut peers = Peers::default();
        assert!(expected(&peers).is_empty());
        let old = link(1);
        let first = peers.join(&agv(1), 1, &old);
        first.leave(&old, CloseReason::Silent);
        peers.join(&agv(2), 1, &link(2));
        assert!(peers.placed(&agv(1)).is_none(), "its place is taken");
        assert_eq!(expected(&peers), [2, 1]);
        let again = peers.join(&agv(1), 2, &link(3));
        assert!(Arc::ptr_eq(&first, &again), "its handle works again");
        assert_eq!(expected(&peers), [2, 1]);
    }

    #[test]
    fn with_keys_those_are_expected_that_they_name() {
        let mut peers = Peers::default();
        peers.expect(&ring(&[agv(1), agv(2)]));
        assert_eq!(expected(&peers), [1, 2]);
        let handle = peers.expected().remove(1);
        peers.join(&agv(2), 8, &link(1));
        assert_eq!(expected(&peers), [2, 1]);
        assert!(handle.is_connected(), "a handle from before works once the node has joined");
        // One is revoked, and one is added.
        peers.expect(&ring(&[agv(1), agv(3)]));
        assert_eq!(expected(&peers), [1, 3]);
    }

    #[test]
    fn what_is_retired_is_not_expected_until_it_joins_again() {
        let mut peers = Peers::default();
        peers.expect(&ring(&[agv(1), agv(2)]));
        let first = peers.join(&agv(1), 8, &link(1));
        assert!(!first.retire(), "it is connected");
        assert!(peers.expected().last().unwrap().retire());
        assert_eq!(expected(&peers), [1]);
        peers.expect(&ring(&[agv(1), agv(2), agv(3)]));
        assert_eq!(expected(&peers), [1, 3], "other keys do not bring it back");
        peers.join(&agv(2), 8, &link(2));
        assert_eq!(expected(&peers), [1, 2, 3]);
    }

    /// Which one is meant is never guessed, also not where one alone is connected.
    #[test]
    fn a_name_that_several_have_is_refused() {
        let mut peers = Peers::default();
        peers.expect(&ring(&[agv(7), agv(8)]));
        let named = |peers: &Peers| peers.only(|identity| identity.name() == "agv").map(|peer| peer.identity.id());
        assert_eq!(named(&peers), Err(Error::Ambiguous { ids: [7, 8] }));
        peers.join(&agv(7), 8, &link(1));
        assert_eq!(named(&peers), Err(Error::Ambiguous { ids: [7, 8] }), "the other one may be meant");
        assert!(peers.expected().last().unwrap().retire());
        assert_eq!(named(&peers), Ok(7));
        peers.expect(&ring(&[agv(7)]));
        assert_eq!(named(&peers), Ok(7));
        assert_eq!(peers.only(|identity| identity.id() == 9).err(), Some(Error::NotConnected));
    }
}
