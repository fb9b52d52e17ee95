//! Hints: addresses from which broadcasts of wanted nodes came. A recorded broadcast can be replayed, so a hint proves nothing.
//!
//! A hint causes one question with a fresh nonce to that address, and only an address that answers is dialled. An address that
//! does not answer is asked again with growing back-off, however often hints at it arrive, and another hint may displace it one
//! second after it was asked. Meanwhile the unit's own search continues: hints delay it once, by a second at most.

use super::known::NodeState;
use super::search::{back_off, fresh, mostly_late};
use super::{Node, NodeCounter, Target};
use crate::config::{FIRST_SEARCH, LONGEST_SEARCH};
use crate::distribution::authenticator::Authenticator;
use crate::distribution::hello::Manager;
use crate::distribution::identity::{Epoch, Identity};
use crate::host::endpoint::{Endpoint, mix};
use crate::host::mailman::Mailman;
use crate::host::port::Port;
use crate::time::{Duration, Instant};

/// How many addresses are asked side by side.
const HINTS: usize = 4;
/// How long an address that was asked keeps its slot. So at most four a second are asked, however many hints arrive.
const STAY: Duration = Duration::from_secs(1);
/// How long the unit's own search waits for a question at most.
const LONGEST_WAIT: Duration = Duration::from_secs(1);
/// If there is no answer, the unit broadcasts after this time plus a random part of it, unless its search is due earlier.
const UNANSWERED: Duration = Duration::from_millis(500);
/// A host's question defers this unit's search only once in this time, the longest for which units hold back.
const HOST_PAUSE: Duration = LONGEST_SEARCH.times(2);
/// For how many hosts that is remembered.
const HOSTS: usize = 16;

/// One address that a broadcast came from.
#[derive(Clone, Debug)]
struct Hint<E> {
    from: E,
    /// The identity that the broadcast claims.
    who: Identity,
    /// When it is asked; `None` afterwards.
    due: Option<Instant>,
    /// How often it was asked.
    asked: u8,
    /// Earliest time of the next question.
    not_before: Instant,
    /// When it was asked last.
    since: Instant,
}

/// The addresses to ask, or asked a short while ago.
#[derive(Clone, Debug)]
pub(super) struct Hints<E> {
    list: heapless::Vec<Hint<E>, HINTS>,
}

impl<E: Endpoint> Hints<E> {
    pub(super) const fn new() -> Self {
        Self { list: heapless::Vec::new() }
    }

    pub(super) fn next(&self) -> Instant {
        self.list.iter().filter_map(|hint| hint.due).min().unwrap_or(Instant::FAR_FUTURE)
    }

    /// Schedules a question. `false` if one is scheduled already, or the list is full.
    pub(super) fn plan(&mut self, now: Instant, from: E, who: &Identity, due: Instant) -> bool {
        if let Some(known) = self.list.iter_mut().find(|hint| is_same_host(hint.from, from) && hint.who == *who) {
            let is_free = known.due.is_none();
            if is_free {
                (known.from, known.due) = (from, Some(due.max(known.not_before)));
            }
            return is_free;
        }
        let who = who.clone();
        let hint = Hint { from, who, due: Some(due), asked: 0, not_before: now, since: now };
        let Err(hint) = self.list.push(hint) else { return true };
        // Displaces the one that was asked longest ago, even if it is to be asked again: it has had time to answer.
        let asked = self.list.iter_mut().filter(|known| known.asked > 0 && known.since + STAY <= now);
        asked.min_by_key(|known| known.since).map(|oldest| *oldest = hint).is_some()
    }

    /// A question that is due.
    fn take(&mut self, now: Instant) -> Option<(E, Identity)> {
        let hint = self.list.iter_mut().find(|hint| hint.due.is_some_and(|due| due <= now))?;
        hint.due = None;
        (hint.since, hint.not_before) = (now, now + back_off(hint.asked));
        hint.asked = hint.asked.saturating_add(1);
        Some((hint.from, hint.who.clone()))
    }

    /// This address has answered: if it has refused a link as yet, that may change soon.
    pub(super) fn answered(&mut self, from: E) {
        if let Some(hint) = self.list.iter_mut().find(|hint| is_same_host(hint.from, from)) {
            (hint.asked, hint.not_before) = (1, hint.since + FIRST_SEARCH);
        }
    }

