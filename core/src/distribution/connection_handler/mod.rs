//! The paper's `Connection_handler`: finds nodes, decides which links are admitted, and keeps the state of each node.
//!
//! A [`Node`] is one unit's membership. It knows links only by their ids; their frames belong to sessions. The port polls it
//! ([`Node::poll`]), passes it datagrams ([`Node::datagram`]) and reports the end of each link ([`Node::left`]); a session asks
//! it whether to admit its peer. What the port has to do is returned as [`Command`]s.
//!
//! # Discovery (paper, section 2: "it works like the Address Resolution Protocol")
//! - An s_unit broadcasts a search ([`WhoHas`](super::datagram::WhoHas)) for its manager, with growing back-off, and dials the manager when it answers. A unit that hears another search for its manager defers its own: the manager answers both with one broadcast.
//! - An m_unit broadcasts a search for all. Its own s_units ask it, after a random delay, and dial it when it answers; of two m_units the smaller identity dials.
//! - A unit dials only a node that has answered its own question, in secured mode with the code of the pair. Everything else that it hears is a mere hint at an address.

mod admission;
mod answers;
mod claims;
mod counter;
mod duplicates;
mod hand_over;
mod hints;
mod known;
mod links;
mod search;
mod standby;
mod table;
mod timetable;
mod views;

pub(crate) use admission::Admission;
pub use claims::ClaimEvent;
pub(crate) use claims::MayMove;
pub use counter::NodeCounter;
pub use hand_over::HandOverStage;
pub use known::{Known, NodeState};
pub use table::Order;

use crate::config::{Constraints, VERSIONS};
use crate::counters::Counters;
use crate::distribution::authenticator::Authenticator;
use crate::distribution::datagram::{Datagram, DatagramError};
use crate::distribution::hello::{Hello, Manager};
use crate::distribution::identity::{Epoch, Fleet, Identity, Role};
use crate::error::{CloseReason, Error, Refusal};
use crate::host::endpoint::Endpoint as _;
use crate::host::mailman::{LinkId, Mailman};
use crate::host::port::{Port, Slice};
use crate::random::Random;
use crate::time::Instant;
use answers::Answers;
use claims::Claims;
use duplicates::Duplicates;
use hand_over::Moving;
use hints::{Hints, Hosts};
use search::{Budget, Search};
use table::Table;
use timetable::Task;

/// The nodes that a unit connects to. `E` is the port's [`Endpoint`](crate::host::endpoint::Endpoint).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Target<E> {
    /// Every m_unit, or those that [`Node::choose`] names, and the s_units that belong to this one.
    Everybody,
    /// The one manager of an s_unit, wherever it is.
    Manager(Manager),
    /// The one manager of an s_unit, at a fixed address; without broadcasts.
    Fixed(Manager, E),
}

impl Manager {
    /// A manager's name and id; [`Error::BadName`] if the name is [not valid](Identity::new).
    pub fn new(name: &str, id: u32) -> Result<Self, Error> {
        Identity::m_unit(name, id)?;
        Ok(Self { name: heapless::String::try_from(name).map_err(|_| Error::BadName)?, id })
    }

    /// The manager's identity.
    pub(crate) fn identity(&self) -> Option<Identity> {
        Identity::m_unit(&self.name, self.id).ok()
    }

    /// Whether an identity is this manager's.
    pub fn is(&self, identity: &Identity) -> bool {
        identity.role() == Role::MUnit && identity.id() == self.id && identity.name() == self.name
    }
}

/// A node's settings.
#[derive(Clone, Debug)]
pub struct NodeConfig<E> {
    /// Its identity.
    pub identity: Identity,
    /// Its fleet.
    pub fleet: Fleet,
    /// Its boot epoch, which must differ from boot to boot.
    pub epoch: Epoch,
    /// The nodes that it connects to.
    pub target: Target<E>,
    /// The TCP port at which it can be dialled; 0 for none.
    pub tcp_port: u16,
    /// The UDP port for its session datagrams; 0 for none.
    pub udp_port: u16,
    /// Its constraints.
    pub constraints: Constraints,
    /// Seed of its random delays and of plain mode's nonces.
    pub seed: u64,
}

