//! The nodes that this unit knows, in the order in which they first told what they offer: a node keeps its place when
//! another one leaves, and finds it again when it comes back.

use std::borrow::Borrow;
use std::collections::HashMap;
use std::hash::{Hash, Hasher};
use std::net::SocketAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, RwLock, RwLockReadGuard, RwLockWriteGuard};

use cara_core::distribution::identity::{Identity, Role};
use cara_core::error::Error;

use super::keys::Keys;
use super::link::LinkCell;
use super::peer_cell::PeerCell;
use super::roster::Roster;
use crate::keys::KeyRing;
use crate::locks::{Held, Rank};

/// All nodes that have joined.
#[derive(Default)]
pub(crate) struct Peers {
    list: Vec<Arc<PeerCell>>,
    by_identity: HashMap<Named, usize>,
    roster: Roster,
}

/// A node as it is found by its identity, which is not copied for that.
struct Named(Arc<PeerCell>);

impl Borrow<Identity> for Named {
    fn borrow(&self) -> &Identity {
        &self.0.identity
    }
}

impl Hash for Named {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.0.identity.hash(state);
    }
}

impl PartialEq for Named {
    fn eq(&self, other: &Self) -> bool {
        self.0.identity == other.0.identity
    }
}

impl Eq for Named {}

impl Peers {
    /// The node of an identity is connected by `link`. A new one gets the next place, or that of the first node that is
    /// away when there are `limit` of them.
    pub(crate) fn join(&mut self, identity: &Identity, limit: usize, link: &Arc<LinkCell>) -> Arc<PeerCell> {
        let peer = self.of(identity, limit);
        peer.join(link.clone());
        peer
    }

    fn of(&mut self, identity: &Identity, limit: usize) -> Arc<PeerCell> {
        if let Some(peer) = self.placed(identity) {
            return peer.clone();
        }
        let peer = self.roster.take(identity).unwrap_or_else(|| PeerCell::new(identity));
        let away = if self.list.len() < limit { None } else { self.list.iter().position(|peer| !peer.is_connected()) };
        let index = match away.and_then(|index| self.list.get_mut(index).map(|place| (index, place))) {
            Some((index, place)) => {
                self.by_identity.remove(&place.identity);
                place.introduced.store(false, Ordering::Relaxed);
                self.roster.keep(std::mem::replace(place, peer.clone()));
                index
            }
            None => {
                self.list.push(peer.clone());
                self.list.len() - 1
            }
        };
        self.by_identity.insert(Named(peer.clone()), index);
        peer
    }

    /// A node has told what it offers. From then on it keeps its place; the first time, it goes before those of its role that
    /// have never told.
    pub(crate) fn introduce(&mut self, peer: &PeerCell) {
        if peer.introduced.swap(true, Ordering::Relaxed) {
            return;
        }
        let Some(&own) = self.by_identity.get(&peer.identity) else { return };
        let waits = |other: &Arc<PeerCell>| {
            other.identity.role() == peer.identity.role() && !other.introduced.load(Ordering::Relaxed)
        };
        let Some(place) = self.list.iter().take(own).position(waits) else { return };
        self.list.swap(place, own);
        for index in [place, own] {
            self.by_identity.extend(self.list.get(index).map(|peer| (Named(peer.clone()), index)));
        }
    }

    /// The node of an identity that has a place here.
    pub(super) fn placed(&self, identity: &Identity) -> Option<&Arc<PeerCell>> {
        self.list.get(*self.by_identity.get(identity)?)
    }

    pub(super) fn all(&self) -> impl Iterator<Item = &Arc<PeerCell>> {
        self.list.iter()
    }

    /// All nodes of a role, in the order of their places.
    pub(crate) fn of_role(&self, role: Role) -> impl Iterator<Item = &Arc<PeerCell>> {
        self.list.iter().filter(move |peer| peer.identity.role() == role)
    }

    pub(crate) fn connected(&self) -> impl Iterator<Item = &Arc<PeerCell>> {
        self.list.iter().filter(|peer| peer.is_connected())
    }

