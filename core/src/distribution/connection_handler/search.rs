//! Searching, within a budget of broadcasts, and what is heard from others.

use super::answers::Found;
use super::known::NodeState;
use super::timetable::Task;
use super::{Node, NodeCounter, Target};
use crate::config::{FIRST_SEARCH, LONGEST_SEARCH, Mode, SEARCH_BUDGET, SEARCH_WINDOW};
use crate::distribution::authenticator::Authenticator;
use crate::distribution::datagram::{Announce, KNOWN_NODES, SEARCH_BYTES, WhoHas, short_hash};
use crate::distribution::hello::Manager;
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::error::Refusal;
use crate::host::mailman::Mailman;
use crate::host::port::Port;
use crate::random::Random;
use crate::time::{Duration, Instant};

/// First searches of m_units wait a random part of this: there are few, and their question serves a whole fleet.
pub(super) const FIRST_DELAY: Duration = Duration::from_millis(50);
/// First searches of s_units wait a random part of this, mostly a late one: of a fleet that is switched on within seconds
/// most hear a manager's answer to another one first.
pub(super) const FIRST_LISTENING: Duration = Duration::from_millis(400);
/// The same after the loss of a manager: each unit of a fleet detects it at another time, within seconds; and a node
/// that has just left takes a moment to return.
pub(super) const LOST_LISTENING: Duration = Duration::from_millis(800);
/// Searches that an m_unit makes after its start, or after it lost its last node, even if nodes join meanwhile: a lost
/// datagram must not keep two managers apart.
const M_UNIT_SEARCHES: u8 = 4;
/// And so many while it has fewer nodes than it knows of, or misses an s_unit that was connected: for about a minute.
pub(super) const MISSING_SEARCHES: u8 = 30;
/// Meanwhile the back-off doubles up to this attempt: an s_unit that was cut off may itself search every 16 s by then.
const MISSING_BACK_OFF_AFTER: u8 = 2;
/// The back-off doubles up to this attempt.
const LONGEST_BACK_OFF_AFTER: u8 = 5;
/// With back-off at its longest, one in so many units that hold back searches regardless of what it hears. A unit that
/// searches without end cannot silence a fleet for good, and a waiting fleet stays quiet.
const STUBBORN: u64 = 1_024;
/// Times in a row that a search is put off because of the budget.
const DEFERRALS: u8 = 4;
/// Steps of [`mostly_late`]: among a thousand units about one falls into the earliest that is taken.
const STEPS: u32 = 12;

/// When this unit asks next.
#[derive(Clone, Debug)]
pub(super) struct Search {
    pub(super) next: Instant,
    /// A search that the application requested: it goes out whatever is heard until then.
    explicit: Option<Instant>,
    /// Searches since the last success, own ones and those of others for the same manager.
    pub(super) attempt: u8,
    /// When `attempt` was raised last because of others.
    round: Instant,
    /// Comes back in answers; the same until one has led to a link.
    pub(super) nonce: u64,
    /// The next search goes out whatever is heard until then.
    stubborn: bool,
    /// Times in a row that the budget was used up.
    deferred: u8,
    /// It has waited for the answer to a hint, and does not wait again before it has gone out.
    pub(super) waited: bool,
}

impl Search {
    pub(super) fn new(now: Instant, role: Role, random: &mut Random) -> Self {
        let next = now + first_delay(role, FIRST_LISTENING, random);
        Self {
            next,
            explicit: None,
            attempt: 0,
            round: now,
            nonce: fresh(random),
            stubborn: false,
            deferred: 0,
            waited: false,
        }
    }

    pub(super) fn next(&self) -> Instant {
        self.next.min(self.explicit.unwrap_or(Instant::FAR_FUTURE))
    }
}

fn first_delay(role: Role, listening: Duration, random: &mut Random) -> Duration {
    match role {
        Role::MUnit => random.jitter(FIRST_DELAY),
        Role::SUnit => mostly_late(random, listening),
    }
}

/// Nonces are never 0, which stands for a broadcast.
pub(super) fn fresh(random: &mut Random) -> u64 {
    random.bits() | 1
}

