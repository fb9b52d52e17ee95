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
    use cara_core::distribution::identity::Identity;
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

        /// Whether the step that has ended computed a proof: other tasks have their turn before the next one.
        pub(crate) fn has_computed(&mut self) -> bool {
            match self {
                Self::Insecure { .. } => false,
                Self::Keys { computes, .. } => core::mem::take(computes),
            }
        }
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
