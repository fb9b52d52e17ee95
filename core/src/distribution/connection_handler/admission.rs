//! Which links are admitted: one per node, of the right fleet, role and manager, up to the constraint; and how to tell a
//! restarted node from another one with the same identity. Claims decide between two managers (docs/concepts.md).

use core::cmp::Ordering;

use super::claims::claim_of;
use super::known::{Known, Newcomer, NodeState};
use super::timetable::Task;
use super::{Command, Directive, Node, NodeCounter};
use crate::config::CHALLENGE_TIMEOUT;
use crate::distribution::hello::Hello;
use crate::distribution::identity::{Identity, Role};
use crate::error::{CloseReason, Refusal};
use crate::host::mailman::LinkId;
use crate::host::port::Port;
use crate::time::Instant;

/// The node's decision about a hello.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Admission {
    /// The link is admitted.
    Accept,
    /// It is refused.
    Refuse(Refusal),
    /// The link waits for a [`Directive`], until it is clear whether another link with its identity is alive.
    Wait,
}

impl<P: Port> Node<P> {
    /// Decides about a link after its hello. `from` is the other end of the stream.
    pub(crate) fn admit(&mut self, now: Instant, link: LinkId, from: P::Endpoint, hello: &Hello) -> Admission {
        if self.is_standby() {
            return self.refuse(now, from, &hello.identity, Refusal::Standby);
        }
        if let Err(refusal) = self.check(hello).and_then(|()| self.check_claim(hello)) {
            if refusal == Refusal::Fenced {
                self.hear_obeyed(now, from, &hello.identity, hello.obeyed.as_ref());
            }
            return self.refuse(now, from, &hello.identity, refusal);
        }
        // Check the identity before the maximum of nodes: a node that restarts gets its old slot, even in a full table.
        let Hello { epoch, claim, limits, .. } = *hello;
        let newcomer = Newcomer { link, epoch, claim, limits, address: from, decided: false };
        let old = self.table.find(&hello.identity).and_then(|place| Some((place, self.table.node(place)?.link()?)));
        match old {
            Some((_, old)) if old == link => Admission::Accept,
            Some((place, _)) => self.meet(now, place, &hello.identity, newcomer),
            None if self.is_full() => self.refuse(now, from, &hello.identity, Refusal::Full),
            None => self.join(now, &hello.identity, newcomer),
        }
    }

    /// Refuses a link because there is no key for the pair. The identity is not authenticated.
    pub(crate) fn refuse_without_key(&mut self, now: Instant, from: P::Endpoint, identity: &Identity) {
        self.refuse(now, from, identity, Refusal::NoKey);
    }

    fn check(&self, hello: &Hello) -> Result<(), Refusal> {
        if hello.fleet != self.config.fleet {
            return Err(Refusal::Fleet);
        }
        if hello.identity == self.config.identity {
            return Err(Refusal::DuplicateIdentity);
        }
        match (self.role(), hello.identity.role()) {
            (Role::SUnit, Role::SUnit) => Err(Refusal::Role),
            (Role::SUnit, Role::MUnit) if self.is_wanted(&hello.identity) => Ok(()),
            (Role::SUnit, Role::MUnit) => Err(Refusal::WrongManager),
            (Role::MUnit, role) => match &hello.wanted {
                _ if !self.is_wanted(&hello.identity) => Err(Refusal::WrongManager),
                Some(manager) if manager.is(&self.config.identity) => Ok(()),
                None if role == Role::MUnit => Ok(()),
                _ => Err(Refusal::WrongManager),
            },
        }
    }

    /// Whether the maximum of nodes is connected.
    pub(super) fn is_full(&self) -> bool {
        self.table.joined() >= self.config.constraints.maximum_nodes
    }