/// A random delay in `[0, limit)` for an action that one of many units should take for all that hear it. Half of the
/// units draw the last step, a quarter the one before, and so on: few are early, however many there are.
pub(super) fn mostly_late(random: &mut Random, limit: Duration) -> Duration {
    let step = limit.divided_by(u64::from(STEPS));
    let last = STEPS.saturating_sub(1);
    let early = random.bits().trailing_ones().min(last);
    step.times(u64::from(last.saturating_sub(early))) + random.jitter(step)
}

/// The back-off before the next try, without its jitter.
pub(super) fn back_off(attempt: u8) -> Duration {
    FIRST_SEARCH.times(1 << attempt.min(LONGEST_BACK_OFF_AFTER)).min(LONGEST_SEARCH)
}

/// Searches on the network, own and heard: the times of the last few.
#[derive(Clone, Debug)]
pub(super) struct Budget {
    times: heapless::Deque<Instant, { SEARCH_BUDGET as usize }>,
}

impl Budget {
    pub(super) const fn new() -> Self {
        Self { times: heapless::Deque::new() }
    }

    fn note(&mut self, now: Instant) {
        if self.times.is_full() {
            self.times.pop_front();
        }
        let _ = self.times.push_back(now);
    }

    /// When the next search is allowed.
    fn allowed_at(&self, now: Instant) -> Instant {
        match self.times.front() {
            Some(&oldest) if self.times.is_full() => now.max(oldest + SEARCH_WINDOW),
            _ => now,
        }
    }
}

impl<P: Port> Node<P> {
    /// Searches now, or as soon as the budget allows (paper, listing line 6). A unit with a fixed address dials instead.
    pub fn broadcast(&mut self, now: Instant) {
        match (&self.config.target, self.table.joined()) {
            (Target::Fixed(..), 0) => self.dial_target(now),
            (Target::Fixed(..), _) => {}
            _ if !P::DISCOVERS => {}
            _ => {
                let allowed = self.budget.allowed_at(now);
                self.search.explicit = Some(self.search.explicit.unwrap_or(allowed));
            }
        }
    }

    /// When the next search goes out. Another unit's search may defer it, so a port reads waiting datagrams first:
    /// otherwise each of many units that one busy thread drives would search.
    pub fn searches_at(&self) -> Instant {
        let own = self.claims.next();
        if self.is_standby() { own } else { own.min(self.search.next()) }
    }

    fn dial_target(&mut self, now: Instant) {
        let place = self.target.as_ref().and_then(|target| self.table.find(target));
        let away = |place: &usize| self.table.node(*place).is_some_and(|known| known.state == NodeState::Away);
        if let Some(place) = place.filter(away) {
            self.table.schedule(place, now, Task::Dial);
        }
    }

    /// Whether this unit looks for anything now.
    fn is_searching(&self) -> bool {
        match self.config.target {
            Target::Fixed(..) => false,
            Target::Everybody => {
                self.search.attempt < M_UNIT_SEARCHES || self.table.joined() == 0 || self.misses_nodes()
            }
            Target::Manager(_) => {
                let place = self.target.as_ref().and_then(|target| self.table.find(target));
                let known = place.and_then(|place| self.table.node(place));
                known.is_none_or(|known| known.state == NodeState::Away && known.task.is_none())
            }
        }
    }

    /// Whether s_units may be there that this m_unit does not have. One that has stood by does not know all of them, nor of
    /// another manager behind a partition: it always searches.
    fn misses_nodes(&self) -> bool {
        if !P::MANAGES || self.role() != Role::MUnit {
            return false;
        }
        if self.is_full() {
            return false;
        }
        let has_fewer = self.known_nodes != u16::MAX && self.table.joined() < self.known_nodes;
        let is_missing = || has_fewer || self.table.iter().any(|known| known.is_missing);
        P::STANDS_BY && self.claims.has_stood_by || self.search.attempt < MISSING_SEARCHES && is_missing()
    }

