//! The nodes that this unit knows, in the order in which they first told what they offer: a node keeps its place when
//! another one leaves, and finds it again when it comes back.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use cara_core::config::Constraints;
use cara_core::counters::Counters;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::error::{CloseReason, Error};
use cara_core::host::connections::LinkCounter;
use cara_core::services::requests::CallId;
use cara_core::time::Duration;

use super::link::LinkCell;
use super::roster::Roster;
use crate::locks::lock;

/// The counters of a link, or of many.
pub(crate) type LinkCounters = Counters<LinkCounter, { LinkCounter::COUNT }>;

/// A node, connected or not.
pub(crate) struct PeerCell {
    pub(crate) identity: Identity,
    link: Mutex<Option<Arc<LinkCell>>>,
    /// When it joined last.
    joined: Mutex<Option<std::time::Instant>>,
    /// When and why its last link ended.
    left: Mutex<Option<(std::time::Instant, CloseReason)>>,
    /// What differs for this node from the unit's constraints, whether it is connected or not.
    own: Mutex<Option<OwnConstraints>>,
    /// The newest call of each function that was to move something, and the link that it was made by.
    orders: Mutex<BTreeMap<String, (u32, CallId)>>,
    /// Its streams that are read here.
    pub(super) streams: Mutex<HashMap<String, Arc<super::streams::Watched>>>,
    /// What its earlier links have counted.
    earlier: Mutex<Option<Box<LinkCounters>>>,
    /// It has told what it offers since it has its place, on this link or an earlier one.
    introduced: AtomicBool,
    /// The operator has taken it off the roster.
    retired: AtomicBool,
}

/// The constraints that a node may have of its own.
#[derive(Clone, Copy)]
struct OwnConstraints {
    request_timeout: Duration,
    minimum_interval: Duration,
    calls_per_peer: u16,
}

impl PeerCell {
    /// The link to the node while it is connected.
    pub(crate) fn link(&self) -> Option<Arc<LinkCell>> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn is_connected(&self) -> bool {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// How long it has been connected.
    pub(crate) fn connected_for(&self) -> Option<std::time::Duration> {
        self.link()?;
        lock(&self.joined).map(|joined| joined.elapsed())
    }

    /// How long ago it left, and why, while it is not connected.
    pub(crate) fn left(&self) -> Option<(std::time::Duration, CloseReason)> {
        let left = *lock(&self.left);
        left.filter(|_| !self.is_connected()).map(|(at, reason)| (at.elapsed(), reason))
    }

    /// Whether it is connected and what it offers is known.
    pub(crate) fn is_introduced(&self) -> bool {
        self.link().is_some_and(|link| link.is_introduced())
    }

    /// The unit's constraints with what this node has of its own.
    pub(crate) fn constraints(&self, unit: Constraints) -> Constraints {
        self.own_constraints(unit).unwrap_or(unit)
    }

    pub(super) fn own_constraints(&self, unit: Constraints) -> Option<Constraints> {
        let own = (*lock(&self.own))?;
        let OwnConstraints { request_timeout, minimum_interval, calls_per_peer } = own;
        Some(Constraints { request_timeout, minimum_interval, calls_per_peer, ..unit })
    }

    /// [`Error::BadConstraint`] for what cannot differ from node to node.
    pub(super) fn set_constraints(&self, unit: Constraints, wanted: Constraints) -> Result<(), Error> {
        let Constraints { request_timeout, minimum_interval, calls_per_peer, .. } = wanted;
        if wanted != (Constraints { request_timeout, minimum_interval, calls_per_peer, ..unit }) {
            return Err(Error::BadConstraint);
        }
        *lock(&self.own) = Some(OwnConstraints { request_timeout, minimum_interval, calls_per_peer });
        Ok(())
    }

    pub(super) fn new(identity: &Identity) -> Arc<Self> {
        Arc::new(Self {
            identity: identity.clone(),
            link: Mutex::new(None),
            joined: Mutex::new(None),
            left: Mutex::new(None),
            own: Mutex::new(None),
            orders: Mutex::default(),
            streams: Mutex::default(),
            earlier: Mutex::new(None),
            introduced: AtomicBool::new(false),
            retired: AtomicBool::new(false),
        })
    }

    /// Whether it has ever joined.
    pub(super) fn has_joined(&self) -> bool {
        lock(&self.joined).is_some()
    }

    /// Whether it has been taken off the roster, and has not joined since.
    pub(crate) fn is_retired(&self) -> bool {
        self.retired.load(Ordering::Relaxed)
    }

    /// Takes it off the roster until it joins again; `false` while it is connected.
    pub(crate) fn retire(&self) -> bool {
        let link = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if link.is_none() {
            self.retired.store(true, Ordering::Relaxed);
        }
        link.is_none()
    }

    /// A call that is to move something goes out.
    pub(super) fn ordered(&self, function: &str, link: u32, call: CallId) {
        let mut orders = lock(&self.orders);
        match orders.get_mut(function) {
            Some(known) => *known = (link, call),
            None => drop(orders.insert(function.to_owned(), (link, call))),
        }
    }

    /// The newest call of a function that was to move something, and the link that it was made by.
    pub(crate) fn last_order(&self, function: &str) -> Option<(u32, CallId)> {
        lock(&self.orders).get(function).copied()
    }

    pub(super) fn earlier(&self) -> LinkCounters {
        lock(&self.earlier).as_deref().cloned().unwrap_or_default()
    }

    pub(super) fn keep(&self, counters: &LinkCounters) {
        lock(&self.earlier).get_or_insert_default().merge(counters);
    }

    fn join(&self, link: Arc<LinkCell>) {
        *lock(&self.joined) = Some(std::time::Instant::now());
        let mut current = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        self.retired.store(false, Ordering::Relaxed);
        *current = Some(link);
    }

    /// The link has ended; a newer one stays.
    pub(crate) fn leave(&self, link: &LinkCell, reason: CloseReason) {
        let mut current = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if current.as_ref().is_some_and(|current| current.serial == link.serial) {
            *lock(&self.left) = Some((std::time::Instant::now(), reason));
            *current = None;
        }
    }
}

/// All nodes that have joined.
#[derive(Default)]
pub(crate) struct Peers {
    list: Vec<Arc<PeerCell>>,
    by_identity: HashMap<Identity, usize>,
    pub(super) roster: Roster,
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
        self.by_identity.insert(identity.clone(), index);
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
            self.by_identity.extend(self.list.get(index).map(|peer| (peer.identity.clone(), index)));
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
}

#[cfg(test)]
pub(super) mod tests {

    use cara_core::host::mailman::LinkId;
    use cara_core::services::session::{Session, SessionConfig, SessionStorage};
    use cara_core::time::Instant;
    use cara_secure::link::Cipher;

    use super::*;
    use crate::storage::{filled, filled_with};
    use crate::sys::stream::Stream;

    pub(crate) fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    /// A link that leads nowhere.
    pub(crate) fn link(serial: u32) -> Arc<LinkCell> {
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
}
