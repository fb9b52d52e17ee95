//! Where a unit finds its keys, and the authentication of discovery with them.

use cara_core::config::Mode;
use cara_core::distribution::authenticator::{Authenticator, CODE_BYTES};
use cara_core::distribution::identity::Identity;

use crate::keys::{DiscoveryKey, PairKey};
use crate::link::Credentials;
use crate::mac::Authenticates;

/// The keys of one unit, wherever they are stored. While a fleet changes its keys, a unit has two of each: it sends with the
/// first and accepts either.
pub trait Keyring {
    /// The fleet's discovery keys.
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>);

    /// The keys of this unit and `peer`. `None` if there are none.
    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)>;

    /// The peers that it has keys for, by an index from 0 on. Asked for by a board that can be handed over to another manager.
    fn peer(&self, index: usize) -> Option<&Identity> {
        let _ = index;
        None
    }

    /// What authenticates this unit to `peer` on one link. `fresh` is 32 random bytes for this link only.
    fn credentials(&self, peer: &Identity, fresh: [u8; 32]) -> Option<Credentials> {
        self.pair(peer).map(|(key, other)| Credentials::new(key, fresh).or(other))
    }
}

/// Authenticates a unit's discovery; not in plain mode.
#[derive(Clone, Debug)]
pub enum Codes<K> {
    /// Nothing is authenticated.
    Plain,
    /// Codes are made and checked with these keys.
    Keyed(K),
}

impl<K: Keyring> Codes<K> {
    fn keyring(&self) -> Option<&K> {
        if let Self::Keyed(keyring) = self { Some(keyring) } else { None }
    }
}

impl<K: Keyring> Authenticator for Codes<K> {
    fn mode(&self) -> Mode {
        if self.keyring().is_some() { Mode::Secured } else { Mode::Plain }
    }

    fn sign_for_fleet(&self, datagram: &[u8]) -> [u8; CODE_BYTES] {
        self.keyring().map_or([0; CODE_BYTES], |keyring| keyring.discovery().0.code(&[datagram]))
    }

    fn is_of_fleet(&self, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        let Some((key, other)) = self.keyring().map(Keyring::discovery) else { return false };
        key.is_code(&[datagram], code) || other.is_some_and(|key| key.is_code(&[datagram], code))
    }

    fn sign_for(&self, peer: &Identity, datagram: &[u8]) -> Option<[u8; CODE_BYTES]> {
        self.keyring()?.pair(peer).map(|(key, _)| key.code(&[datagram]))
    }

    fn is_of(&self, peer: &Identity, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        let Some((key, other)) = self.keyring().and_then(|keyring| keyring.pair(peer)) else { return false };
        key.is_code(&[datagram], code) || other.is_some_and(|key| key.is_code(&[datagram], code))
    }
}
