//! The keys of a simulated unit, all of them derived from a root of its fleet.

use std::collections::BTreeSet;

use cara_core::config::Mode;
use cara_core::distribution::authenticator::Authenticator;
use cara_core::distribution::hello::Hello;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::random::Random;
use cara_core::services;
use cara_core::time::Duration;
use cara_secure::keyring::{Codes, Keyring};
use cara_secure::keys::{DiscoveryKey, PairKey, RootKey};
use cara_secure::link::Credentials;

use super::audited::{Audited, Seals};
use super::links::Simulated;

/// The generation of all keys at first.
const GENERATION: u32 = 1;

/// What a unit is given in every life.
#[derive(Clone, Debug)]
pub(super) struct Given {
    pub(super) mode: Mode,
    /// Tells roots apart: units of different roots have no key in common.
    pub(super) root: u8,
    /// Names of units for which it has no key.
    pub(super) missing: BTreeSet<String>,
    /// How old the keys of a link become, instead of 12 h.
    pub(super) renews_every: Option<Duration>,
    seals: Seals,
}

impl Given {
    pub(super) fn new(mode: Mode, seals: Seals) -> Self {
        Self { mode, root: 0, missing: BTreeSet::new(), renews_every: None, seals }
    }
}

/// The keys of one life.
pub(super) struct Keys {
    pub(super) codes: Codes<Ring>,
    /// How old the keys of a link become, if not 12 h.
    pub(super) renews_every: Option<Duration>,
    seals: Seals,
    random: Random,
}

/// A unit's keys, derived when they are asked for: units with rings of one root can talk to each other.
pub struct Ring {
    root: RootKey,
    discovery: DiscoveryKey,
    other_discovery: Option<DiscoveryKey>,
    generation: u32,
    /// The one beside it while the keys are changed.
    other: Option<u32>,
    missing: BTreeSet<String>,
    own: Identity,
    fleet: Fleet,
}

impl Ring {
    /// Tells roots apart by a number: units of different roots have no key in common.
    pub fn new(root: u8, own: Identity, fleet: Fleet) -> Self {
        let root = RootKey::new([root; 32]);
        Self {
            discovery: root.discovery(fleet, GENERATION),
            root,
            other_discovery: None,
            generation: GENERATION,
            other: None,
            missing: BTreeSet::new(),
            own,
            fleet,
        }
    }
}

impl Keyring for Ring {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        (&self.discovery, self.other_discovery.as_ref())
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        let known = !self.missing.contains(peer.name());
        let of = |generation| self.root.pair(self.fleet, generation, &self.own, peer);
        known.then(|| (of(self.generation), self.other.map(of)))
    }
}

impl Keys {
    pub(super) fn new(given: Given, own: Identity, fleet: Fleet, random: Random) -> Self {
        let Given { renews_every, seals, .. } = given.clone();
        let codes = match given.mode {
            Mode::Plain => Codes::Plain,
            Mode::Secured => Codes::Keyed(Ring { missing: given.missing, ..Ring::new(given.root, own, fleet) }),
        };
        Self { codes, renews_every, seals, random }
    }

    pub(super) fn cipher(&self) -> Audited {
        Audited::new(self.codes.mode(), &self.seals)
    }

    /// It has no key for units of this name any more.
    pub(super) fn forget(&mut self, name: &str) {
        if let Codes::Keyed(ring) = &mut self.codes {
            ring.missing.insert(name.to_owned());
        }
    }

    /// It has the keys of this generation now, and those of the other one beside them.
    pub(super) fn change(&mut self, generation: u32, other: Option<u32>) {
        if let Codes::Keyed(ring) = &mut self.codes {
            (ring.generation, ring.other) = (generation, other);
            ring.discovery = ring.root.discovery(ring.fleet, generation);
            ring.other_discovery = other.map(|other| ring.root.discovery(ring.fleet, other));
        }
    }
}

impl services::Keys<Simulated> for Keys {
    fn credentials(&mut self, hello: &Hello) -> Option<Credentials> {
        let Codes::Keyed(ring) = &self.codes else { return None };
        let mut fresh = [0; 32];
        fresh.chunks_exact_mut(8).for_each(|part| part.copy_from_slice(&self.random.bits().to_le_bytes()));
        ring.credentials(&hello.identity, fresh)
    }
}
