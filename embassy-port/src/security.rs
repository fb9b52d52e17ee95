//! How a unit proves its identity to its peers: with keys, or, by explicit opt-in to plain mode, not at all.
//!
//! Without the crate's feature `secure` there is nothing but plain mode, and no cipher in the image.

use core::fmt;

#[cfg(feature = "secure")]
pub(crate) use self::secured::{LinkCipher, OVERHEAD, Proof};

#[cfg(not(feature = "secure"))]
pub(crate) use self::plain::{LinkCipher, OVERHEAD, Proof};

/// A unit's proof of identity, for its [`Config`](crate::Config).
pub struct Security(pub(crate) Proof);

impl Security {
    /// Links are secured, and discovery is authenticated. `keyring` has the keys of this unit, as those that `cara
    /// provision` writes to a board's flash (`cara_settings::keys::Keys`, in a static); `random` is the generator of
    /// this boot, whose boot counter has been raised.
    #[cfg(feature = "secure")]
    pub fn keys(keyring: &'static dyn cara_secure::keyring::Keyring, random: cara_secure::random::Random) -> Self {
        Self(Proof::keys(keyring, random))
    }

    /// Plain mode: every host on the network can read what units say, and can speak as any unit. Such a unit warns in
    /// its log when it starts, and connects only to units that are insecure too. `seed` should differ from boot to
    /// boot: the controller's source of noise, or a count of its starts.
    pub const fn insecure(seed: u64) -> Self {
        Self(Proof::insecure(seed))
    }
}

/// Tells the mode and no key.
impl fmt::Debug for Security {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.0.mode())
    }
}

#[cfg(feature = "secure")]
mod secured {
    use cara_core::config::Mode;
    use cara_core::distribution::claim::KEY_FINGERPRINT_BYTES;
    use cara_core::distribution::hello::Hello;
    use cara_core::distribution::identity::{Identity, Role};
    use cara_core::services::Keys;
    use cara_secure::channel::TAG_BYTES;
    use cara_secure::keyring::{Codes, Keyring};
    use cara_secure::keys::{DiscoveryKey, PairKey};
    use cara_secure::link::{Cipher, Credentials};
    use cara_secure::random::Random;

    use crate::port::Board;

    pub(crate) type LinkCipher = Cipher;

    /// Bytes that it adds to each frame.
    pub(crate) const OVERHEAD: usize = TAG_BYTES;

    // One of them lives in each unit; boxing the larger ones would need an allocator.
    #[allow(clippy::large_enum_variant)]
    pub(crate) enum Proof {
        Insecure {
            seed: u64,
        },
        Keys {
            codes: Codes<Ring>,
            random: Random,
            /// A proof has begun: two long computations.
            computes: bool,
        },
    }

    /// The keys of the unit, wherever they are kept.
    #[derive(Clone, Copy)]
    pub(crate) struct Ring(&'static dyn Keyring);

    impl Keyring for Ring {
        fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
            self.0.discovery()
        }

        fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
            self.0.pair(peer)
        }
    }

    impl Proof {
        pub(super) fn keys(keyring: &'static dyn Keyring, random: Random) -> Self {
            Self::Keys { codes: Codes::Keyed(Ring(keyring)), random, computes: false }
        }

        pub(super) const fn insecure(seed: u64) -> Self {
            Self::Insecure { seed }
        }

        pub(crate) const fn mode(&self) -> Mode {
            match self {
                Self::Insecure { .. } => Mode::Plain,
                Self::Keys { .. } => Mode::Secured,
            }
        }

        /// From which the numbers follow that only need to differ: pauses, nonces and this life's number.
        pub(crate) fn seed(&mut self) -> u64 {
            match self {
                Self::Insecure { seed } => *seed,
                Self::Keys { random, .. } => random.draw().first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes)),
            }
        }

        /// The cipher of a link that begins.
        pub(crate) fn cipher(&self) -> LinkCipher {
            Cipher::new(self.mode())
        }

        /// The codes of discovery.
        pub(crate) fn codes(&self) -> &Codes<Ring> {
            match self {
                Self::Insecure { .. } => &Codes::Plain,
                Self::Keys { codes, .. } => codes,
            }
        }

        /// The fingerprint of the key in use with a peer.
        pub(crate) fn key_of(&self, peer: &Identity) -> Option<[u8; KEY_FINGERPRINT_BYTES]> {
            let Self::Keys { codes: Codes::Keyed(ring), .. } = self else { return None };
            ring.pair(peer).map(|(key, _)| key.fingerprint())
        }

        /// Whether the key with this fingerprint is one of this unit and a peer.
        pub(crate) fn has_key(&self, peer: &Identity, key: &[u8; KEY_FINGERPRINT_BYTES]) -> bool {
            let Self::Keys { codes: Codes::Keyed(ring), .. } = self else { return false };
            let is_key = |known: &PairKey| known.fingerprint() == *key;
            ring.pair(peer).is_some_and(|(used, other)| is_key(&used) || other.as_ref().is_some_and(is_key))
        }

        /// What the claim of a manager is stored with by a unit whose home is another one, as [`StoredClaim::key`] says.
        pub(crate) fn key_away(&self, manager: &Identity, home: &Identity) -> Option<[u8; KEY_FINGERPRINT_BYTES]> {
            Some(both(self.key_of(manager)?, self.key_of(home)?))
        }

        /// The manager whose claim a unit with this home stored with such a key.
        pub(crate) fn manager_away(&self, home: &Identity, key: &[u8; KEY_FINGERPRINT_BYTES]) -> Option<Identity> {
            let Self::Keys { codes: Codes::Keyed(ring), .. } = self else { return None };
            let keys = |peer: &Identity| {
                let (used, other) = ring.pair(peer).unzip();
                [used, other.flatten()].map(|key| key.map(|key| key.fingerprint())).into_iter().flatten()
            };
            let is_of = |peer: &&Identity| keys(peer).any(|their| keys(home).any(|own| both(their, own) == *key));
            let managers = (0..).map_while(|index| ring.0.peer(index)).filter(|peer| peer.role() == Role::MUnit);
            managers.filter(|peer| *peer != home).find(is_of).cloned()
        }

        /// Whether the step that has ended computed a proof: other tasks have their turn before the next one.
        pub(crate) fn has_computed(&mut self) -> bool {
            match self {
                Self::Insecure { .. } => false,
                Self::Keys { computes, .. } => core::mem::take(computes),
            }
        }
    }

    fn both(one: [u8; KEY_FINGERPRINT_BYTES], other: [u8; KEY_FINGERPRINT_BYTES]) -> [u8; KEY_FINGERPRINT_BYTES] {
        core::array::from_fn(|index| one.get(index).zip(other.get(index)).map_or(0, |(one, other)| one ^ other))
    }

    impl Keys<Board> for Proof {
        /// What the peer has drawn is stirred in before.
        #[inline(never)]
        fn credentials(&mut self, hello: &Hello) -> Option<Credentials> {
            let Self::Keys { codes: Codes::Keyed(ring), random, computes } = self else { return None };
            *computes = true;
            random.stir(&hello.nonce.to_le_bytes());
            ring.credentials(&hello.identity, random.draw())
        }
    }
}