    /// The s_units of this ring are expected, and no others.
    fn expect(&mut self, ring: &Arc<KeyRing>) {
        self.roster.expect(ring, |identity| self.by_identity.contains_key(identity));
    }

    /// Those that have joined in the order of their places, then the others by name and id.
    fn expected(&self) -> Vec<Arc<PeerCell>> {
        let mut absent: Vec<_> = self.roster.absent().cloned().collect();
        absent.sort_unstable_by(|a, b| a.identity.cmp(&b.identity));
        let placed = self.of_role(Role::SUnit).filter(|peer| self.roster.belongs(&peer.identity)).cloned();
        placed.chain(absent).filter(|peer| !peer.is_retired()).collect()
    }

    /// The only node that is meant, among those that have joined and those that are expected. One that was retired counts
    /// where there is no other.
    fn only(&self, wanted: impl Fn(&Identity) -> bool) -> Result<Arc<PeerCell>, Error> {
        let all = self.all().chain(self.roster.absent());
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

/// The nodes as the threads share them.
#[derive(Default)]
pub(crate) struct Nodes(RwLock<Peers>);

impl Nodes {
    #[track_caller]
    pub(crate) fn read(&self) -> Held<RwLockReadGuard<'_, Peers>> {
        Rank::Leaf.read(&self.0)
    }

    #[track_caller]
    pub(super) fn write(&self) -> Held<RwLockWriteGuard<'_, Peers>> {
        Rank::Leaf.write(&self.0)
    }

    /// The nodes with the roster as the keys are now.
    fn with_roster<R>(&self, keys: &Keys, act: impl FnOnce(&Peers) -> R) -> R {
        let ring = keys.ring().map(|live| live.ring());
        let mut peers = self.write();
        if let Some(ring) = ring {
            peers.expect(&ring);
        }
        act(&peers)
    }

    /// The s_units that this manager is to have.
    pub(crate) fn roster(&self, keys: &Keys) -> Vec<Arc<PeerCell>> {
        self.with_roster(keys, Peers::expected)
    }

    /// A node asks for this manager. Of those that are not expected nothing is kept: anybody may make names up.
    pub(super) fn heard_searching(&self, keys: &Keys, identity: &Identity, from: SocketAddr) {
        if let Some(peer) = self.of(keys, identity) {
            peer.heard_searching(from);
        }
    }

    /// The only node that is meant; [`Error::Ambiguous`] where several are.
    pub(crate) fn only(&self, keys: &Keys, wanted: impl Fn(&Identity) -> bool) -> Result<Arc<PeerCell>, Error> {
        self.with_roster(keys, |peers| peers.only(wanted))
    }

    /// The node of an identity, if it has joined or is expected.
    pub(crate) fn of(&self, keys: &Keys, identity: &Identity) -> Option<Arc<PeerCell>> {
        self.with_roster(keys, |peers| peers.placed(identity).or_else(|| peers.roster.get(identity)).cloned())
    }
}

#[cfg(test)]
mod tests {
    use cara_core::config::Constraints;
    use cara_core::distribution::identity::Fleet;
    use cara_core::error::CloseReason;
    use cara_core::host::mailman::LinkId;
    use cara_core::services::session::{Session, SessionConfig, SessionStorage};
    use cara_core::time::Instant;
    use cara_secure::link::Cipher;

    use super::*;
    use crate::keys::{FleetKeys, RootKey};
    use crate::storage::{filled, filled_with};
    use crate::sys::stream::Stream;

    fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    /// A link that leads nowhere.
    fn link(serial: u32) -> Arc<LinkCell> {
        let listener = crate::sys::stream::Listener::open(std::net::Ipv4Addr::LOCALHOST, 0).unwrap();
        let address = std::net::SocketAddr::from((std::net::Ipv4Addr::LOCALHOST, listener.port()));
        let storage = SessionStorage {
            small: filled(cara_core::config::LINK_BUFFER_BYTES, 0),
            pending: filled(1, None),
            running: filled(2, None),
            publications: filled_with(1, Default::default),
            their_functions: filled_with(1, cara_core::distribution::function_list::Entry::empty),
            their_signatures: filled(64, 0),
        };
        let config =
            SessionConfig { link: LinkId(0), dialed: true, address, nonce: 1, constraints: Constraints::M_UNIT };
        let session = Session::new(Instant::START, config, Cipher::new(cara_core::config::Mode::Plain), storage);
        let session = crate::engine::tape::TapedSession::new(session, None);
        Arc::new(LinkCell::new(0, LinkId(0), serial, Stream::connect(address, false).unwrap(), session, true))
    }

    fn ids(peers: &Peers) -> Vec<u32> {
        peers.of_role(Role::SUnit).map(|peer| peer.identity.id()).collect()
    }

    #[test]
    fn a_node_keeps_its_place_and_its_handle() {
        let mut peers = Peers::default();
        let (old, new) = (link(1), link(2));
        let first = peers.join(&agv(1), 8, &old);
        peers.join(&agv(2), 8, &link(3));
        assert_eq!(first.left(), None);
        first.leave(&old, CloseReason::Silent);
        assert!(!first.is_connected());
        assert_eq!(first.left().unwrap().1, CloseReason::Silent);
        assert_eq!(ids(&peers), [1, 2]);
        let again = peers.join(&agv(1), 8, &new);
        assert!(Arc::ptr_eq(&first, &again) && first.is_connected() && first.left().is_none());
        assert_eq!(ids(&peers), [1, 2]);
    }

    #[test]
    fn the_end_of_an_old_link_does_not_touch_a_newer_one() {
        let mut peers = Peers::default();
        let (old, new) = (link(1), link(2));
        let peer = peers.join(&agv(1), 8, &old);
        peers.join(&agv(1), 8, &new);
        peer.leave(&old, CloseReason::Reset);
        assert!(Arc::ptr_eq(&peer.link().unwrap(), &new));
    }

    #[test]
    fn beyond_the_limit_a_newcomer_gets_the_place_of_one_that_is_away() {
        let mut peers = Peers::default();
        let links = [1, 2, 3].map(link);
        peers.join(&agv(1), 2, &links[0]);
        let second = peers.join(&agv(2), 2, &links[1]);
        second.leave(&links[1], CloseReason::Reset);
        peers.join(&agv(3), 2, &links[2]);
        assert_eq!(ids(&peers), [1, 3]);
        assert!(peers.placed(&agv(2)).is_none());
        assert_eq!(peers.connected().count(), 2);
    }

    /// A node that has told what it offers comes first and stays where it is, whatever those of the other role do.
    #[test]
    fn a_node_that_has_told_goes_before_those_that_have_not() {
        let mut peers = Peers::default();
        let manager = Identity::m_unit("manager", 4).unwrap();
        let units = [agv(1), manager.clone(), agv(2), agv(3)];
        let [first, manager_cell, second, third] = units.map(|unit| peers.join(&unit, 8, &link(unit.id())));
        peers.introduce(&third);
        assert_eq!(ids(&peers), [3, 2, 1]);
        peers.introduce(&manager_cell);
        peers.introduce(&first);
        assert_eq!(ids(&peers), [3, 1, 2]);
        peers.introduce(&second);
        peers.introduce(&third);
        assert_eq!(ids(&peers), [3, 1, 2]);
        for cell in [&first, &manager_cell, &second, &third] {
            assert!(Arc::ptr_eq(peers.placed(&cell.identity).unwrap(), cell));
        }
    }

    /// A node that is connected keeps its place, even if there are more than the limit for a moment.
    #[test]
    fn who_is_connected_keeps_its_place() {
        let mut peers = Peers::default();
        (1..4).for_each(|id| drop(peers.join(&agv(id), 2, &link(id))));
        assert_eq!(ids(&peers), [1, 2, 3]);
    }

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