    /// The link of a node has ended in no orderly way. If it is an s_unit, its manager searches until it is back; of m_units one
    /// dials the other.
    pub(super) fn miss(&mut self, now: Instant, place: usize) {
        // The node counts as away by now, so that some may be missing though no search is planned.
        let searches = self.search.next != Instant::FAR_FUTURE && self.misses_nodes();
        let s_unit = self.table.node_mut(place).filter(|known| known.identity.role() == Role::SUnit);
        let Some(known) = s_unit else { return };
        known.is_missing = true;
        if searches {
            // The pause may be one of a search that missed nobody.
            self.search.attempt = self.search.attempt.min(MISSING_BACK_OFF_AFTER);
            self.search.next = self.search.next.min(now + back_off(MISSING_BACK_OFF_AFTER));
        } else {
            self.search_soon(now);
        }
    }

    /// A full manager has a free place again: whoever it has refused is to come soon.
    pub(super) fn place_is_free(&mut self, now: Instant) {
        if self.config.target == Target::Everybody && !self.is_full() {
            self.search_soon(now);
        }
    }

    /// A node is back that was away against its will. Others may be, too, for which the search has ended by now.
    pub(super) fn found_again(&mut self, now: Instant) {
        let has_ended = self.search.attempt >= MISSING_SEARCHES;
        self.search.attempt = self.search.attempt.min(MISSING_SEARCHES / 2);
        if has_ended && self.misses_nodes() {
            self.search.next = self.search.next.min(now + self.random.jitter(FIRST_SEARCH));
        }
    }

    fn search_soon(&mut self, now: Instant) {
        self.search.attempt = 0;
        self.search.next = now + self.random.jitter(FIRST_SEARCH);
    }

    /// Searches again after a loss: an s_unit listens for this long first. `None`: the link was lost at once.
    pub(super) fn search_again(&mut self, now: Instant, listening: Option<Duration>) {
        if !P::DISCOVERS || self.table.joined() > 0 {
            return;
        }
        self.search.nonce = fresh(&mut self.random);
        self.search.waited = false;
        if let Some(listening) = listening {
            self.search.attempt = 0;
            self.search.next = now + first_delay(self.role(), listening, &mut self.random);
        } else {
            self.plan_next(now);
        }
    }

    /// The port has an interface again, or another one: what is searched for may be there, and the back-off starts
    /// over.
    pub fn network_changed(&mut self, now: Instant) {
        match self.config.target {
            Target::Fixed(..) if self.table.joined() == 0 => self.dial_target(now),
            Target::Fixed(..) => {}
            Target::Everybody | Target::Manager(_) => self.search_again(now, Some(FIRST_LISTENING)),
        }
    }

    /// Searches a few times, as after the start, even while nodes are connected. Only m_units do: one of them may have
    /// moved.
    pub(super) fn look_around(&mut self, now: Instant) {
        if self.config.target != Target::Everybody {
            return;
        }
        if self.search.next == Instant::FAR_FUTURE || !self.is_searching() {
            self.search_soon(now);
        }
    }

    /// Schedules the next search with growing back-off.
    pub(super) fn plan_next(&mut self, now: Instant) {
        let longest = if self.misses_nodes() { MISSING_BACK_OFF_AFTER } else { LONGEST_BACK_OFF_AFTER };
        let back_off = back_off(self.search.attempt.min(longest));
        self.search.attempt = self.search.attempt.saturating_add(1);
        self.search.next = now + back_off + mostly_late(&mut self.random, back_off);
    }

    pub(super) fn poll_search(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        // What the application asks for is sent whatever the others do, but counts in the budget like any search.
        if self.search.explicit.take_if(|at| *at <= now).is_some() {
            self.send_who_has(now, mailman, authenticator);
            return;
        }
        if now < self.search.next {
            return;
        }
        if !self.is_searching() {
            self.search.next = Instant::FAR_FUTURE;
            return;
        }
        if self.role() == Role::SUnit && self.waits_for_hints(now) {
            return;
        }
        // A unit that hears enough searches of others defers its own, since their answer reaches it as well; but a few times
        // only, or a host that floods the network with searches would silence it for good.
        let allowed = self.budget.allowed_at(now);
        if allowed > now && !self.search.stubborn {
            self.search.deferred = self.search.deferred.saturating_add(1);
            self.search.stubborn = self.search.deferred >= DEFERRALS;
            self.counters.count(NodeCounter::WhoHasDeferred);
            self.search.next = allowed + mostly_late(&mut self.random, FIRST_SEARCH);
            return;
        }
        self.send_who_has(now, mailman, authenticator);
    }

