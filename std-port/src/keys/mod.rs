//! Key files: the ring of each node, and the fleet that the rings come from.
//!
//! A node has one [`KeyRing`]: the key for discovery, and one key for each node that it may talk to. It lies in a file
//! that only its owner can read; [`location::find`] tells where it is looked for, and [`LiveRing`] takes a new one while
//! the node runs. A [`FleetKeys`] has the root from which all rings come, and stays where nodes are provisioned;
//! [`Store`] keeps it in a folder. The command `cara keys` does nothing that is not here.
//!
//! ```
//! use cara_std::keys::FleetKeys;
//! use cara_std::{Fleet, Identity};
//!
//! let (depot, agv) = (Identity::m_unit("depot", 1)?, Identity::s_unit("agv-17", 17)?);
//! let mut keys = FleetKeys::draw(Fleet(7))?;
//! keys.add(&depot, &[])?;
//! keys.add(&agv, &[])?;
//! let (ours, theirs) = (keys.ring(&depot)?, keys.ring(&agv)?);
//! assert_eq!(ours.pair(&agv).map(|key| key.expose()), theirs.pair(&depot).map(|key| key.expose()));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Keys are wiped from memory when they are dropped, are moved as little as can be, and are never in a `Debug`, an error
//! or the log. What the kernel writes to swap or to a core dump is not prevented.

mod claims;
mod error;
mod file;
mod fleet;
mod live;
pub mod location;
mod members;
mod named;
mod ring;
mod store;
mod text;

pub use cara_secure::keys::{DeviceSecret, DiscoveryKey, KEY_BYTES, PairKey, RootKey};
pub(crate) use claims::{KeptClaims, KeptHandOver, KeptObeyed, read_claims, write_claims};
pub use error::{FleetError, KeyError, Owner};
#[cfg(feature = "access")]
pub(crate) use file::Mark;
pub(crate) use file::make_folder;
pub use file::{check_replaceable, write_private};
pub use fleet::FleetKeys;
pub use live::LiveRing;
pub use members::{Member, Members, Revoked};
pub use named::{full_name, parse_node};
pub use ring::KeyRing;
pub use store::{Change, Store, Written};

/// Fills an array with random bytes of the kernel's.
pub fn draw<const BYTES: usize>() -> Result<zeroize::Zeroizing<[u8; BYTES]>, KeyError> {
    let mut bytes = zeroize::Zeroizing::new([0; BYTES]);
    getrandom::fill(bytes.as_mut_slice()).map_err(|error| KeyError::NoRandomness(error.to_string()))?;
    Ok(bytes)
}

/// A fingerprint in hexadecimal.
///
/// ```
/// assert_eq!(cara_std::keys::shown([1, 2, 3, 4, 5, 0xAF]), "0102030405af");
/// ```
pub fn shown(fingerprint: [u8; cara_secure::keys::FINGERPRINT_BYTES]) -> String {
    fingerprint.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// What a file of claims says, whatever its checksum, and the text that is written of that; for `tests/fuzz`.
#[doc(hidden)]
pub fn claims_again(text: &str) -> Result<[String; 2], KeyError> {
    let form = |error| file::form(std::path::Path::new("claims"), error);
    claims::parse(text).map(|kept| [format!("{kept:?}"), claims::text(&kept)]).map_err(form)
}

/// The same of a list of members.
#[doc(hidden)]
pub fn members_again(text: &str) -> Result<[String; 2], KeyError> {
    let form = |error| file::form(std::path::Path::new("members"), error);
    Members::parse(text).map(|members| [format!("{members:?}"), members.text()]).map_err(form)
}
