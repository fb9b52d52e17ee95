//! Searching and answering, within a budget of broadcasts.

use core::net::SocketAddr;

use super::{Action, Node, NodeCounter, NodeState, Target};
use crate::config::{FIRST_SEARCH, LONGEST_SEARCH, SEARCH_BUDGET, SEARCH_WINDOW};
use crate::distribution::datagram::{Announce, SEARCH_BYTES, WhoHas, short_hash};
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::host::mailman::{LinkId, Mailman};
use crate::random::Random;
use crate::storage::Storage;
use crate::time::{Duration, Instant};

/// First searches wait a random part of this, so that a fleet that is switched on at once does not ask at once.
const FIRST_DELAY: Duration = Duration::from_millis(50);
/// A second unit that asks within this is answered, with all others, by one broadcast.
const SAME_QUESTION: Duration = Duration::from_secs(1);
/// Two broadcast answers are at least this far apart.
const ANSWER_PAUSE: Duration = Duration::from_millis(250);
/// A broadcast answer waits this long for more who ask.
const ANSWER_GATHER: Duration = Duration::from_millis(20);
/// Answers to single nodes that may wait for their random delay.
const WAITING_ANSWERS: usize = 8;

/// When this unit asks next.
#[derive(Clone, Debug)]
pub(super) struct Search {
    pub(super) next: Instant,
    pause: Duration,
    nonce: u64,
    sequence: u32,
    /// The unit asked for it: it goes out as soon as the budget allows.
    explicit: bool,
    /// A link is being opened: no need to ask.
    pub(super) dialing: Option<LinkId>,
    /// A fixed address is dialled instead.
    dial_at: Option<Instant>,
}

impl Search {
    pub(super) fn new(now: Instant, target: &Target, random: &mut Random) -> Self {
        let next = match target {
            Target::Fixed(..) => now,
            _ => now + random.jitter(FIRST_DELAY),
        };
        Self { next, pause: FIRST_SEARCH, nonce: 0, sequence: 0, explicit: false, dialing: None, dial_at: None }
    }

    /// A node has joined: an s_unit has found what it wanted, an m_unit asks no more by itself.
    pub(super) fn joined(&mut self, target: &Target) {
        self.pause = FIRST_SEARCH;
        self.dialing = None;
        self.dial_at = None;
        if *target != Target::Everybody || !self.explicit {
            self.next = Instant::FAR_FUTURE;
        }
    }
}

/// Searches on the network, own and heard.
#[derive(Clone, Debug)]
pub(super) struct Budget {
    window: Instant,
    used: u8,
}

impl Budget {
    pub(super) const fn new(now: Instant) -> Self {
        Self { window: now, used: 0 }
    }

    fn roll(&mut self, now: Instant) {
        if now >= self.window + SEARCH_WINDOW {
            self.window = now;
            self.used = 0;
        }
    }

    fn note(&mut self, now: Instant) {
        self.roll(now);
        self.used = self.used.saturating_add(1);
    }

    /// When the next search is allowed.
    fn allowed_at(&mut self, now: Instant) -> Instant {
        self.roll(now);
        if self.used < SEARCH_BUDGET { now } else { self.window + SEARCH_WINDOW }
    }
}

/// Answers that are due.
#[derive(Clone, Debug)]
pub(super) struct Answers {
    single: heapless::Vec<(Instant, SocketAddr, u64), WAITING_ANSWERS>,
    broadcast: Option<Instant>,
    last_broadcast: Option<Instant>,
    /// Who asked last, and when.
    asked: Option<(Instant, u32)>,
    sequence: u32,
}

impl Answers {
    pub(super) const fn new() -> Self {
        Self { single: heapless::Vec::new(), broadcast: None, last_broadcast: None, asked: None, sequence: 0 }
    }

    pub(super) fn next(&self) -> Instant {
        let single = self.single.iter().map(|(at, _, _)| *at).min();
        single.unwrap_or(Instant::FAR_FUTURE).min(self.broadcast.unwrap_or(Instant::FAR_FUTURE))
    }
}

impl<S: Storage> Node<S> {
    /// Searches now, or as soon as the budget allows (paper, listing line 6).
    pub fn broadcast(&mut self, now: Instant) {
        self.search.explicit = true;
        self.search.next = self.budget.allowed_at(now);
    }

    /// Looks for what this unit wants and has not got.
    pub(super) fn search_again(&mut self, now: Instant) {
        if self.wants_more() && self.search.dialing.is_none() {
            let pause = self.search.pause;
            self.search.pause = pause.times(2).min(LONGEST_SEARCH);
            let next = now + pause + self.random.jitter(pause);
            self.search.next = self.search.next.min(next).max(now);
            if self.search.next == Instant::FAR_FUTURE {
                self.search.next = next;
            }
        }
    }

