//! Which links are taken: one per node, of the right fleet, role and manager, as many as the constraint allows; and how a
//! node that restarted is told from another one with the same identity.

use core::net::SocketAddr;

use super::{Action, Finding, Node, NodeCounter, NodeState};
use crate::config::CHALLENGE_TIMEOUT;
use crate::distribution::hello::Hello;
use crate::distribution::identity::Role;
use crate::error::{CloseReason, Refusal};
use crate::host::mailman::LinkId;
use crate::storage::Storage;
use crate::time::Instant;

/// What the node says to a hello.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Admission {
    /// The port accepts the link.
    Accept,
    /// The port refuses the link.
    Refuse(Refusal),
    /// The port challenges link `old`; the newcomer waits for an [`Action`].
    Challenge {
        /// Has the newcomer's identity.
        old: LinkId,
    },
}

/// A newcomer that waits for the link in its way to show whether it lives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Challenge {
    old: LinkId,
    new: LinkId,
    hello: Hello,
    address: SocketAddr,
    pub(super) until: Instant,
}

impl<S: Storage> Node<S> {
    /// Decides about a link whose hello has come. `from` is the other end of the stream.
    pub fn admit(&mut self, now: Instant, link: LinkId, from: SocketAddr, hello: &Hello) -> Admission {
        if let Err(refusal) = self.check(hello) {
            return self.refuse(now, from, refusal);
        }
        let known = self.table.find(&hello.identity).and_then(|place| self.table.node(place));
        let (joined, epoch) = match known {
            Some(known) => (known.state, Some(known.epoch)),
            None => (NodeState::Away, None),
        };
        match joined {
            NodeState::Joined(old) if old != link => self.challenge(now, old, link, from, hello),
            _ if self.is_full() => self.refuse(now, from, Refusal::Full),
            _ => {
                if epoch.is_some_and(|epoch| epoch != hello.epoch) {
                    self.counters.add(NodeCounter::Restarted, 1);
                }
                self.join(now, link, from, hello)
            }
        }
    }

    fn check(&self, hello: &Hello) -> Result<(), Refusal> {
        if hello.fleet != self.config.fleet {
            return Err(Refusal::Fleet);
        }
        if hello.identity == self.config.identity {
            return Err(Refusal::DuplicateIdentity);
        }
        match (self.config.identity.role(), hello.identity.role()) {
            (Role::SUnit, Role::SUnit) => Err(Refusal::Role),
            (Role::SUnit, Role::MUnit) => match self.manager() {
                Some(manager) if manager.is(&hello.identity) => Ok(()),
                _ => Err(Refusal::WrongManager),
            },
            (Role::MUnit, Role::SUnit) => match &hello.wanted {
                Some(manager) if manager.is(&self.config.identity) => Ok(()),
                _ => Err(Refusal::WrongManager),
            },
            (Role::MUnit, Role::MUnit) => Ok(()),
        }
    }

    fn is_full(&self) -> bool {
        self.table.joined() >= usize::from(self.config.constraints.maximum_nodes)
    }

    fn join(&mut self, now: Instant, link: LinkId, from: SocketAddr, hello: &Hello) -> Admission {
        let Some((place, forgotten)) = self.table.place_of(&hello.identity, from, hello.epoch) else {
            return self.refuse(now, from, Refusal::Full);
        };
        if forgotten {
            self.counters.add(NodeCounter::Forgotten, 1);
        }
        if let Some(known) = self.table.node_mut(place) {
            known.epoch = hello.epoch;
            known.limits = Some(hello.limits);
            known.address = from;
        }
        self.table.set_link(place, link, NodeState::Joined(link));
        self.search.joined(&self.config.target);
        self.counters.add(NodeCounter::Joined, 1);
        debug!("link {} joins", link.0);
        Admission::Accept
    }

    fn challenge(&mut self, now: Instant, old: LinkId, new: LinkId, address: SocketAddr, hello: &Hello) -> Admission {
        // A second newcomer for the same place is one too many, whoever it is.
        let waiting = self.challenges.iter().flatten().any(|challenge| challenge.old == old);
        let free = self.challenges.iter_mut().find(|place| place.is_none());
        let (false, Some(place)) = (waiting, free) else {
            return self.refuse(now, address, Refusal::DuplicateIdentity);
        };
        *place = Some(Challenge { old, new, hello: hello.clone(), address, until: now + CHALLENGE_TIMEOUT });
        Admission::Challenge { old }
    }

    /// The challenged link has answered: the newcomer is not taken.
    pub fn challenge_answered(&mut self, now: Instant, old: LinkId) -> Option<Action> {
        let challenge = self.take_challenge(|challenge| challenge.old == old)?;
        let known_epoch = self.node_of(old).map(|known| known.epoch);
        let same = known_epoch == Some(challenge.hello.epoch);
        let refusal = if same { Refusal::AlreadyConnected } else { Refusal::DuplicateIdentity };
        self.refuse(now, challenge.address, refusal);
        Some(Action::Refuse { new: challenge.new, refusal })
    }

    /// Newcomers whose challenge was not answered take the place.
    pub(super) fn poll_challenges(&mut self, now: Instant) -> Option<Action> {
        let challenge = self.take_challenge(|challenge| challenge.until <= now)?;
        let restarted = self.node_of(challenge.old).is_some_and(|known| known.epoch != challenge.hello.epoch);
        let reason = if restarted { CloseReason::PeerRestarted } else { CloseReason::Reset };
        self.take_over(now, &challenge, restarted);
        Some(Action::Supersede { old: challenge.old, new: challenge.new, reason })
    }

    /// The link in a newcomer's way has ended.
    pub(super) fn freed_by(&mut self, old: LinkId) -> Option<Action> {
        let challenge = self.take_challenge(|challenge| challenge.old == old)?;
        let known = self.node(&challenge.hello.identity);
        let restarted = known.is_some_and(|known| known.epoch != challenge.hello.epoch);
        self.take_over(Instant::START, &challenge, restarted);
        Some(Action::Admit { new: challenge.new })
    }

    fn take_over(&mut self, now: Instant, challenge: &Challenge, restarted: bool) {
        if restarted {
            self.counters.add(NodeCounter::Restarted, 1);
        }
        if let Some(place) = self.table.of_link(challenge.old) {
            self.table.leave(place, challenge.old);
        }
        self.join(now, challenge.new, challenge.address, &challenge.hello);
    }

    /// A newcomer that waits has gone itself.
    pub(super) fn forget_waiting(&mut self, new: LinkId) {
        let _ = self.take_challenge(|challenge| challenge.new == new);
    }

    fn take_challenge(&mut self, matches: impl Fn(&Challenge) -> bool) -> Option<Challenge> {
        let place = self.challenges.iter_mut().find(|place| place.as_ref().is_some_and(&matches))?;
        place.take()
    }

    fn refuse(&mut self, now: Instant, address: SocketAddr, refusal: Refusal) -> Admission {
        let counter = match refusal {
            Refusal::Version | Refusal::Malformed => NodeCounter::RefusedVersion,
            Refusal::Fleet => NodeCounter::RefusedFleet,
            Refusal::WrongManager => NodeCounter::WrongManager,
            Refusal::Full => NodeCounter::RefusedFull,
            Refusal::DuplicateIdentity => NodeCounter::RefusedDuplicate,
            Refusal::Role => NodeCounter::RefusedRole,
            Refusal::AlreadyConnected => NodeCounter::RefusedConnected,
        };
        self.counters.add(counter, 1);
        self.note(Finding { at: now, address, refusal });
        Admission::Refuse(refusal)
    }
}