    fn join(&mut self, now: Instant, identity: &Identity, newcomer: Newcomer<P::Endpoint>) -> Admission {
        let Newcomer { link, epoch, claim, limits, address, .. } = newcomer;
        let Some((place, forgotten)) = self.table.place_of(identity, address, epoch) else {
            return self.refuse(now, address, identity, Refusal::Full);
        };
        self.count_forgotten(forgotten);
        let Some(known) = self.table.node_mut(place) else { return Admission::Refuse(Refusal::Full) };
        let was_missing = known.is_missing;
        let restarted = known.limits.is_some() && known.epoch != epoch;
        known.dialed = known.dialing.take_if(|dialing| *dialing == link).is_some();
        if known.dialed {
            known.listens = Some(address);
        }
        if known.newest.is_none_or(|(newest, _)| newest != epoch) {
            known.newest = Some((epoch, 0));
        }
        (known.epoch, known.limits, known.address, known.since) = (epoch, Some(limits), address, now);
        (known.under, known.is_missing) = (None, false);
        let offered = known.offered.take().filter(|(offered, _)| *offered > claim_of(claim.as_ref()));
        let is_back = identity.role() == Role::SUnit && (was_missing || self.table.joined() == 0);
        // Cancel a dial that is planned or under way: a second link of the same node would only be refused.
        self.table.cancel(place);
        self.table.set_state(place, NodeState::Joined(link));
        self.table.set_link(link, Some(place));
        self.table.keep_index(place);
        self.counters.add(NodeCounter::Restarted, u64::from(restarted));
        self.counters.count(NodeCounter::Joined);
        self.hints.forget(identity);
        if let Some((_, from)) = offered {
            // Another manager of the same identity answered with a higher claim, but its link was slower: ask it.
            self.hints.plan(now, from, identity, now);
        }
        if identity.role() == Role::MUnit {
            self.obey(identity, claim.as_ref());
            self.arrived(now, identity);
        }
        self.was_obeyed();
        if P::MANAGES && is_back {
            self.found_again(now);
        }
        debug!("link {} joins", link.0);
        Admission::Accept
    }

    /// Decides about a link with the identity of a connected node.
    fn meet(
        &mut self,
        now: Instant,
        place: usize,
        identity: &Identity,
        mut newcomer: Newcomer<P::Endpoint>,
    ) -> Admission {
        // Both ends compare the same two identities, so they agree which of two links to keep without further messages.
        let smaller = self.config.identity < *identity;
        let Some(known) = self.table.node_mut(place) else { return Admission::Refuse(Refusal::Full) };
        let same_life = known.epoch == newcomer.epoch;
        let dialed = known.dialing == Some(newcomer.link);
        if known.newcomer.is_some() || known.task == Some(Task::Admit) {
            // Another link waits already: admit no second one.
            return self.refuse(now, newcomer.address, identity, Refusal::DuplicateIdentity);
        }
        // Both ends have dialled each other at the same time: both keep the link that the smaller identity opened.
        let crossing = same_life && dialed != known.dialed;
        if crossing && dialed != smaller {
            return self.refuse(now, newcomer.address, identity, Refusal::AlreadyConnected);
        }
        newcomer.decided = crossing;
        known.newcomer = Some(newcomer);
        self.table.schedule(place, now, Task::Challenge);
        self.table.set_link(newcomer.link, Some(place));
        self.counters.count(NodeCounter::Challenged);
        Admission::Wait
    }

    /// Challenges the link that a newcomer would replace.
    pub(super) fn challenge(&mut self, now: Instant, place: usize) -> Option<Command<P::Endpoint>> {
        let known = self.table.node(place)?;
        let (old, newcomer) = (known.link()?, known.newcomer.as_ref()?);
        let until = if newcomer.decided { now } else { now + CHALLENGE_TIMEOUT };
        let is_higher = newcomer.claim() > self.obeyed(&known.identity);
        let directive = if is_higher { Directive::Yield } else { Directive::Challenge };
        self.table.schedule(place, until, Task::Supersede);
        Some(Command::Notify(old, directive))
    }

