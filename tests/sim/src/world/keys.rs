//! The keys of a simulated unit, all of them derived from a root of its fleet.

use std::collections::BTreeSet;

use cara_core::config::Mode;
use cara_core::distribution::authenticator::Authenticator;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::random::Random;
use cara_secure::keyring::{Codes, Keyring};
use cara_secure::keys::{DiscoveryKey, PairKey, RootKey};
use cara_secure::link::{Cipher, Credentials};

/// The generation of all keys.
const GENERATION: u32 = 1;

/// What a unit is given in every life.
#[derive(Clone, Debug)]
pub(super) struct Given {
    pub(super) mode: Mode,
    /// Tells roots apart: units of different roots have no key in common.
    pub(super) root: u8,
    /// Names of units for which it has no key.
    pub(super) missing: BTreeSet<String>,
}

impl Given {
    pub(super) fn new(mode: Mode) -> Self {
        Self { mode, root: 0, missing: BTreeSet::new() }
    }
}

/// The keys of one life.
pub(super) struct Keys {
    pub(super) codes: Codes<Ring>,
    random: Random,
}

/// Derives what it is asked for.
pub(super) struct Ring {
    root: RootKey,
    discovery: DiscoveryKey,
    missing: BTreeSet<String>,
    own: Identity,
    fleet: Fleet,
}

impl Keyring for Ring {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        (&self.discovery, None)
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        let known = !self.missing.contains(peer.name());
        known.then(|| (self.root.pair(self.fleet, GENERATION, &self.own, peer), None))
    }
}

impl Keys {
    pub(super) fn new(given: Given, own: Identity, fleet: Fleet, random: Random) -> Self {
        let root = RootKey::new([given.root; 32]);
        let discovery = root.discovery(fleet, GENERATION);
        let codes = match given.mode {
            Mode::Plain => Codes::Plain,
            Mode::Secured => Codes::Keyed(Ring { root, discovery, missing: given.missing, own, fleet }),
        };
        Self { codes, random }
    }

    pub(super) fn cipher(&self) -> Cipher {
        Cipher::new(self.codes.mode())
    }

    /// What proves this unit to a peer. `None` without a key for it.
    pub(super) fn credentials(&mut self, peer: &Identity) -> Option<Credentials> {
        let Codes::Keyed(ring) = &self.codes else { return None };
        let mut fresh = [0; 32];
        fresh.chunks_exact_mut(8).for_each(|part| part.copy_from_slice(&self.random.bits().to_le_bytes()));
        ring.credentials(peer, fresh)
    }
}