/// What the port has to do, to one link at a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command<E> {
    /// Open a link and report it with [`Node::dialing`] or [`Node::dial_failed`].
    Dial {
        /// Where.
        to: E,
        /// The expected identity; `None` if a fixed address is dialled.
        identity: Option<Identity>,
    },
    /// Pass the directive to the link's session.
    Notify(LinkId, Directive),
}

/// What a link has to do because of another link. Only the node makes these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Directive {
    /// Check that the peer is alive: another link has the same identity.
    #[non_exhaustive]
    Challenge,
    /// The same for a manager with a higher claim: end the link once nothing moves, or after a time limit.
    #[non_exhaustive]
    Yield,
    /// Admit the peer, which has waited.
    #[non_exhaustive]
    Admit,
    /// Refuse the peer, which has waited: the older link is alive.
    #[non_exhaustive]
    Refuse(Refusal),
    /// End the link: another one takes its place.
    #[non_exhaustive]
    Close(CloseReason),
}

/// The last refusal of one kind, by either end, shown to the operator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding<E> {
    /// When.
    pub at: Instant,
    /// The other end.
    pub address: E,
    /// The other end's identity, if it gave one.
    pub identity: Option<Identity>,
    /// Why.
    pub refusal: Refusal,
}

/// The memory of a node.
pub struct NodeStorage<P: Port> {
    /// One slot per known node, connected or not. More slots than `maximum_nodes` let it remember nodes that have left.
    pub nodes: Slice<P, Option<Known<P::Endpoint>>>,
    /// As many slots.
    pub order: Slice<P, Order>,
    /// One slot per link.
    pub links: Slice<P, Option<u16>>,
    /// A few slots, for the last refusals.
    pub findings: Slice<P, Option<Finding<P::Endpoint>>>,
}

/// One unit's view of the network.
#[doc(alias = "Connection_handler")]
pub struct Node<P: Port> {
    config: NodeConfig<P::Endpoint>,
    /// The manager, of an s_unit.
    target: Option<Identity>,
    /// The m_units that an m_unit connects to; all if `None`.
    chosen: Option<Slice<P, Identity>>,
    /// Upper bound on how many nodes there are to meet.
    known_nodes: u16,
    table: Table<P>,
    findings: Slice<P, Option<Finding<P::Endpoint>>>,
    random: Random,
    search: Search,
    budget: Budget,
    hints: Hints<P::Endpoint>,
    hosts: Hosts,
    answers: Answers<P::Endpoint>,
    duplicates: Duplicates<P::Endpoint>,
    claims: Claims,
    moving: Moving,
    /// Sequence number of the last search or answer.
    sequence: u32,
    /// The unit's counters.
    pub counters: Counters<NodeCounter, { NodeCounter::COUNT }>,
}

impl<P: Port> Node<P> {
    /// A node, which begins to search at once.
    pub fn new(now: Instant, config: NodeConfig<P::Endpoint>, storage: NodeStorage<P>) -> Self {
        let mut random = Random::new(config.seed);
        let target = match &config.target {
            Target::Everybody => None,
            Target::Manager(manager) | Target::Fixed(manager, _) => manager.identity(),
        };
        let mut node = Self {
            target,
            chosen: None,
            known_nodes: u16::MAX,
            table: Table::new(storage.nodes, storage.order, storage.links),
            findings: storage.findings,
            search: Search::new(now, config.identity.role(), &mut random),
            budget: Budget::new(),
            hints: Hints::new(),
            hosts: Hosts::new((config.seed >> 32) as u32 ^ config.seed as u32),
            answers: Answers::new(),
            duplicates: Duplicates::new(),
            claims: Claims::new(now),
            moving: Moving::default(),
            sequence: 0,
            counters: Counters::new(),
            config,
            random,
        };
        node.plan_fixed(now);
        node
    }

    fn plan_fixed(&mut self, now: Instant) {
        let (Target::Fixed(_, address), Some(target)) = (&self.config.target, &self.target) else { return };
        let (address, at) = (*address, now + self.random.jitter(search::FIRST_DELAY));
        let Some((place, _)) = self.table.place_of(target, address, Epoch(0)) else { return };
        if let Some(known) = self.table.node_mut(place) {
            known.listens = Some(address);
        }
        self.table.schedule(place, at, Task::Dial);
    }