    fn send_who_has(
        &mut self,
        now: Instant,
        mailman: &mut dyn Mailman<P::Endpoint>,
        authenticator: &dyn Authenticator,
    ) {
        self.plan_next(now);
        (self.search.stubborn, self.search.deferred, self.search.waited) = (false, 0, false);
        self.budget.note(now);
        let (wanted, expected) = (self.manager().cloned(), self.expected().max(1));
        let sent = self.say_who_has(wanted, expected, authenticator, |datagram| mailman.broadcast(datagram));
        self.counters.count(if sent { NodeCounter::WhoHasSent } else { NodeCounter::SendFailed });
    }

    /// Encodes a [`WhoHas`] and sends it; `expected` is 0 in one that asks a single node.
    pub(super) fn say_who_has(
        &mut self,
        wanted: Option<Manager>,
        expected: u16,
        authenticator: &dyn Authenticator,
        send: impl FnOnce(&[u8]) -> bool,
    ) -> bool {
        let known = self.table.iter().filter(|known| expected > 0 && known.is_joined());
        let known = known.map(|known| short_hash(&known.identity));
        let who_has = WhoHas {
            identity: self.config.identity.clone(),
            epoch: self.config.epoch,
            sequence: self.sequence.wrapping_add(1),
            nonce: self.search.nonce,
            wanted,
            tcp_port: if self.is_standby() { 0 } else { self.config.tcp_port },
            expected,
            known: known.take(KNOWN_NODES).collect(),
            standby: self.is_standby(),
            skipped: 0,
        };
        self.sequence = who_has.sequence;
        let mut bytes = [0; SEARCH_BYTES];
        who_has.encode(self.config.fleet, authenticator, &mut bytes).is_some_and(send)
    }

    pub(super) fn heard_who_has(&mut self, now: Instant, from: P::Endpoint, who_has: &WhoHas, mode: Mode) {
        if self.is_own(now, from, &who_has.identity, who_has.epoch, Some(who_has)) {
            return;
        }
        self.counters.count(NodeCounter::WhoHasHeard);
        let here = self.role() == Role::MUnit;
        let counts = self.counts(now, from, who_has);
        match &who_has.wanted {
            Some(manager) if here && manager.is(&self.config.identity) && self.is_wanted(&who_has.identity) => {
                self.answer_seeker(now, from, who_has);
            }
            Some(manager) if self.manager() == Some(manager) => {
                if counts {
                    self.hold_back(now);
                }
            }
            None if who_has.identity.role() == Role::MUnit => self.heard_m_unit(now, from, who_has),
            None if here => self.answer_survey(now, from, who_has, mode),
            // It asks the manager of its identity once a second.
            _ if who_has.standby => {}
            _ => self.counters.count(NodeCounter::WrongManager),
        }
    }

    /// Whether another unit's search may defer this unit's own. One that asks a single node does not count.
    fn counts(&mut self, now: Instant, from: P::Endpoint, who_has: &WhoHas) -> bool {
        let counts = who_has.expected > 0 && self.hosts.counts(now, from);
        if counts {
            self.budget.note(now);
        } else {
            self.counters.count(NodeCounter::WhoHasUnheeded);
        }
        counts
    }

    /// Another unit searches for the same manager: the answer will reach both.
    fn hold_back(&mut self, now: Instant) {
        if self.search.next == Instant::FAR_FUTURE || self.search.stubborn || !self.is_searching() {
            return;
        }
        if self.search.attempt > LONGEST_BACK_OFF_AFTER && self.random.below(STUBBORN) == 0 {
            self.search.stubborn = true;
            return;
        }
        self.counters.count(NodeCounter::WhoHasDeferred);
        if self.search.attempt == 0 || now >= self.search.round + FIRST_SEARCH {
            self.search.attempt = self.search.attempt.saturating_add(1);
            self.search.round = now;
        }
        let back_off = back_off(self.search.attempt.saturating_sub(1));
        let later = now + back_off + mostly_late(&mut self.random, back_off);
        self.search.next = self.search.next.max(later);
    }

