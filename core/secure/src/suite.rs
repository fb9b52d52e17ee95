//! The suites, and the primitives behind `noise-protocol`'s traits. X25519 and BLAKE2s are implemented here, since the ready-made adapters draw
//! their own random numbers and do not build without an operating system.

use blake2::{Blake2s256, Digest};
use noise_protocol::{Cipher, DH, Hash, U8Array};
use noise_rust_crypto::sensitive::Sensitive;
use x25519_dalek::{PublicKey, StaticSecret};

#[cfg(feature = "ring")]
pub(crate) use crate::fast::{Aes256Gcm, ChaCha20Poly1305};
#[cfg(not(feature = "ring"))]
pub(crate) use noise_rust_crypto::ChaCha20Poly1305;

/// A key of either cipher.
pub(crate) type Key = Sensitive<[u8; 32]>;

/// What the ends of a link use, of what both have offered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Suite {
    /// `Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s`, which every unit has.
    ChaChaPoly,
    /// `Noise_NNpsk0_25519_AESGCM_BLAKE2s`, with keys of 256 bits.
    #[cfg(feature = "ring")]
    AesGcm,
}

/// The bit of AES-256-GCM in a hello, in a build that has it.
pub(crate) const AES_GCM: u16 = if cfg!(feature = "ring") { 1 << 1 } else { 0 };

/// Does something with the suite's cipher.
macro_rules! with {
    ($suite:expr, $cipher:ident => $act:expr) => {
        match $suite {
            $crate::suite::Suite::ChaChaPoly => {
                type $cipher = $crate::suite::ChaCha20Poly1305;
                $act
            }
            #[cfg(feature = "ring")]
            $crate::suite::Suite::AesGcm => {
                type $cipher = $crate::suite::Aes256Gcm;
                $act
            }
        }
    };
}
pub(crate) use with;

impl Suite {
    /// Its bit in a hello.
    #[cfg(test)]
    pub(crate) const fn bit(self) -> u16 {
        match self {
            Self::ChaChaPoly => 1,
            #[cfg(feature = "ring")]
            Self::AesGcm => AES_GCM,
        }
    }

    /// The one to use where both ends offer `common`.
    pub(crate) const fn of(common: u16) -> Self {
        #[cfg(feature = "ring")]
        if common & AES_GCM != 0 {
            return Self::AesGcm;
        }
        let _ = common;
        Self::ChaChaPoly
    }

    /// Encrypts the first `length` bytes of `buffer`, and writes the tag behind them.
    pub(crate) fn seal(self, key: &Key, number: u64, bound: &[u8], buffer: &mut [u8], length: usize) {
        with!(self, C => C::encrypt_in_place(key, number, bound, buffer, length));
    }

    /// Decrypts body and tag; returns the length of the body.
    pub(crate) fn open(self, key: &Key, number: u64, bound: &[u8], sealed: &mut [u8]) -> Result<usize, ()> {
        let length = sealed.len();
        with!(self, C => C::decrypt_in_place(key, number, bound, sealed, length))
    }

    /// The key after this one (Noise, section 4.2).
    pub(crate) fn next(self, key: &Key) -> Key {
        with!(self, C => C::rekey(key))
    }
}

/// The key of one direction of a link.
pub(crate) struct FrameKey {
    suite: Suite,
    key: Key,
    #[cfg(feature = "ring")]
    rounds: crate::fast::Rounds,
}

impl FrameKey {
    pub(crate) fn new(suite: Suite, key: Key) -> Self {
        Self {
            suite,
            key,
            #[cfg(feature = "ring")]
            rounds: crate::fast::Rounds::new(),
        }
    }

    pub(crate) const fn suite(&self) -> Suite {
        self.suite
    }

    pub(crate) const fn key(&self) -> &Key {
        &self.key
    }

    /// The key after this one.
    pub(crate) fn next(&self) -> Self {
        Self::new(self.suite, self.suite.next(&self.key))
    }

    /// [`Suite::seal`] for a frame.
    pub(crate) fn seal(&self, number: u64, buffer: &mut [u8], length: usize) {
        #[cfg(feature = "ring")]
        if self.suite == Suite::AesGcm {
            return self.rounds.seal(&self.key, number, buffer, length);
        }
        self.suite.seal(&self.key, number, &[], buffer, length);
    }

    /// [`Suite::open`] for a frame.
    pub(crate) fn open(&self, number: u64, sealed: &mut [u8]) -> Result<usize, ()> {
        #[cfg(feature = "ring")]
        if self.suite == Suite::AesGcm {
            return self.rounds.open(&self.key, number, sealed);
        }
        self.suite.open(&self.key, number, &[], sealed)
    }
}

/// The curve's base point.
const BASE: [u8; 32] = {
    let mut point = [0; 32];
    let [first, ..] = &mut point;
    *first = 9;
    point
};

/// X25519.
pub(crate) enum X25519 {}

impl DH for X25519 {
    type Key = Sensitive<[u8; 32]>;
    type Pubkey = [u8; 32];
    type Output = Sensitive<[u8; 32]>;

    fn name() -> &'static str {
        "25519"
    }

    /// Never called: every handshake is given its key. The constant would be no secret, but [`Self::dh`] rejects it at both ends.
    fn genkey() -> Self::Key {
        Self::Key::new()
    }

    /// Uses the crate's tables for the base point on hosts, where code size does not matter. Elsewhere it is an ordinary product,
    /// which saves 2 KB of code that nothing else uses.
    fn pubkey(key: &Self::Key) -> Self::Pubkey {
        let secret = StaticSecret::from(**key);
        if cfg!(feature = "ring") {
            return PublicKey::from(&secret).to_bytes();
        }
        secret.diffie_hellman(&PublicKey::from(BASE)).to_bytes()
    }

    fn dh(key: &Self::Key, public: &Self::Pubkey) -> Result<Self::Output, ()> {
        let shared = StaticSecret::from(**key).diffie_hellman(&PublicKey::from(*public));
        // A point of small order gives the same secret with every key.
        if shared.was_contributory() { Ok(Self::Output::from_slice(shared.as_bytes())) } else { Err(()) }
    }
}

/// BLAKE2s with 32 bytes.
#[derive(Default)]
pub(crate) struct Blake2s(Blake2s256);

impl Hash for Blake2s {
    type Block = [u8; 64];
    type Output = Sensitive<[u8; 32]>;

    fn name() -> &'static str {
        "BLAKE2s"
    }

    fn input(&mut self, data: &[u8]) {
        self.0.update(data);
    }

    fn result(&mut self) -> Self::Output {
        Self::Output::from_slice(&self.0.finalize_reset())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::Suite;

    /// All suites of this build.
    pub(crate) fn suites() -> std::vec::Vec<Suite> {
        std::vec![
            Suite::ChaChaPoly,
            #[cfg(feature = "ring")]
            Suite::AesGcm,
        ]
    }
}