    /// The node is there: later hints at it begin from the start.
    pub(super) fn forget(&mut self, who: &Identity) {
        self.list.retain(|hint| hint.who != *who);
    }
}

/// Units of one host have different ports. On loopback all units are on this host, so there the port tells them apart.
fn is_same_host<E: Endpoint>(one: E, other: E) -> bool {
    one.is_of_host(&other) && (!one.is_loopback() || one.port() == other.port())
}

/// The hosts whose questions counted recently. A replayed question defers this unit's search once, and not for as long as an
/// attacker likes.
#[derive(Clone, Debug)]
pub(super) struct Hosts {
    seed: u32,
    /// Hashes of hosts, in the order in which they counted.
    list: heapless::Deque<(u32, Instant), HOSTS>,
}

impl Hosts {
    pub(super) const fn new(seed: u32) -> Self {
        Self { seed, list: heapless::Deque::new() }
    }

    /// Whether a question from this address counts; if so, the next ones do not for a while.
    pub(super) fn counts(&mut self, now: Instant, from: impl Endpoint) -> bool {
        while self.list.front().is_some_and(|(_, at)| *at + HOST_PAUSE <= now) {
            self.list.pop_front();
        }
        let host = self.mark(from);
        if self.list.iter().any(|(known, _)| *known == host) {
            return false;
        }
        if self.list.is_full() {
            self.list.pop_front();
        }
        self.list.push_back((host, now)).is_ok()
    }

    /// A hash of a host's address. A collision costs one more search.
    fn mark(&self, from: impl Endpoint) -> u32 {
        let port = if from.is_loopback() { from.port() } else { 0 };
        mix(mix(self.seed ^ from.host_bits()) ^ u32::from(port))
    }
}

impl<P: Port> Node<P> {
    /// A broadcast hints at a node that this unit dials: asks it after `delay`, unless it is connected. A vehicle that is
    /// connected to another boot of its manager asks as well, since this boot may have a higher claim.
    pub(super) fn hinted(&mut self, now: Instant, from: P::Endpoint, who: &Identity, epoch: Epoch, delay: Duration) {
        let away = self.node(who).is_none_or(|known| match known.state {
            NodeState::Away => known.not_before <= now,
            NodeState::Joined(_) => known.epoch != epoch,
            NodeState::Dialing => false,
        });
        if !away || matches!(self.config.target, Target::Fixed(..)) {
            return;
        }
        if !self.hints.plan(now, from, who, now + delay) {
            self.counters.count(NodeCounter::HintsIgnored);
        }
    }

    pub(super) fn poll_hints(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        while let Some((to, who)) = self.hints.take(now) {
            if self.node(&who).is_some_and(|known| known.is_joined()) {
                // The answer to an earlier question proves nothing now, so use a fresh nonce.
                self.search.nonce = fresh(&mut self.random);
            }
            self.ask(to, &who, mailman, authenticator);
            if self.search.next != Instant::FAR_FUTURE && who != self.config.identity {
                let soon = now + UNANSWERED + mostly_late(&mut self.random, UNANSWERED);
                self.search.next = self.search.next.min(soon);
            }
        }
    }

    /// Whether to delay a broadcast search because a question to a single node is about to be sent, whose answer would make it
    /// needless: once, and not for long.
    pub(super) fn waits_for_hints(&mut self, now: Instant) -> bool {
        let due = self.hints.next();
        if self.search.waited || due == Instant::FAR_FUTURE {
            return false;
        }
        self.search.waited = true;
        self.search.next = due.min(now + LONGEST_WAIT) + mostly_late(&mut self.random, FIRST_SEARCH);
        true
    }

    /// Asks one node alone, which answers at once.
    fn ask(
        &mut self,
        to: P::Endpoint,
        who: &Identity,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        let Ok(wanted) = Manager::new(who.name(), who.id()) else { return };
        let sent = self.say_who_has(Some(wanted), 0, authenticator, |datagram| mailman.send_to(to, datagram));
        self.counters.count(if sent { NodeCounter::HintsAsked } else { NodeCounter::SendFailed });
    }
}
