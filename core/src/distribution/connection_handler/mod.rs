//! The paper's `Connection_handler`: finds nodes, decides which links are taken, and holds what is known of each node.
//!
//! A [`Node`] is one unit's membership. It knows links by their ids only; what travels on them is the sessions' matter.
//! The port polls it, gives it the datagrams that arrive, asks it about each hello ([`Node::admit`]) and tells it when a
//! link has ended ([`Node::left`]). What is to be done comes back as [`Action`]s.
//!
//! # Discovery (paper, section 2: "it works like the Address Resolution Protocol")
//! - An s_unit broadcasts a who-has for its manager, waits longer and longer between two, and dials the one that answers.
//!   When it hears another unit ask for the same manager it holds its own question back: the manager answers two with
//!   one broadcast.
//! - An m_unit broadcasts a who-has for everybody. Its own s_units dial it, after a random delay; of two m_units the
//!   smaller identity dials.

mod admission;
mod search;
mod table;

pub use admission::Admission;
pub use table::{Known, NodeState};

use core::net::SocketAddr;

use crate::config::{Constraints, FIRST_SEARCH, LONGEST_SEARCH, NODE_NAME_BYTES};
use crate::counters::Counters;
use crate::distribution::datagram::{Datagram, DatagramError};
use crate::distribution::hello::{Hello, Limits, Manager};
use crate::distribution::identity::{Epoch, Fleet, Identity, Role};
use crate::error::{CloseReason, Error, Refusal};
use crate::host::mailman::{LinkId, Mailman};
use crate::random::Random;
use crate::storage::Storage;
use crate::time::{Duration, Instant};
use admission::Challenge;
use search::{Answers, Budget, Search};
use table::Table;

crate::counters::counters! {
    /// What a unit counts about discovery and membership.
    pub enum NodeCounter {
        /// Datagrams of another mode, or of no unit at all.
        DatagramMagic,
        /// Datagrams of another version.
        DatagramVersion,
        /// Datagrams of another fleet.
        DatagramFleet,
        /// Datagrams that could not be read.
        DatagramMalformed,
        /// Session datagrams for links that this unit does not have.
        DatagramUnknownLink,
        /// Searches sent.
        WhoHasSent,
        /// Searches of others heard.
        WhoHasHeard,
        /// Own searches put off because enough were heard.
        WhoHasDeferred,
        /// Answers sent to one node.
        AnnounceSent,
        /// Answers sent to all.
        AnnounceBroadcast,
        /// Answers heard.
        AnnounceHeard,
        /// Answers put off because too many waited already.
        AnnounceDropped,
        /// Datagrams older than what is known of their sender.
        Outdated,
        /// Searches for, and hellos to, another manager.
        WrongManager,
        /// Datagrams of another unit with this unit's own identity.
        OwnIdentity,
        /// Links dialled.
        Dialled,
        /// Links taken.
        Joined,
        /// Links refused because of their version.
        RefusedVersion,
        /// Links refused because of their fleet.
        RefusedFleet,
        /// Links refused because of their role.
        RefusedRole,
        /// Links refused because as many nodes are connected as may be.
        RefusedFull,
        /// Links refused because a live node has the same identity.
        RefusedDuplicate,
        /// Links refused because the two are connected already.
        RefusedConnected,
        /// Nodes that came back with a new epoch.
        Restarted,
        /// Nodes forgotten to make room.
        Forgotten,
    }
}

/// Whom a unit wants to reach.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Target {
    /// Every m_unit, and the s_units that belong to this one.
    Everybody,
    /// The one manager of an s_unit, wherever it is.
    Manager(Manager),
    /// The one manager of an s_unit, at a fixed address: no broadcasts.
    Fixed(Manager, SocketAddr),
}