    /// An m_unit asks for all nodes: its own s_units ask it whether it is there, and so does the smaller one of two
    /// m_units.
    fn heard_m_unit(&mut self, now: Instant, from: P::Endpoint, who_has: &WhoHas) {
        if !self.is_wanted(&who_has.identity) {
            self.counters.count(NodeCounter::WrongManager);
            return;
        }
        if who_has.known.contains(&short_hash(&self.config.identity)) {
            return;
        }
        let delay = self.spread(who_has.expected);
        if !self.dials(&who_has.identity) {
            if !self.is_connected(&who_has.identity, who_has.epoch) {
                self.answer_later(now + delay, from, &who_has.identity, who_has.nonce);
            }
            return;
        }
        if self.obeyed_report(now, &who_has.identity).is_some() && !self.is_connected(&who_has.identity, who_has.epoch)
        {
            // What this unit has obeyed, a manager of that identity is to know. It may decide within a second, and a thousand vehicles
            // that answer at the same moment overflow its socket: half a second at most.
            self.answer_later(now + delay.divided_by(4), from, &who_has.identity, who_has.nonce);
        }
        if !who_has.standby {
            self.hinted(now, from, &who_has.identity, who_has.epoch, delay);
        }
    }

    pub(super) fn heard_announce(
        &mut self,
        now: Instant,
        from: P::Endpoint,
        announce: &Announce,
        authenticator: &dyn Authenticator,
    ) {
        if self.is_own(now, from, &announce.identity, announce.epoch, None) {
            if self.role() == Role::MUnit && announce.epoch != self.config.epoch {
                self.another_answered(now, announce, authenticator);
            }
            return;
        }
        self.counters.count(NodeCounter::AnnounceHeard);
        if announce.nonce != 0 && announce.nonce == self.search.nonce {
            self.hear_obeyed(now, from, &announce.identity, announce.obeyed.as_ref());
        }
        if announce.identity.role() == Role::SUnit && announce.obeyed.is_some() {
            return;
        }
        if announce.identity.role() != Role::MUnit || !self.is_wanted(&announce.identity) {
            self.counters.count(NodeCounter::WrongManager);
            if self.chosen.is_none() {
                self.note_of(now, from, &announce.identity, Refusal::WrongManager);
            }
            return;
        }
        let broadcast = announce.nonce == 0;
        // An answer must carry the nonce of the last search: a recorded one leads nowhere.
        if !broadcast && announce.nonce != self.search.nonce {
            self.counters.count(NodeCounter::Unasked);
            return;
        }
        if !self.dials(&announce.identity) {
            return;
        }
        if !broadcast {
            self.found(now, &announce.identity, from, Found::of(announce));
        } else if announce.room > 0 {
            let delay = self.spread(announce.expected);
            self.hinted(now, from, &announce.identity, announce.epoch, delay);
        } else {
            // The broadcast of a full manager is no hint; but a unit that it answers directly may be the one that its
            // capacity is reserved for.
            self.note_of(now, from, &announce.identity, Refusal::Full);
        }
    }

    /// An s_unit wants its manager, an m_unit its s_units and the m_units that it has chosen.
    pub(super) fn is_wanted(&self, identity: &Identity) -> bool {
        let is_chosen = || self.chosen.as_ref().is_none_or(|chosen| chosen.contains(identity));
        match self.manager() {
            Some(manager) => manager.is(identity),
            None => P::MANAGES && (identity.role() == Role::SUnit || is_chosen()),
        }
    }

    fn is_connected(&self, identity: &Identity, epoch: Epoch) -> bool {
        self.node(identity).is_some_and(|known| known.is_joined() && known.epoch == epoch)
    }
}
