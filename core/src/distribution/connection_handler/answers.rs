//! Answers to searches, and dials to nodes that were found. Random delays and broadcasts keep thousands of units that start
//! together from answering and dialling all at once (docs/performance.md, "Many vehicles").

use super::claims::claim_of;
use super::known::NodeState;
use super::search::back_off;
use super::timetable::Task;
use super::{Command, Node, NodeCounter, Target};
use crate::config::{ANSWER_SPREAD, FIRST_SEARCH, LONGEST_SEARCH, Mode};
use crate::distribution::authenticator::Authenticator;
use crate::distribution::claim::Claim;
use crate::distribution::datagram::{Announce, SEARCH_BYTES, WhoHas, short_hash};
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::error::Refusal;
use crate::host::endpoint::Endpoint as _;
use crate::host::mailman::Mailman;
use crate::host::port::Port;
use crate::time::{Duration, Instant};

/// A second unit that asks within this time is answered by broadcast: others, which hold back for at most this long, probably
/// wait for the same answer.
const SAME_QUESTION: Duration = LONGEST_SEARCH.times(2);
/// Minimum interval between broadcast answers.
const ANSWER_PAUSE: Duration = FIRST_SEARCH.times(2);
/// An answer waits up to this long, so that one broadcast serves all units that ask meanwhile.
const ANSWER_GATHER: Duration = Duration::from_millis(20);
/// How many answers to single nodes may wait for their random delay.
const WAITING_ANSWERS: usize = 8;
/// How many of them may be for one host; its other units get the broadcast.
const ANSWERS_TO_A_HOST: usize = 4;
/// Dials are spread over the delays of at least this many nodes, since more may hold back than are expected.
const LEAST_SPREAD: u16 = 50;
/// Dials are spread over the delays of at most this many nodes: two seconds.
const MOST_SPREAD: u16 = 2_000;
/// An m_unit searches for a peer again after this many failed dials.
const MOVED_AFTER: u8 = 2;
/// After this time without an answer, a dial no longer blocks a dial to another address of the same node.
const DIAL_ALONE: Duration = Duration::from_millis(300);
/// A dial is given up after this time, even if the transport still tries.
pub(super) const DIAL_TIMEOUT: Duration = Duration::from_secs(6);

/// An answer to a single node.
#[derive(Clone, Debug)]
struct Answer<E> {
    at: Instant,
    to: E,
    /// The node that asked.
    who: Identity,
    nonce: u64,
}

/// Answers that wait to be sent.
#[derive(Clone, Debug)]
pub(super) struct Answers<E> {
    single: heapless::Vec<Answer<E>, WAITING_ANSWERS>,
    broadcast: Option<Instant>,
    last_broadcast: Option<Instant>,
    /// When a node last asked, and its [`short_hash`].
    asked: Option<(Instant, u32)>,
}

impl<E> Answers<E> {
    pub(super) const fn new() -> Self {
        Self { single: heapless::Vec::new(), broadcast: None, last_broadcast: None, asked: None }
    }

    pub(super) fn next(&self) -> Instant {
        let single = self.single.iter().map(|answer| answer.at).min();
        single.unwrap_or(Instant::FAR_FUTURE).min(self.broadcast.unwrap_or(Instant::FAR_FUTURE))
    }
}

/// The data of an answer by a node that can be dialled.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    epoch: Epoch,
    sequence: u32,
    tcp_port: u16,
    claim: Claim,
}

impl Found {
    pub(super) const fn of(announce: &Announce) -> Self {
        let Announce { epoch, sequence, tcp_port, .. } = *announce;
        Self { epoch, sequence, tcp_port, claim: claim_of(announce.claim.as_ref()) }
    }
}

impl<P: Port> Node<P> {
    /// A unit searches for this manager. The first to ask gets an answer of its own; a second one soon after causes a broadcast.
    pub(super) fn answer_seeker(&mut self, now: Instant, from: P::Endpoint, who_has: &WhoHas) {
        if who_has.expected == 0 {
            // The question is to this unit alone, and its sender has already waited.
            self.answer_later(now, from, &who_has.identity, who_has.nonce);
            return;
        }
        let who = short_hash(&who_has.identity);
        let another = self.answers.asked.is_some_and(|(at, asked)| asked != who && now < at + SAME_QUESTION);
        self.answers.asked = Some((now, who));
        let delay = self.random.jitter(ANSWER_GATHER);
        self.answer_later(now + delay, from, &who_has.identity, who_has.nonce);
        if another && self.answers.broadcast.is_none() {
            let earliest = self.answers.last_broadcast.map_or(now, |last| last + ANSWER_PAUSE);
            self.answers.broadcast = Some(earliest.max(now + ANSWER_GATHER));
        }
    }