impl Manager {
    /// A manager's name and id; [`Error::BadName`] for a name that is empty or longer than [`NODE_NAME_BYTES`].
    pub fn new(name: &str, id: u32) -> Result<Self, Error> {
        if name.is_empty() || name.len() > NODE_NAME_BYTES {
            return Err(Error::BadName);
        }
        Ok(Self { name: heapless::String::try_from(name).map_err(|_| Error::BadName)?, id })
    }

    /// Whether an identity is this manager's.
    pub fn is(&self, identity: &Identity) -> bool {
        identity.role() == Role::MUnit && identity.id() == self.id && identity.name() == self.name
    }
}

/// What a node is told when it is made.
#[derive(Clone, Debug)]
pub struct NodeConfig {
    /// Its identity.
    pub identity: Identity,
    /// Its fleet.
    pub fleet: Fleet,
    /// This life of it; must differ from boot to boot.
    pub epoch: Epoch,
    /// Whom it wants to reach.
    pub target: Target,
    /// Where it can be dialled; 0 for nowhere.
    pub tcp_port: u16,
    /// Where its session datagrams go; 0 for nowhere.
    pub udp_port: u16,
    /// Its constraints.
    pub constraints: Constraints,
    /// Seed of its delays and of plain mode's nonces.
    pub seed: u64,
}

/// What the port has to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action {
    /// Open a link and report it with [`Node::dialing`], or [`Node::dial_failed`].
    Dial {
        /// Where.
        to: SocketAddr,
        /// Whom; unknown for a fixed address.
        identity: Option<Identity>,
    },
    /// Close link `old` with `reason` and accept `new`, which takes its place. The port reports `old` as left as usual.
    Supersede {
        /// Has not answered the challenge.
        old: LinkId,
        /// Has waited for that.
        new: LinkId,
        /// Why the old one ends.
        reason: CloseReason,
    },
    /// Accept link `new`: the one in its way has ended.
    Admit {
        /// Has waited.
        new: LinkId,
    },
    /// Refuse link `new`: the one in its way is alive.
    Refuse {
        /// Has waited.
        new: LinkId,
        /// Why.
        refusal: Refusal,
    },
}

/// Whose a datagram is.
#[derive(Debug, PartialEq, Eq)]
pub enum Sorted<'b> {
    /// The node has dealt with it, or counted why not.
    Done,
    /// For the session of a link.
    Session {
        /// The link.
        link: LinkId,
        /// To be compared with the session's.
        nonce: u64,
        /// For [`Session::datagram`](crate::services::unit::Session::datagram).
        body: &'b [u8],
    },
}

/// The last time that something was refused, for the operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finding {
    /// When.
    pub at: Instant,
    /// Who was refused.
    pub address: SocketAddr,
    /// Why.
    pub refusal: Refusal,
}

/// The slices that a node lives in.
pub struct NodeStorage<S: Storage> {
    /// One slot per node that is known, connected or not.
    pub nodes: S::Slice<Option<Known>>,
    /// As many: their order by identity.
    pub order: S::Slice<u16>,
    /// One slot per link.
    pub links: S::Slice<Option<u16>>,
    /// One slot per link that waits for a challenge.
    pub challenges: S::Slice<Option<Challenge>>,
    /// A few: the last refusals.
    pub findings: S::Slice<Option<Finding>>,
}

pub use admission::Challenge as PendingChallenge;

/// One unit's view of the network.
pub struct Node<S: Storage> {
    config: NodeConfig,
    table: Table<S>,
    challenges: S::Slice<Option<Challenge>>,
    findings: S::Slice<Option<Finding>>,
    random: Random,
    search: Search,
    budget: Budget,
    answers: Answers,
    /// What happened.
    pub counters: Counters<NodeCounter, { NodeCounter::COUNT }>,
}

impl<S: Storage> Node<S> {
    /// A node that begins to search at once.
    pub fn new(now: Instant, config: NodeConfig, storage: NodeStorage<S>) -> Self {
        let mut random = Random::new(config.seed);
        let search = Search::new(now, &config.target, &mut random);
        Self {
            table: Table::new(storage.nodes, storage.order, storage.links),
            challenges: storage.challenges,
            findings: storage.findings,
            random,
            search,
            budget: Budget::new(now),
            answers: Answers::new(),
            counters: Counters::new(),
            config,
        }
    }

