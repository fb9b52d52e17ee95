//! The cipher of CARA: `Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s` with a key for each pair of units, or the same with AES-256-GCM.
//!
//! - [`keys`]: the keys of a fleet, derived from one root that stays on the host where they are made;
//! - [`suite`]: the ciphers that the ends of a link may choose from;
//! - [`handshake`]: two messages that prove the pair's key and agree on keys for one link;
//! - [`channel`]: the frames of a link, sealed in place;
//! - [`datagram`]: the link's datagrams, with their own keys and a replay window;
//! - [`link`]: the cipher of one link, composed of these three;
//! - [`keyring`]: where a unit finds its keys, and the authentication codes that it makes with them;
//! - [`mac`]: codes for discovery, which is authenticated but not encrypted;
//! - [`random`]: random numbers for boards, whose sources of noise may be poor.
//!
//! # What is implemented
//! | what | from |
//! |---|---|
//! | the handshake, with the pair's key as psk 0 | [Noise Protocol Framework](https://noiseprotocol.org/noise.html), sections 5, 7 and 9 |
//! | a live link's keys renewed by a handshake over the hash of the last one | the same, section 11.2 (channel binding) |
//! | rekeying each 2^20 frames | the same, sections 4.2 and 11.3 |
//! | X25519; ChaCha20-Poly1305; AES-256-GCM; BLAKE2s | [RFC 7748](https://www.rfc-editor.org/rfc/rfc7748); [RFC 8439](https://www.rfc-editor.org/rfc/rfc8439); [SP 800-38D](https://doi.org/10.6028/NIST.SP.800-38D); [RFC 7693](https://www.rfc-editor.org/rfc/rfc7693) |
//! | the window of 64 datagrams | as [RFC 4303](https://www.rfc-editor.org/rfc/rfc4303#section-3.4.3), section 3.4.3 |
//!
//! `docs/wire.md`, section 17, has the bytes.
//!
//! With the feature `ring`, frames and datagrams are sealed by *ring*, several times as fast on a Linux host; without it, by
//! portable code, as on boards. Both produce the same bytes. AES-256-GCM needs that feature.
//!
//! Each hello offers suites, a bit each, and the handshake authenticates both; nothing else is negotiated. This crate has no source of
//! randomness, reads no file and allocates nothing: the caller supplies 32 fresh bytes for each handshake. Which peer may do what
//! is decided by access tables, not here.

#![no_std]

#[cfg(any(test, feature = "ring"))]
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
pub mod suite;
