//! Duplicate detection before a manager starts: does a live unit already have its identity?
//!
//! The question is a [`WhoHas`] for the unit itself, with a fresh nonce; only holders of this identity's keys can answer it. If
//! two units ask at the same time, the one with the greater epoch answers, so that only one of them starts.

use super::authenticator::Authenticator;
use super::datagram::{Announce, Datagram, SEARCH_BYTES, WhoHas};
use super::hello::{ClaimReport, Manager};
use super::identity::{Epoch, Fleet, Identity};
use crate::host::endpoint::Endpoint;
use crate::time::Duration;

/// How long a manager waits for an answer before it starts. A live unit answers at once.
pub const PRESENCE_WAIT: Duration = Duration::from_millis(300);
/// Interval between questions, repeated so that a lost datagram does not start a second manager.
pub const PRESENCE_PAUSE: Duration = Duration::from_millis(90);

/// A search for the unit's own identity. See the [module](self).
#[derive(Clone, Debug)]
pub struct Presence {
    identity: Identity,
    fleet: Fleet,
    epoch: Epoch,
    nonce: u64,
    sequence: u32,
}

/// What a datagram means for a unit that asks.
#[derive(Debug, PartialEq, Eq)]
pub enum Heard<'o, E> {
    /// It is irrelevant.
    Nothing,
    /// Another unit asks the same and has to yield: send this answer to the datagram's source.
    Answer(&'o [u8]),
    /// A live unit has the identity.
    Running {
        /// Where it can be dialled.
        at: E,
        /// Its claim, if genuine. A unit that takes over has to claim a higher one.
        claim: Option<ClaimReport>,
    },
}

impl Presence {
    /// For a unit that has not started. The nonce must be fresh.
    pub const fn new(identity: Identity, fleet: Fleet, epoch: Epoch, nonce: u64) -> Self {
        // Not 0, which marks an announcement that answers no question.
        Self { identity, fleet, epoch, nonce: nonce | 1, sequence: 0 }
    }

    /// Encodes the datagram to broadcast into `out`.
    pub fn question<'o>(
        &mut self,
        authenticator: &dyn Authenticator,
        out: &'o mut [u8; SEARCH_BYTES],
    ) -> Option<&'o [u8]> {
        self.sequence = self.sequence.wrapping_add(1);
        let who_has = WhoHas {
            identity: self.identity.clone(),
            epoch: self.epoch,
            sequence: self.sequence,
            nonce: self.nonce,
            wanted: Some(Manager::new(self.identity.name(), self.identity.id()).ok()?),
            tcp_port: 0,
            expected: 1,
            known: heapless::Vec::new(),
            standby: false,
            skipped: 0,
        };
        who_has.encode(self.fleet, authenticator, out)
    }

    /// Takes a datagram that arrives while the unit waits. Only an answer to its own question proves a live unit.
    pub fn hear<'o, E: Endpoint>(
        &self,
        from: E,
        bytes: &[u8],
        authenticator: &dyn Authenticator,
        out: &'o mut [u8; SEARCH_BYTES],
    ) -> Heard<'o, E> {
        match Datagram::decode(bytes, self.fleet, authenticator) {
            Ok(Datagram::Announce(announce)) if self.is_answer(&announce) => {
                let is_genuine = |claim: &ClaimReport| claim.tagged.is_genuine(&self.identity, authenticator);
                Heard::Running { at: from.at_port(announce.tcp_port), claim: announce.claim.filter(is_genuine) }
            }
            Ok(Datagram::WhoHas(who_has)) if self.gives_way(&who_has) => {
                self.answer(who_has.nonce, authenticator, out).map_or(Heard::Nothing, Heard::Answer)
            }
            _ => Heard::Nothing,
        }
    }

    /// Excludes this unit's own datagrams, which another host may replay.
    fn is_answer(&self, announce: &Announce) -> bool {
        announce.identity == self.identity && announce.nonce == self.nonce && announce.epoch != self.epoch
    }

    fn gives_way(&self, who_has: &WhoHas) -> bool {
        let asks_the_same = who_has.wanted.as_ref().is_some_and(|wanted| wanted.is(&self.identity));
        who_has.identity == self.identity && asks_the_same && who_has.epoch < self.epoch
    }

    fn answer<'o>(
        &self,
        nonce: u64,
        authenticator: &dyn Authenticator,
        out: &'o mut [u8; SEARCH_BYTES],
    ) -> Option<&'o [u8]> {
        let announce = Announce {
            identity: self.identity.clone(),
            epoch: self.epoch,
            claim: None,
            obeyed: None,
            sequence: self.sequence,
            nonce,
            tcp_port: 0,
            room: 0,
            expected: 1,
            skipped: 0,
        };
        announce.encode(self.fleet, authenticator, Some(&self.identity), out)
    }
}
