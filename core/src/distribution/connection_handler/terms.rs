//! Terms: which of two managers of one identity commands. Only what has been proven counts: a hello behind its handshake,
//! or the answer to a question of this unit.

use super::Node;
use crate::distribution::datagram::Announce;
use crate::distribution::hello::Hello;
use crate::distribution::identity::Role;
use crate::error::Refusal;
use crate::host::port::Port;
use crate::term::Term;
use crate::time::Instant;

/// A term that is newer than this unit's has been proven to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NewerTerm {
    /// An s_unit obeys it from here on. To be kept before a call of the manager runs: no order is live now.
    Obeyed(Term),
    /// A vehicle has obeyed it: this m_unit is fenced, or has lost the term that it kept.
    AtVehicle(Term),
    /// A live manager of this m_unit's identity has it: this one is fenced.
    OfManager(Term),
}

/// The term of this unit, and what it has heard of newer ones.
#[derive(Clone, Copy, Debug)]
pub(super) struct Terms {
    /// Of an m_unit its own, of an s_unit the newest that it has obeyed.
    pub(super) own: Term,
    /// To be reported.
    newer: Option<NewerTerm>,
    /// When another manager of this identity proved itself last; in the far future while none has.
    another: Instant,
}

impl Terms {
    pub(super) const fn new() -> Self {
        Self { own: Term::NONE, newer: None, another: Instant::FAR_FUTURE }
    }
}

impl<P: Port> Node<P> {
    /// The term of an m_unit, or the newest that an s_unit has obeyed.
    pub const fn term(&self) -> Term {
        self.terms.own
    }

    /// What this unit has kept: the newest term that an s_unit has obeyed, or the one that an m_unit claims, which it keeps
    /// before it is told here. Links that there are stay as they are.
    pub fn set_term(&mut self, term: Term) {
        self.terms.own = term;
    }

    /// A newer term than this unit's, reported once. To be asked after each [`datagram`](Self::datagram), and when a link has
    /// joined or ended.
    pub fn take_newer_term(&mut self) -> Option<NewerTerm> {
        self.terms.newer.take()
    }

    /// When another live manager of this m_unit's identity proved itself last.
    pub fn another_proven_at(&self) -> Option<Instant> {
        Some(self.terms.another).filter(|at| *at != Instant::FAR_FUTURE)
    }

    /// Whether the link's manager has the right to command its vehicle, whichever of the two this unit is.
    pub(super) fn check_term(&self, hello: &Hello) -> Result<(), Refusal> {
        let (manager, obeyed) = match (self.config.identity.role(), hello.identity.role()) {
            (Role::SUnit, _) => (hello.term, self.terms.own),
            (Role::MUnit, Role::SUnit) => (self.terms.own, hello.term),
            (Role::MUnit, Role::MUnit) => return Ok(()),
        };
        if obeyed.is_newer_than(manager) { Err(Refusal::Fenced) } else { Ok(()) }
    }

    /// A vehicle that has proven itself has obeyed a newer term than this manager's.
    pub(super) fn fenced_at_vehicle(&mut self, term: Term) {
        if self.config.identity.role() == Role::MUnit {
            self.terms.newer.get_or_insert(NewerTerm::AtVehicle(term));
        }
    }

    /// An s_unit obeys its manager, which has joined: no link of an earlier one is left.
    pub(super) fn obey(&mut self, term: Term) {
        if self.config.identity.role() == Role::SUnit && term.is_newer_than(self.terms.own) {
            self.terms.own = term;
            self.terms.newer = Some(NewerTerm::Obeyed(term));
        }
    }

    /// Another unit with this one's identity has answered, to be heard only if it answers a question of this one.
    pub(super) fn another_answered(&mut self, now: Instant, announce: &Announce) {
        if self.config.identity.role() == Role::MUnit && announce.nonce == self.search.nonce {
            self.terms.another = now;
            if announce.term.is_newer_than(self.terms.own) {
                self.terms.newer = Some(NewerTerm::OfManager(announce.term));
            }
        }
    }
}