    /// This unit's identity.
    pub const fn identity(&self) -> &Identity {
        &self.config.identity
    }

    /// This unit's role; a constant on ports that have only s_units.
    const fn role(&self) -> Role {
        if P::MANAGES { self.config.identity.role() } else { Role::SUnit }
    }

    /// This unit's fleet.
    pub const fn fleet(&self) -> Fleet {
        self.config.fleet
    }

    /// This boot of the unit.
    pub const fn epoch(&self) -> Epoch {
        self.config.epoch
    }

    /// The constraints in force.
    pub const fn constraints(&self) -> &Constraints {
        &self.config.constraints
    }

    /// Changes the constraints. A lower maximum of nodes disconnects none, but the next is refused.
    pub fn set_constraints(&mut self, constraints: Constraints) {
        let was_full = P::MANAGES && self.is_full();
        self.config.constraints = constraints;
        if was_full {
            self.place_is_free(Instant::START);
        }
    }

    /// Moves to longer tables for a higher maximum of nodes. Does nothing if one is shorter. The findings keep their slots.
    pub fn grow(
        &mut self,
        nodes: Slice<P, Option<Known<P::Endpoint>>>,
        order: Slice<P, Order>,
        links: Slice<P, Option<u16>>,
    ) {
        self.table.grow(nodes, order, links);
    }

    /// Sets how many nodes may be connected at a time.
    #[cfg(test)]
    pub(crate) fn set_maximum_nodes(&mut self, maximum_nodes: u16) {
        self.config.constraints.maximum_nodes = maximum_nodes;
    }

    /// Restricts the m_units to connect to; existing links stay. Two m_units connect only if each selects the other: one that is
    /// not chosen gets no answer, and is refused if it dials.
    pub fn choose(&mut self, m_units: Slice<P, Identity>) {
        self.chosen = Some(m_units);
    }

    /// Tells an m_unit how many nodes there are at most: the fewer they are, the shorter are the delays of their answers.
    pub fn expect(&mut self, nodes: u16) {
        self.known_nodes = nodes;
    }

    /// A nonce for a new link, to be sent in its hello.
    pub fn nonce(&mut self) -> u64 {
        self.random.bits()
    }

    /// The hello for a link with this nonce.
    pub fn hello(&self, now: Instant, link: LinkId, nonce: u64) -> Hello {
        let constraints = &self.config.constraints;
        Hello {
            versions: VERSIONS,
            capabilities: 0,
            fleet: self.config.fleet,
            identity: self.config.identity.clone(),
            wanted: self.manager().cloned(),
            epoch: self.config.epoch,
            claim: self.own_report(now),
            obeyed: self.peer_of(link).and_then(|peer| self.obeyed_report(now, peer)),
            nonce,
            limits: constraints.into(),
            link: link.0,
            udp_port: self.config.udp_port,
            stamp: now.as_micros(),
            keep_alive: u32::try_from(constraints.keep_alive.as_millis()).unwrap_or(u32::MAX),
            skipped: 0,
        }
    }

    /// The node that a link is being opened to, if it is known.
    fn peer_of(&self, link: LinkId) -> Option<&Identity> {
        let place = self.table.of_link(link);
        self.target.as_ref().or_else(|| Some(&self.table.node(place?)?.identity))
    }

    fn manager(&self) -> Option<&Manager> {
        match &self.config.target {
            Target::Everybody => None,
            Target::Manager(manager) | Target::Fixed(manager, _) => Some(manager),
        }
    }

    /// The last refusals, in no particular order.
    pub fn findings(&self) -> impl Iterator<Item = &Finding<P::Endpoint>> {
        self.findings.iter().flatten()
    }

    /// When [`poll`](Self::poll) has to be called next.
    pub fn next_deadline(&self) -> Instant {
        if self.is_standby() {
            return self.claims.next();
        }
        let own = self.claims.next().min(self.table.next_due()).min(self.moving.until());
        if P::DISCOVERS { own.min(self.answers.next()).min(self.hints.next()).min(self.search.next()) } else { own }
    }

