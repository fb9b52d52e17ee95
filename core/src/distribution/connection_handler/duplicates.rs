//! Duplicate identity: another live node with this unit's own name and id, detected on both sides and reported to the
//! application.

use super::{Node, NodeCounter};
use crate::config::LONGEST_SEARCH;
use crate::distribution::datagram::WhoHas;
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::error::Refusal;
use crate::host::port::Port;
use crate::time::Instant;

/// What has been heard of others with this unit's identity.
#[derive(Clone, Copy, Debug)]
pub(super) struct Duplicates<E> {
    /// To be reported.
    pending: Option<E>,
    /// The boot that was reported last, and when: reports of a node that claims many boots are rate-limited.
    reported: Option<(Epoch, Instant)>,
}

impl<E> Duplicates<E> {
    pub(super) const fn new() -> Self {
        Self { pending: None, reported: None }
    }

    fn hear(&mut self, now: Instant, from: E, epoch: Epoch) {
        let known = self.reported.is_some_and(|(reported, at)| reported == epoch || now < at + LONGEST_SEARCH);
        if !known {
            (self.pending, self.reported) = (Some(from), Some((epoch, now)));
        }
    }
}

impl<P: Port> Node<P> {
    /// The address of another live node with this unit's own name and id, reported once for each of its boots. It waits
    /// until this unit stops, or this one waits for it: give each node its own name or id.
    pub fn take_duplicate(&mut self) -> Option<P::Endpoint> {
        self.duplicates.pending.take()
    }

    /// Ignores this unit's own datagrams, and records another's in its name. A manager answers the `question` of the
    /// other one, which would not detect it otherwise, and asks it in turn, for its claim.
    pub(super) fn is_own(
        &mut self,
        now: Instant,
        from: P::Endpoint,
        identity: &Identity,
        epoch: Epoch,
        question: Option<&WhoHas>,
    ) -> bool {
        if *identity != self.config.identity {
            return false;
        }
        if let Some(who_has) = question.filter(|who_has| who_has.standby) {
            // It commands nothing, and is to know that this manager lives.
            if epoch != self.config.epoch && self.role() == Role::MUnit {
                self.answer_later(now, from, identity, who_has.nonce);
            }
            return true;
        }
        if epoch != self.config.epoch {
            self.counters.count(NodeCounter::OwnIdentity);
            self.note_of(now, from, identity, Refusal::DuplicateIdentity);
            self.duplicates.hear(now, from, epoch);
            if let Some(who_has) = question.filter(|_| self.role() == Role::MUnit) {
                self.answer_later(now, from, identity, who_has.nonce);
                // With a growing pause, so that two do not ask each other without end.
                if who_has.tcp_port != 0 {
                    self.hints.plan(now, from, identity, now);
                }
            }
        }
        true
    }
}