    fn wants_more(&self) -> bool {
        self.table.joined() == 0
    }

    pub(super) fn poll_search(&mut self, now: Instant, mailman: &mut impl Mailman) -> Option<Action> {
        if !self.search.explicit && (!self.wants_more() || self.search.dialing.is_some()) {
            self.search.next = Instant::FAR_FUTURE;
            return None;
        }
        if let Target::Fixed(_, to) = self.config.target {
            self.plan_next(now);
            self.counters.add(NodeCounter::Dialled, 1);
            return (self.search.dialing.is_none()).then_some(Action::Dial { to, identity: None });
        }
        let allowed = self.budget.allowed_at(now);
        if allowed > now {
            self.counters.add(NodeCounter::WhoHasDeferred, 1);
            self.search.next = allowed + self.random.jitter(FIRST_SEARCH);
            return None;
        }
        self.send_who_has(now, mailman);
        self.search.explicit = false;
        self.plan_next(now);
        None
    }

    fn plan_next(&mut self, now: Instant) {
        let pause = self.search.pause;
        self.search.pause = pause.times(2).min(LONGEST_SEARCH);
        self.search.next = now + pause + self.random.jitter(pause);
    }

    fn send_who_has(&mut self, now: Instant, mailman: &mut impl Mailman) {
        self.search.sequence = self.search.sequence.saturating_add(1);
        self.search.nonce = self.random.bits();
        let known = self.table.iter().filter(|known| known.is_joined()).map(|known| short_hash(&known.identity));
        let who_has = WhoHas {
            identity: self.config.identity.clone(),
            epoch: self.config.epoch,
            sequence: self.search.sequence,
            nonce: self.search.nonce,
            wanted: self.manager().cloned(),
            tcp_port: self.config.tcp_port,
            expected: self.expected(),
            known: known.take(crate::distribution::datagram::KNOWN_NODES).collect(),
        };
        let mut bytes = [0; SEARCH_BYTES];
        if let Some(datagram) = who_has.encode(self.config.fleet, &mut bytes) {
            mailman.broadcast(datagram);
        }
        self.budget.note(now);
        self.counters.add(NodeCounter::WhoHasSent, 1);
    }

    /// How many nodes may answer or dial at once: those that still fit.
    fn expected(&self) -> u16 {
        let joined = u16::try_from(self.table.joined()).unwrap_or(u16::MAX);
        match self.config.identity.role() {
            Role::MUnit => self.config.constraints.maximum_nodes.saturating_sub(joined),
            Role::SUnit => 1,
        }
    }

    pub(super) fn heard_who_has(&mut self, now: Instant, from: SocketAddr, who_has: &WhoHas) {
        if self.is_own(&who_has.identity, who_has.epoch) {
            return;
        }
        self.counters.add(NodeCounter::WhoHasHeard, 1);
        self.budget.note(now);
        match &who_has.wanted {
            Some(manager) if manager.is(&self.config.identity) => self.answer_soon(now, from, who_has),
            Some(manager) => {
                self.counters.add(NodeCounter::WrongManager, 1);
                if self.manager() == Some(manager) {
                    self.hold_back(now);
                }
            }
            None => self.heard_m_unit(now, from, who_has),
        }
    }

    /// Another unit asks this unit's question: the answer will reach both.
    fn hold_back(&mut self, now: Instant) {
        let waiting = self.wants_more() && self.search.dialing.is_none() && !self.search.explicit;
        if waiting && matches!(self.config.target, Target::Manager(_)) {
            self.counters.add(NodeCounter::WhoHasDeferred, 1);
            let later = now + FIRST_SEARCH + self.random.jitter(FIRST_SEARCH);
            self.search.next = self.search.next.max(later);
        }
    }

    /// An s_unit looks for this manager: one is answered at once, several with one broadcast.
    fn answer_soon(&mut self, now: Instant, from: SocketAddr, who_has: &WhoHas) {
        let who = short_hash(&who_has.identity);
        let another = self.answers.asked.is_some_and(|(at, asked)| asked != who && now < at + SAME_QUESTION);
        self.answers.asked = Some((now, who));
        if !another {
            self.answer_later(now, from, who_has.nonce);
        } else if self.answers.broadcast.is_none() {
            let earliest = self.answers.last_broadcast.map_or(now, |last| last + ANSWER_PAUSE);
            self.answers.broadcast = Some(earliest.max(now + ANSWER_GATHER));
        }
    }

