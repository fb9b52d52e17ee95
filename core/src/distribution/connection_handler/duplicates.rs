//! Duplicate identity: another live node with this unit's own name and id, detected on both sides and reported to the
//! application.

use super::{Node, NodeCounter};
use crate::config::LONGEST_SEARCH;
use crate::distribution::datagram::WhoHas;
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::error::Refusal;
use crate::host::port::Port;
use crate::time::Instant;

/// Other nodes with this unit's identity.
#[derive(Clone, Copy, Debug)]
pub(super) struct Duplicates<E> {
    /// The address that has yet to be reported.
    pending: Option<E>,
    /// The boot that was reported last, and when: reports are rate-limited, in case a node claims many boots.
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
    /// The address of another live node with this unit's own name and id, reported once for each of its boots. One of the two
    /// waits until the other stops: give each node its own name or id.
    pub fn take_duplicate(&mut self) -> Option<P::Endpoint> {
        self.duplicates.pending.take()
    }

    /// Ignores this unit's own datagrams, and records those of another unit in its name. A manager answers the other's
    /// `question`, so that the other detects the conflict, too, and asks for its claim in turn.
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
            // A standby does not command, but has to know that this manager is alive.
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
                // With growing back-off, so that the two do not ask each other without end.
                if who_has.tcp_port != 0 {
                    self.hints.plan(now, from, identity, now);
                }
            }
        }
        true
    }
}