    /// Lets a link give way to a manager that has answered with a higher claim.
    pub(super) fn yield_to_offer(&self, place: usize) -> Option<Command<P::Endpoint>> {
        let known = self.table.node(place)?;
        known.offered.filter(|(offered, _)| *offered > self.obeyed(&known.identity))?;
        Some(Command::Notify(known.link()?, Directive::Yield))
    }

    /// The challenged link is alive: the newcomer is refused.
    pub(crate) fn challenge_answered(&mut self, now: Instant, old: LinkId) {
        let Some(place) = self.table.of_link(old) else { return };
        let waits = |known: &Known<P::Endpoint>| known.newcomer.as_ref().is_some_and(|newcomer| !newcomer.decided);
        if self.table.node(place).is_some_and(|known| known.link() == Some(old) && waits(known)) {
            self.table.schedule(place, now, Task::Refuse);
        }
    }

    pub(super) fn refuse_newcomer(&mut self, now: Instant, place: usize) -> Option<Command<P::Endpoint>> {
        let known = self.table.node_mut(place)?;
        let newcomer = known.newcomer.take()?;
        known.dialing.take_if(|dialing| *dialing == newcomer.link);
        let (same_life, identity) = (known.epoch == newcomer.epoch, known.identity.clone());
        let refusal = match newcomer.claim().cmp(&self.obeyed(&identity)) {
            _ if same_life => Refusal::AlreadyConnected,
            Ordering::Greater => Refusal::Driving,
            Ordering::Equal => Refusal::DuplicateIdentity,
            Ordering::Less => Refusal::Fenced,
        };
        self.table.set_link(newcomer.link, None);
        self.refuse(now, newcomer.address, &identity, refusal);
        Some(Command::Notify(newcomer.link, Directive::Refuse(refusal)))
    }

    /// The challenged link was silent: ends it. The newcomer replaces it once it has [left](Node::left).
    pub(super) fn supersede(&mut self, place: usize) -> Option<Command<P::Endpoint>> {
        let known = self.table.node_mut(place)?;
        let (old, epoch) = (known.link()?, known.epoch);
        let newcomer = known.newcomer.as_mut()?;
        let reason = match (epoch == newcomer.epoch, newcomer.decided) {
            (true, true) => CloseReason::Refused(Refusal::AlreadyConnected),
            (true, false) => CloseReason::Reset,
            (false, _) => CloseReason::PeerRestarted,
        };
        // The old link is being closed, so a late sign of life must not refuse the newcomer any more.
        newcomer.decided = true;
        Some(Command::Notify(old, Directive::Close(reason)))
    }

    /// A newcomer replaces a link that has ended.
    pub(super) fn take_place(&mut self, now: Instant, place: usize, newcomer: Newcomer<P::Endpoint>) {
        if let Some(identity) = self.table.node(place).map(|known| known.identity.clone())
            && self.join(now, &identity, newcomer) == Admission::Accept
        {
            self.table.schedule(place, now, Task::Admit);
        }
    }

    fn refuse(&mut self, now: Instant, address: P::Endpoint, identity: &Identity, refusal: Refusal) -> Admission {
        let counter = match refusal {
            Refusal::Version(_) | Refusal::Suite | Refusal::Malformed => NodeCounter::RefusedVersion,
            Refusal::Fleet => NodeCounter::RefusedFleet,
            Refusal::WrongManager => NodeCounter::WrongManager,
            Refusal::Full => NodeCounter::RefusedFull,
            Refusal::DuplicateIdentity => NodeCounter::RefusedDuplicate,
            Refusal::Role => NodeCounter::RefusedRole,
            Refusal::AlreadyConnected => NodeCounter::RefusedConnected,
            Refusal::Mode => NodeCounter::RefusedMode,
            Refusal::NoKey => NodeCounter::RefusedKey,
            Refusal::Fenced | Refusal::Driving | Refusal::Standby => NodeCounter::RefusedFenced,
        };
        self.counters.count(counter);
        self.note_of(now, address, identity, refusal);
        Admission::Refuse(refusal)
    }
}