    /// This unit's identity.
    pub const fn identity(&self) -> &Identity {
        &self.config.identity
    }

    /// This unit's fleet.
    pub const fn fleet(&self) -> Fleet {
        self.config.fleet
    }

    /// This life of the unit.
    pub const fn epoch(&self) -> Epoch {
        self.config.epoch
    }

    /// The constraints in force.
    pub const fn constraints(&self) -> &Constraints {
        &self.config.constraints
    }

    /// Changes the constraints. Nodes above a lower maximum stay; the next one is refused.
    pub fn set_constraints(&mut self, constraints: Constraints) {
        self.config.constraints = constraints;
    }

    /// The hello for a new link, with a fresh nonce.
    pub fn hello(&mut self, now: Instant, link: LinkId) -> Hello {
        let constraints = &self.config.constraints;
        Hello {
            fleet: self.config.fleet,
            identity: self.config.identity.clone(),
            wanted: self.manager().cloned(),
            epoch: self.config.epoch,
            nonce: self.random.bits(),
            term: 0,
            capabilities: 0,
            limits: Limits {
                message_size: constraints.message_size,
                chunk_size: constraints.chunk_size,
                calls: constraints.calls_per_peer,
                minimum_interval: constraints.minimum_interval.as_wire(),
            },
            link: link.0,
            udp_port: self.config.udp_port,
            stamp: now.as_micros(),
            keep_alive: u32::try_from(constraints.keep_alive.as_millis()).unwrap_or(u32::MAX),
        }
    }

    fn manager(&self) -> Option<&Manager> {
        match &self.config.target {
            Target::Everybody => None,
            Target::Manager(manager) | Target::Fixed(manager, _) => Some(manager),
        }
    }

    /// All nodes that are known, in the order in which they became so.
    pub fn nodes(&self) -> impl Iterator<Item = &Known> {
        self.table.iter()
    }

    /// The node of an identity.
    pub fn node(&self, identity: &Identity) -> Option<&Known> {
        self.table.find(identity).and_then(|place| self.table.node(place))
    }

    /// The node at the other end of a link.
    pub fn node_of(&self, link: LinkId) -> Option<&Known> {
        self.table.of_link(link).and_then(|place| self.table.node(place))
    }

    /// How many nodes are connected.
    pub const fn connected(&self) -> usize {
        self.table.joined()
    }

    /// The last refusals, in no order.
    pub fn findings(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().flatten()
    }

    /// When [`poll`](Self::poll) has something to do next.
    pub fn next_deadline(&self) -> Instant {
        let challenge = self.challenges.iter().flatten().map(|challenge| challenge.until).min();
        let own = self.search.next.min(self.answers.next()).min(self.table.next_dial());
        own.min(challenge.unwrap_or(Instant::FAR_FUTURE))
    }

    /// Does what is due. Returns one action at a time; call it until it returns `None`.
    pub fn poll(&mut self, now: Instant, mailman: &mut impl Mailman) -> Option<Action> {
        if let Some(action) = self.poll_challenges(now) {
            return Some(action);
        }
        self.poll_answers(now, mailman);
        if now >= self.search.next
            && let Some(action) = self.poll_search(now, mailman)
        {
            return Some(action);
        }
        let (to, identity) = self.table.take_due_dial(now)?;
        self.counters.add(NodeCounter::Dialled, 1);
        Some(Action::Dial { to, identity: Some(identity) })
    }