#[cfg(not(feature = "secure"))]
mod plain {
    use cara_core::config::Mode;
    use cara_core::distribution::claim::KEY_FINGERPRINT_BYTES;
    use cara_core::distribution::hello::Hello;
    use cara_core::distribution::identity::Identity;
    use cara_core::host::secure::Plain;
    use cara_core::services::Keys;

    use crate::port::Board;

    pub(crate) type LinkCipher = Plain;

    /// Nothing is added to a frame.
    pub(crate) const OVERHEAD: usize = 0;

    pub(crate) struct Proof {
        seed: u64,
    }

    impl Proof {
        pub(super) const fn insecure(seed: u64) -> Self {
            Self { seed }
        }

        pub(crate) const fn mode(&self) -> Mode {
            Mode::Plain
        }

        pub(crate) fn seed(&mut self) -> u64 {
            self.seed
        }

        pub(crate) fn cipher(&self) -> LinkCipher {
            Plain
        }

        pub(crate) fn codes(&self) -> &Plain {
            &Plain
        }

        pub(crate) const fn key_of(&self, _: &Identity) -> Option<[u8; KEY_FINGERPRINT_BYTES]> {
            None
        }

        pub(crate) const fn has_key(&self, _: &Identity, _: &[u8; KEY_FINGERPRINT_BYTES]) -> bool {
            false
        }

        pub(crate) const fn key_away(&self, _: &Identity, _: &Identity) -> Option<[u8; KEY_FINGERPRINT_BYTES]> {
            None
        }

        pub(crate) const fn manager_away(&self, _: &Identity, _: &[u8; KEY_FINGERPRINT_BYTES]) -> Option<Identity> {
            None
        }

        pub(crate) const fn has_computed(&mut self) -> bool {
            false
        }
    }

    impl Keys<Board> for Proof {
        fn credentials(&mut self, _: &Hello) -> Option<()> {
            None
        }
    }
}

#[cfg(all(test, feature = "secure"))]
mod tests {
    #![allow(clippy::unwrap_used)]
    extern crate std;

    use cara_core::distribution::identity::Identity;
    use cara_secure::keyring::Keyring;
    use cara_secure::keys::{DiscoveryKey, PairKey};
    use cara_secure::random::Random;

    use super::Security;

    struct Managers {
        discovery: DiscoveryKey,
        peers: [Identity; 3],
    }

    impl Keyring for Managers {
        fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
            (&self.discovery, None)
        }

        /// The first has a key beside the one in use.
        fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
            let index = self.peers.iter().position(|known| known == peer)? as u8;
            Some((PairKey::new([index + 1; 32]), (index == 0).then(|| PairKey::new([9; 32]))))
        }

        fn peer(&self, index: usize) -> Option<&Identity> {
            self.peers.get(index)
        }
    }

    #[test]
    fn a_stored_key_tells_the_manager_that_a_board_was_handed_over_to() {
        let peers = [Identity::m_unit("a", 1), Identity::m_unit("b", 2), Identity::m_unit("c", 3)].map(Result::unwrap);
        let ring =
            std::boxed::Box::leak(std::boxed::Box::new(Managers { discovery: DiscoveryKey::new([0; 32]), peers }));
        let [a, b, c] = &ring.peers;
        let Security(proof) = Security::keys(ring, Random::constant());
        let away = proof.key_away(b, a).unwrap();
        assert_eq!(proof.manager_away(a, &away).as_ref(), Some(b));
        assert_eq!(proof.manager_away(b, &proof.key_away(a, b).unwrap()).as_ref(), Some(a));
        assert_eq!(proof.manager_away(c, &away), None, "it was configured with another manager since");
        assert!(![a, b, c].iter().any(|manager| proof.has_key(manager, &away)));
        assert_eq!(proof.manager_away(a, &proof.key_of(a).unwrap()), None, "not handed over");
        assert_eq!(proof.manager_away(a, &Default::default()), None, "nothing is stored");
    }
}