    /// Does what is due and returns one command. Call it until it returns `None`.
    pub fn poll(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) -> Option<Command<P::Endpoint>> {
        if self.is_standby() {
            self.poll_standby(now, mailman, authenticator);
            return None;
        }
        while let Some((place, task)) = self.table.pop_due(now) {
            let command = match task {
                Task::Dial => self.dial(now, place),
                Task::GiveUp => {
                    self.dial_ended(now, place);
                    None
                }
                Task::Challenge => self.challenge(now, place),
                Task::Supersede => self.supersede(place),
                Task::Admit => {
                    self.table.node(place).and_then(Known::link).map(|new| Command::Notify(new, Directive::Admit))
                }
                Task::Refuse => self.refuse_newcomer(now, place),
                Task::Yield => self.yield_to_offer(place),
            };
            if command.is_some() {
                return command;
            }
        }
        if let Some(command) = self.poll_hand_over(now) {
            return Some(command);
        }
        self.poll_claims(now, mailman, authenticator);
        if P::DISCOVERS {
            self.poll_answers(now, mailman, authenticator);
            self.poll_hints(now, mailman, authenticator);
            self.poll_search(now, mailman, authenticator);
        }
        None
    }

    /// Takes a datagram that arrived at any of the unit's sockets, unless it is [for a
    /// session](crate::distribution::datagram::for_session).
    pub fn datagram(&mut self, now: Instant, from: P::Endpoint, bytes: &[u8], authenticator: &dyn Authenticator) {
        if !P::DISCOVERS {
            return self.counters.count(NodeCounter::DatagramNotForUs);
        }
        match Datagram::decode(bytes, self.config.fleet, authenticator) {
            Ok(Datagram::WhoHas(_)) if self.is_standby() => {}
            Ok(Datagram::Announce(announce)) if self.is_standby() => {
                self.standby_answered(now, &announce, authenticator)
            }
            Ok(Datagram::WhoHas(who_has)) => {
                self.counters.add(NodeCounter::DatagramItemsSkipped, who_has.skipped.into());
                self.heard_who_has(now, from, &who_has, authenticator.mode());
            }
            Ok(Datagram::Announce(announce)) => {
                self.counters.add(NodeCounter::DatagramItemsSkipped, announce.skipped.into());
                self.heard_announce(now, from, &announce, authenticator);
            }
            Ok(Datagram::Session { .. }) => self.counters.count(NodeCounter::DatagramUnknownLink),
            Err(error) => self.unreadable(now, from, error),
        }
    }

    fn unreadable(&mut self, now: Instant, from: P::Endpoint, error: DatagramError) {
        let counter = match error {
            DatagramError::Magic => NodeCounter::DatagramMagic,
            DatagramError::Version(_) => NodeCounter::DatagramVersion,
            DatagramError::Fleet(_) => NodeCounter::DatagramFleet,
            DatagramError::Forged => NodeCounter::DatagramForged,
            DatagramError::NotForUs => NodeCounter::DatagramNotForUs,
            DatagramError::Malformed => NodeCounter::DatagramMalformed,
        };
        self.counters.count(counter);
        if let DatagramError::Version(versions) = error {
            let refusal = Refusal::Version(versions);
            self.note(Finding { at: now, address: from, identity: None, refusal });
        }
    }

    /// Records a refusal for the operator: the newest for each host, unit and reason, in place of the oldest of all.
    fn note(&mut self, finding: Finding<P::Endpoint>) {
        let same = |known: &Finding<P::Endpoint>| {
            known.address.is_of_host(&finding.address)
                && known.refusal == finding.refusal
                && known.identity == finding.identity
        };
        let place = self.findings.iter().position(|known| known.as_ref().is_none_or(same));
        let oldest = || self.findings.iter().enumerate().min_by_key(|(_, known)| known.as_ref().map(|known| known.at));
        let index = place.or_else(|| oldest().map(|(index, _)| index));
        if let Some(place) = index.and_then(|index| self.findings.get_mut(index)) {
            *place = Some(finding);
        }
    }

    fn note_of(&mut self, at: Instant, address: P::Endpoint, identity: &Identity, refusal: Refusal) {
        self.note(Finding { at, address, identity: Some(identity.clone()), refusal });
    }

    fn count_forgotten(&mut self, forgotten: bool) {
        self.counters.add(NodeCounter::Forgotten, u64::from(forgotten));
    }
}

#[cfg(test)]
mod tests;