    /// Takes a datagram that arrived at any of the unit's sockets.
    pub fn datagram<'b>(&mut self, now: Instant, from: SocketAddr, bytes: &'b [u8]) -> Sorted<'b> {
        match Datagram::decode(bytes, self.config.fleet) {
            Ok(Datagram::Session { link, nonce, body }) => {
                let link = LinkId(link);
                if self.table.of_link(link).is_some() {
                    return Sorted::Session { link, nonce, body };
                }
                self.counters.add(NodeCounter::DatagramUnknownLink, 1);
            }
            Ok(Datagram::WhoHas(who_has)) => self.heard_who_has(now, from, &who_has),
            Ok(Datagram::Announce(announce)) => self.heard_announce(now, from, &announce),
            Err(error) => self.unreadable(now, from, error),
        }
        Sorted::Done
    }

    fn unreadable(&mut self, now: Instant, from: SocketAddr, error: DatagramError) {
        let counter = match error {
            DatagramError::Magic => NodeCounter::DatagramMagic,
            DatagramError::Version(_) => NodeCounter::DatagramVersion,
            DatagramError::Fleet(_) => NodeCounter::DatagramFleet,
            DatagramError::Malformed => NodeCounter::DatagramMalformed,
        };
        self.counters.add(counter, 1);
        if let DatagramError::Version(_) = error {
            self.note(Finding { at: now, address: from, refusal: Refusal::Version });
        }
    }

    /// Keeps a refusal for the operator: the newest of each address and reason, the oldest of all gives way.
    fn note(&mut self, finding: Finding) {
        let same = |known: &Finding| known.address.ip() == finding.address.ip() && known.refusal == finding.refusal;
        let place = self.findings.iter().position(|known| known.as_ref().is_none_or(same));
        let oldest = || self.findings.iter().enumerate().min_by_key(|(_, known)| known.map(|known| known.at));
        let index = place.or_else(|| oldest().map(|(index, _)| index));
        if let Some(place) = index.and_then(|index| self.findings.get_mut(index)) {
            *place = Some(finding);
        }
    }

    /// The port is opening the link that [`Action::Dial`] asked for.
    pub fn dialing(&mut self, identity: Option<&Identity>, link: LinkId) {
        if let Some(place) = identity.and_then(|identity| self.table.find(identity)) {
            self.table.set_link(place, link, NodeState::Dialing(link));
        }
        self.search.dialing = Some(link);
    }

    /// The link that [`Action::Dial`] asked for could not be opened at all.
    pub fn dial_failed(&mut self, now: Instant, identity: Option<&Identity>) {
        if let Some(place) = identity.and_then(|identity| self.table.find(identity)) {
            self.redial(now, place);
        }
        self.search_again(now);
    }

    /// A link has ended, whatever it was. May free a newcomer that waited for that.
    pub fn left(&mut self, now: Instant, link: LinkId, reason: CloseReason) -> Option<Action> {
        self.forget_waiting(link);
        if self.search.dialing == Some(link) {
            self.search.dialing = None;
        }
        if let Some(place) = self.table.of_link(link) {
            self.table.leave(place, link);
            debug!("link {} left: {}", link.0, reason);
            if self.config.target == Target::Everybody {
                self.redial(now, place);
            }
        }
        self.search_again(now);
        self.freed_by(link)
    }

    /// An m_unit that dials a peer tries again, later and later.
    fn redial(&mut self, now: Instant, place: usize) {
        let Some(known) = self.table.node(place) else { return };
        let dials = self.config.target == Target::Everybody && self.dials(&known.identity);
        if dials && !known.is_joined() {
            let pause = FIRST_SEARCH.times(1 << known.attempts().min(5)).min(LONGEST_SEARCH);
            let at = now + pause + self.random.jitter(pause);
            self.table.dial_later(place, at);
        }
    }

    /// Of two m_units the smaller identity dials; an s_unit always does.
    fn dials(&self, peer: &Identity) -> bool {
        peer.role() == Role::MUnit && (self.config.identity.role() == Role::SUnit || self.config.identity < *peer)
    }

    /// A random span within `spread` for each of `expected` nodes.
    fn spread(&mut self, expected: u16) -> Duration {
        self.random.jitter(crate::config::ANSWER_SPREAD.times(u64::from(expected.max(1))))
    }
}
