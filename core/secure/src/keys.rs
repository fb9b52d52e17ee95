//! The keys of a fleet (docs/keys.md).
//!
//! A **root** stays on the provisioning host. From it are derived a **pair key** for each two units that may communicate, and a
//! **discovery key** for the fleet. A pair key lets its holder act as either unit of the pair, towards the other only. To revoke
//! a unit, leave its pairs out when raising the generation.

use core::fmt;

use blake2::Blake2sMac256;
use blake2::digest::{KeyInit, Mac};
use cara_core::distribution::identity::{Fleet, Identity, Role};
use zeroize::{Zeroize, ZeroizeOnDrop};

/// Bytes of each key.
pub const KEY_BYTES: usize = 32;
/// Bytes of a key's fingerprint.
pub const FINGERPRINT_BYTES: usize = 6;

macro_rules! key {
    ($(#[$meta:meta])* $name:ident) => {
        $(#[$meta])*
        #[derive(Clone, Zeroize, ZeroizeOnDrop)]
        pub struct $name([u8; KEY_BYTES]);

        impl $name {
            /// A key from its bytes.
            pub const fn new(bytes: [u8; KEY_BYTES]) -> Self {
                Self(bytes)
            }

            /// Its bytes, to be written to a key file or to flash.
            pub const fn expose(&self) -> &[u8; KEY_BYTES] {
                &self.0
            }

            /// Identifies the key in public: equal for equal keys, and nothing of the key can be computed from it.
            pub fn fingerprint(&self) -> [u8; FINGERPRINT_BYTES] {
                fingerprint(&self.0)
            }
        }

        /// Reveals nothing of the key.
        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(concat!(stringify!($name), "(…)"))
            }
        }
    };
}

key! {
    /// The root of a fleet's keys. It never leaves the provisioning host.
    RootKey
}
key! {
    /// The key of two units.
    PairKey
}
key! {
    /// The key that authenticates discovery within a fleet.
    DiscoveryKey
}
key! {
    /// The seed of a board's random numbers. Drawn whenever a board is provisioned, and not derived from the root: a leaked root
    /// does not reveal what the board has drawn.
    DeviceSecret
}

impl RootKey {
    /// The key of two units, in either order.
    pub fn pair(&self, fleet: Fleet, generation: u32, one: &Identity, other: &Identity) -> PairKey {
        let (first, second) = if one <= other { (one, other) } else { (other, one) };
        let mut mac = self.begin(b"pair", fleet, generation);
        [first, second].into_iter().for_each(|identity| name(&mut mac, identity));
        PairKey(mac.finalize().into_bytes().into())
    }

    /// The fleet's discovery key.
    pub fn discovery(&self, fleet: Fleet, generation: u32) -> DiscoveryKey {
        DiscoveryKey(self.begin(b"disc", fleet, generation).finalize().into_bytes().into())
    }

    fn begin(&self, purpose: &[u8; 4], fleet: Fleet, generation: u32) -> Blake2sMac256 {
        let mut mac = keyed(&self.0);
        mac.update(purpose);
        mac.update(&fleet.0.to_le_bytes());
        mac.update(&generation.to_le_bytes());
        mac
    }
}

/// Hashes an identity, unambiguously.
fn name(mac: &mut Blake2sMac256, identity: &Identity) {
    let role = match identity.role() {
        Role::MUnit => 0,
        Role::SUnit => 1,
    };
    mac.update(&[role, identity.name().len() as u8]);
    mac.update(identity.name().as_bytes());
    mac.update(&identity.id().to_le_bytes());
}

fn fingerprint(key: &[u8; KEY_BYTES]) -> [u8; FINGERPRINT_BYTES] {
    let mut mac = keyed(key);
    mac.update(b"show");
    let whole: [u8; KEY_BYTES] = mac.finalize().into_bytes().into();
    whole.first_chunk().copied().unwrap_or_default()
}

pub(crate) fn keyed(key: &[u8; KEY_BYTES]) -> Blake2sMac256 {
    <Blake2sMac256 as KeyInit>::new(key.into())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::collections::HashSet;
    use std::format;

    fn root() -> RootKey {
        RootKey::new([7; KEY_BYTES])
    }

    fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    #[test]
    fn both_ends_derive_the_same_key() {
        let manager = Identity::m_unit("depot", 1).unwrap();
        let one = root().pair(Fleet(3), 1, &manager, &agv(17));
        assert_eq!(one.expose(), root().pair(Fleet(3), 1, &agv(17), &manager).expose());
    }

    #[test]
    fn whatever_differs_makes_another_key() {
        let manager = Identity::m_unit("depot", 1).unwrap();
        let twin = Identity::m_unit("agv", 17).unwrap();
        let longer = Identity::s_unit("agv1", 7).unwrap();
        let pair = |root: &RootKey, fleet, generation, other: &Identity| {
            *root.pair(Fleet(fleet), generation, &manager, other).expose()
        };
        let keys = [
            pair(&root(), 3, 1, &agv(17)),
            pair(&RootKey::new([8; KEY_BYTES]), 3, 1, &agv(17)),
            pair(&root(), 4, 1, &agv(17)),
            pair(&root(), 3, 2, &agv(17)),
            pair(&root(), 3, 1, &agv(18)),
            pair(&root(), 3, 1, &twin),
            pair(&root(), 3, 1, &longer),
            *root().discovery(Fleet(3), 1).expose(),
            *root().discovery(Fleet(4), 1).expose(),
            *root().discovery(Fleet(3), 2).expose(),
        ];
        assert_eq!(HashSet::from(keys).len(), keys.len());
    }

    /// A change of the derivation would lock out every unit that was provisioned before.
    #[test]
    fn the_derivation_stays() {
        let manager = Identity::m_unit("depot", 1).unwrap();
        let shown =
            |bytes: &[u8]| bytes.iter().fold(std::string::String::new(), |text, byte| text + &format!("{byte:02x}"));
        let (pair, discovery) = (root().pair(Fleet(3), 1, &manager, &agv(17)), root().discovery(Fleet(3), 1));
        // Computed with another implementation, Python's `hashlib.blake2s(…, key=bytes([7] * 32))`; docs/keys.md has them.
        assert_eq!(shown(pair.expose()), "2be3d533d8d6234ec6a1992b8b145520cc16b1587ea980a8d609282c2b18f4f2");
        assert_eq!(shown(discovery.expose()), "80bac0f6c5a1a40734539c79423d7a50d5d04a6e55837ea100ac549404afabfd");
        assert_eq!(shown(&root().fingerprint()), "6b627df40843");
    }

    #[test]
    fn nothing_of_a_key_is_shown() {
        assert_eq!(format!("{:?}", root()), "RootKey(…)");
        assert_eq!(format!("{:?}", root().discovery(Fleet(1), 1)), "DiscoveryKey(…)");
        assert_eq!(format!("{:?}", DeviceSecret::new([7; KEY_BYTES])), "DeviceSecret(…)");
    }

    #[test]
    fn keys_are_told_apart_by_their_fingerprints() {
        let shown = RootKey::new([7; KEY_BYTES]).fingerprint();
        assert_eq!(shown, PairKey::new([7; KEY_BYTES]).fingerprint());
        assert_ne!(shown, RootKey::new([8; KEY_BYTES]).fingerprint());
        assert!(!shown.contains(&7));
    }
}