    /// The node that asked last and its address, while its answer waits.
    pub fn asked_by(&self) -> Option<(&Identity, P::Endpoint)> {
        self.answers.single.last().map(|answer| (&answer.who, answer.to))
    }

    /// An s_unit that looks for no manager surveys the network. This unit shares no pair key with it, so in secured mode the
    /// reply is like a broadcast: authenticated with the fleet's key only.
    pub(super) fn answer_survey(&mut self, now: Instant, from: P::Endpoint, who_has: &WhoHas, mode: Mode) {
        let delay = self.spread(who_has.expected);
        self.answer_unpaired(now + delay, from, who_has, mode);
    }

    /// Schedules an answer to a unit that has no pair key with this one.
    pub(super) fn answer_unpaired(&mut self, at: Instant, to: P::Endpoint, who_has: &WhoHas, mode: Mode) {
        let nonce = if mode == Mode::Secured { 0 } else { who_has.nonce };
        self.answer_later(at, to, &who_has.identity, nonce);
    }

    /// Schedules an answer to one node. If the list is full, the broadcast or the next question serves it. No host can fill it.
    pub(super) fn answer_later(&mut self, at: Instant, to: P::Endpoint, who: &Identity, nonce: u64) {
        let single = &mut self.answers.single;
        if single.iter().any(|answer| answer.to == to && answer.nonce == nonce) {
            return;
        }
        let of_host = single.iter().filter(|answer| answer.to.is_of_host(&to)).count();
        let is_crowded = of_host >= ANSWERS_TO_A_HOST && !to.is_loopback();
        if is_crowded || single.push(Answer { at, to, who: who.clone(), nonce }).is_err() {
            self.counters.count(NodeCounter::AnnounceDropped);
        }
    }

    pub(super) fn poll_answers(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        while let Some(index) = self.answers.single.iter().position(|answer| answer.at <= now) {
            let Answer { to, who, nonce, .. } = self.answers.single.swap_remove(index);
            let send = |datagram: &[u8]| mailman.send_to(to, datagram);
            if !self.send_announce(now, authenticator, nonce, Some(&who), NodeCounter::AnnounceSent, send) {
                self.counters.count(NodeCounter::AnnounceWithheld);
                self.note_of(now, to, &who, Refusal::NoKey);
            }
        }
        if P::MANAGES && self.answers.broadcast.take_if(|at| *at <= now).is_some() {
            self.answers.last_broadcast = Some(now);
            self.send_announce(now, authenticator, 0, None, NodeCounter::AnnounceBroadcast, |datagram| {
                mailman.broadcast(datagram)
            });
        }
    }

    /// Sends an answer; `false` if there is no key to authenticate it.
    fn send_announce(
        &mut self,
        now: Instant,
        authenticator: &dyn Authenticator,
        nonce: u64,
        to: Option<&Identity>,
        counter: NodeCounter,
        send: impl FnOnce(&[u8]) -> bool,
    ) -> bool {
        let announce = Announce {
            identity: self.config.identity.clone(),
            epoch: self.config.epoch,
            claim: self.own_report(now),
            obeyed: to.and_then(|manager| self.obeyed_report(now, manager)),
            sequence: self.sequence.wrapping_add(1),
            nonce,
            tcp_port: self.config.tcp_port,
            room: self.room(),
            expected: self.expected(),
            skipped: 0,
        };
        self.sequence = announce.sequence;
        let mut bytes = [0; SEARCH_BYTES];
        let Some(datagram) = announce.encode(self.config.fleet, authenticator, to, &mut bytes) else { return false };
        self.counters.count(if send(datagram) { counter } else { NodeCounter::SendFailed });
        true
    }

    /// How many more nodes this unit can admit.
    fn room(&self) -> u16 {
        self.config.constraints.maximum_nodes.saturating_sub(self.table.joined())
    }

    /// How many nodes may answer or dial at once: all that there are, up to the capacity left.
    pub(super) fn expected(&self) -> u16 {
        match self.role() {
            Role::MUnit => self.room().min(self.known_nodes),
            Role::SUnit => 1,
        }
    }

    /// A random delay for `expected` nodes.
    pub(super) fn spread(&mut self, expected: u16) -> Duration {
        self.random.jitter(ANSWER_SPREAD.times(u64::from(expected.clamp(LEAST_SPREAD, MOST_SPREAD))))
    }