    fn answer_later(&mut self, at: Instant, to: SocketAddr, nonce: u64) {
        let waiting = self.answers.single.iter().any(|(_, known, _)| *known == to);
        if !waiting && self.answers.single.push((at, to, nonce)).is_err() {
            self.counters.add(NodeCounter::AnnounceDropped, 1);
        }
    }

    /// An m_unit asks for everybody: its own s_units dial it, and of two m_units the smaller one dials.
    fn heard_m_unit(&mut self, now: Instant, from: SocketAddr, who_has: &WhoHas) {
        if who_has.known.contains(&short_hash(&self.config.identity)) {
            return;
        }
        if who_has.identity.role() != Role::MUnit || !self.is_wanted(&who_has.identity) {
            self.counters.add(NodeCounter::WrongManager, 1);
            return;
        }
        let delay = self.spread(who_has.expected);
        if !self.dials(&who_has.identity) {
            self.answer_later(now + delay, from, who_has.nonce);
            return;
        }
        let found = Found { epoch: who_has.epoch, sequence: who_has.sequence, tcp_port: who_has.tcp_port };
        self.found(&who_has.identity, from, found, now + delay);
    }

    pub(super) fn heard_announce(&mut self, now: Instant, from: SocketAddr, announce: &Announce) {
        if self.is_own(&announce.identity, announce.epoch) {
            return;
        }
        self.counters.add(NodeCounter::AnnounceHeard, 1);
        if announce.identity.role() != Role::MUnit || !self.is_wanted(&announce.identity) {
            self.counters.add(NodeCounter::WrongManager, 1);
            return;
        }
        let broadcast = announce.nonce == 0;
        if !self.dials(&announce.identity) || !(broadcast || announce.nonce == self.search.nonce) {
            return;
        }
        let delay = if broadcast { self.spread(announce.expected) } else { Duration::ZERO };
        let found = Found { epoch: announce.epoch, sequence: announce.sequence, tcp_port: announce.tcp_port };
        self.found(&announce.identity, from, found, now + delay);
    }

    fn is_wanted(&self, identity: &Identity) -> bool {
        self.manager().is_none_or(|manager| manager.is(identity))
    }

    fn is_own(&mut self, identity: &Identity, epoch: Epoch) -> bool {
        if *identity != self.config.identity {
            return false;
        }
        if epoch != self.config.epoch {
            self.counters.add(NodeCounter::OwnIdentity, 1);
        }
        true
    }

    /// A node that this unit dials has been found.
    fn found(&mut self, identity: &Identity, from: SocketAddr, found: Found, dial_at: Instant) {
        let address = SocketAddr::new(from.ip(), found.tcp_port);
        if found.tcp_port == 0 {
            return;
        }
        let Some((place, forgotten)) = self.table.place_of(identity, address, found.epoch) else { return };
        if forgotten {
            self.counters.add(NodeCounter::Forgotten, 1);
        }
        let Some(known) = self.table.node_mut(place) else { return };
        if (known.epoch, known.sequence) > (found.epoch, found.sequence) && known.epoch == found.epoch {
            self.counters.add(NodeCounter::Outdated, 1);
            return;
        }
        if known.state == NodeState::Away {
            known.epoch = found.epoch;
            known.sequence = found.sequence;
            known.address = address;
        }
        self.table.dial_later(place, dial_at);
    }

    pub(super) fn poll_answers(&mut self, now: Instant, mailman: &mut impl Mailman) {
        while let Some(index) = self.answers.single.iter().position(|(at, _, _)| *at <= now) {
            let (_, to, nonce) = self.answers.single.swap_remove(index);
            self.counters.add(NodeCounter::AnnounceSent, 1);
            self.send_announce(nonce, |datagram| mailman.send_to(to, datagram));
        }
        if self.answers.broadcast.take_if(|at| *at <= now).is_some() {
            self.answers.last_broadcast = Some(now);
            self.counters.add(NodeCounter::AnnounceBroadcast, 1);
            self.send_announce(0, |datagram| mailman.broadcast(datagram));
        }
    }

    fn send_announce(&mut self, nonce: u64, send: impl FnOnce(&[u8]) -> bool) {
        self.answers.sequence = self.answers.sequence.saturating_add(1);
        let expected = self.expected();
        let announce = Announce {
            identity: self.config.identity.clone(),
            epoch: self.config.epoch,
            sequence: self.answers.sequence,
            nonce,
            tcp_port: self.config.tcp_port,
            room: expected,
            expected,
        };
        let mut bytes = [0; SEARCH_BYTES];
        if let Some(datagram) = announce.encode(self.config.fleet, &mut bytes) {
            send(datagram);
        }
    }
}

/// What a datagram says of a node that can be dialled.
struct Found {
    epoch: Epoch,
    sequence: u32,
    tcp_port: u16,
}
