//! The cipher of CARA: one suite, `Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s`, with a key for each pair of units.
//!
//! - [`keys`]: the keys of a fleet, derived from one root that stays where they are made;
//! - [`handshake`]: two messages that prove the pair's key, and agree on keys of this link alone;
//! - [`channel`]: the frames of a link, sealed in place;
//! - [`datagram`]: the datagrams beside it, with keys of their own and a window against replays;
//! - [`link`]: the cipher of one link, which joins the two above and the datagrams;
//! - [`keyring`]: where a unit finds its keys, and the codes that it makes with them;
//! - [`mac`]: codes for discovery, which is authenticated and not secret;
//! - [`random`]: random numbers for boards, whose sources of noise may be poor.
//!
//! With the feature `ring`, frames and datagrams are sealed by *ring*, which is several times as fast on a Linux host;
//! without it, by portable code, which boards use. Both seal alike.
//!
//! Another suite would be another version of the protocol; nothing is negotiated. This crate has no source of
//! randomness, reads no file and allocates nothing: the caller supplies 32 fresh bytes for each handshake. It does not
//! decide which peer may speak; that is the business of the tables above.

#![no_std]

#[cfg(test)]
extern crate std;

pub mod channel;
pub mod datagram;
#[cfg(feature = "ring")]
mod fast;
pub mod handshake;
pub mod keyring;
pub mod keys;
pub mod link;
pub mod mac;
pub mod random;
mod suite;