    /// Whether this unit dials a peer: an s_unit always does; of two m_units, the smaller identity.
    pub(super) fn dials(&self, peer: &Identity) -> bool {
        peer.role() == Role::MUnit && (self.role() == Role::SUnit || self.config.identity < *peer)
    }

    /// A node that this unit dials has answered it. Dials it at once, unless it is connected. If a dial to another address of it
    /// has brought no answer yet, dials both.
    pub(super) fn found(&mut self, now: Instant, identity: &Identity, from: P::Endpoint, found: Found) {
        let Found { epoch, sequence, tcp_port, claim } = found;
        if tcp_port == 0 || matches!(self.config.target, Target::Fixed(..)) {
            return;
        }
        self.hints.answered(from);
        let address = from.at_port(tcp_port);
        let is_higher = claim > self.obeyed(identity);
        let Some((place, forgotten)) = self.table.hear_of(identity, address, epoch) else {
            self.counters.count(NodeCounter::TableFull);
            return;
        };
        self.count_forgotten(forgotten);
        let Some(known) = self.table.node_mut(place) else { return };
        // A delayed answer may name an address that the node has left: only the newest counts.
        if !known.is_news(epoch, sequence) {
            self.counters.count(NodeCounter::Outdated);
            return;
        }
        known.newest = Some((epoch, sequence));
        // Kept while the node is connected, too: it is dialled there when this link ends.
        let moved = known.listens.replace(address) != Some(address);
        if known.offered.is_none_or(|(offered, _)| claim > offered) {
            known.offered = Some((claim, from));
        }
        if known.is_joined() {
            if known.epoch != epoch && is_higher && known.task.is_none() {
                self.table.schedule(place, now, Task::Yield);
            }
            return;
        }
        // A restarted node need not wait for back-off that failures of its earlier boot caused.
        if known.epoch != epoch {
            known.not_before = Instant::START;
            known.attempts = 0;
        }
        (known.address, known.epoch) = (address, epoch);
        let at = match known.state {
            // Do not give up a dial that has brought no answer yet: the other address may be forged, so try both.
            NodeState::Dialing if moved => now.max(known.since + DIAL_ALONE),
            NodeState::Dialing => return,
            _ if known.task.is_some() => known.due.min(now.max(known.not_before)),
            _ => now.max(known.not_before),
        };
        self.table.schedule(place, at, Task::Dial);
    }

    /// Dials a node whose dial is due.
    pub(super) fn dial(&mut self, now: Instant, place: usize) -> Option<Command<P::Endpoint>> {
        if self.is_full() {
            self.retry(now, place);
            return None;
        }
        let known = self.table.node_mut(place).filter(|known| !known.is_joined())?;
        let to = known.listens?;
        let identity = Some(known.identity.clone());
        known.since = now;
        self.table.set_state(place, NodeState::Dialing);
        self.table.schedule(place, now + DIAL_TIMEOUT, Task::GiveUp);
        self.counters.count(NodeCounter::Dialled);
        Some(Command::Dial { to, identity })
    }

    /// A node that was dialled has not joined.
    pub(super) fn dial_ended(&mut self, now: Instant, place: usize) {
        if let Some(known) = self.table.node_mut(place) {
            known.dialing = None;
        }
        self.counters.count(NodeCounter::DialFailed);
        self.table.set_state(place, NodeState::Away);
        self.table.cancel(place);
        self.retry(now, place);
    }

    /// Retries with growing back-off: an s_unit searches again, an m_unit that knows the address dials it.
    pub(super) fn retry(&mut self, now: Instant, place: usize) {
        let Some(known) = self.table.node_mut(place) else { return };
        let failed = known.attempts;
        known.attempts = failed.saturating_add(1);
        let dials = known.listens.is_some() && known.identity.role() == Role::MUnit;
        let smaller = self.config.identity < known.identity;
        match self.config.target {
            Target::Manager(_) if P::DISCOVERS => {
                if failed == 0 {
                    // Its answer has just been heard, so it may have moved: search soon, however long it was away.
                    self.search.attempt = 0;
                }
                self.plan_next(now);
            }
            Target::Everybody if !smaller => {}
            Target::Everybody | Target::Fixed(..) if dials => {
                let back_off = back_off(failed);
                let at = now + back_off + self.random.jitter(back_off);
                self.table.schedule(place, at, Task::Dial);
                if P::DISCOVERS && failed == MOVED_AFTER {
                    self.look_around(now);
                }
            }
            Target::Everybody | Target::Manager(_) | Target::Fixed(..) => {}
        }
    }
}
