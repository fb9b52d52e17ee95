//! Codes that prove that a datagram of discovery comes from a unit of the fleet, or of the pair. The datagram is not encrypted.

use blake2::digest::Mac;

use crate::keys::{DiscoveryKey, KEY_BYTES, PairKey, keyed};

/// Length of a code.
pub const MAC_BYTES: usize = 16;

/// A key that makes codes.
pub trait Authenticates {
    /// The key, and a label that separates its codes from those of other uses.
    #[doc(hidden)]
    fn secret(&self) -> (&[u8; KEY_BYTES], &'static [u8; 4]);

    /// The code of the concatenated `parts`. Parts of variable length must contain their length.
    fn code(&self, parts: &[&[u8]]) -> [u8; MAC_BYTES] {
        let whole = self.whole(parts).finalize().into_bytes();
        let mut code = [0; MAC_BYTES];
        code.iter_mut().zip(whole).for_each(|(to, from)| *to = from);
        code
    }

    /// Whether `code` is that of `parts`, in constant time.
    fn is_code(&self, parts: &[&[u8]], code: &[u8]) -> bool {
        code.len() == MAC_BYTES && self.whole(parts).verify_truncated_left(code).is_ok()
    }

    #[doc(hidden)]
    fn whole(&self, parts: &[&[u8]]) -> blake2::Blake2sMac256 {
        let (key, purpose) = self.secret();
        let mut mac = keyed(key);
        mac.update(purpose);
        parts.iter().for_each(|part| mac.update(part));
        mac
    }
}

impl Authenticates for DiscoveryKey {
    fn secret(&self) -> (&[u8; KEY_BYTES], &'static [u8; 4]) {
        (self.expose(), b"fmac")
    }
}

impl Authenticates for PairKey {
    fn secret(&self) -> (&[u8; KEY_BYTES], &'static [u8; 4]) {
        (self.expose(), b"pmac")
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::indexing_slicing)]
    use super::*;

    #[test]
    fn every_flipped_bit_is_noticed() {
        let key = DiscoveryKey::new([1; KEY_BYTES]);
        let text = *b"who has depot?";
        let code = key.code(&[&text]);
        assert!(key.is_code(&[&text], &code));
        assert!(key.is_code(&[&text[..3], &text[3..]], &code));
        for bit in 0..text.len() * 8 {
            let mut other = text;
            other[bit / 8] ^= 1 << (bit % 8);
            assert!(!key.is_code(&[&other], &code), "bit {bit}");
        }
        for bit in 0..MAC_BYTES * 8 {
            let mut other = code;
            other[bit / 8] ^= 1 << (bit % 8);
            assert!(!key.is_code(&[&text], &other), "bit {bit}");
        }
        assert!((0..MAC_BYTES).all(|length| !key.is_code(&[&text], &code[..length])));
    }

    #[test]
    fn codes_of_other_keys_and_uses_differ() {
        let (one, other) = (DiscoveryKey::new([1; KEY_BYTES]), DiscoveryKey::new([2; KEY_BYTES]));
        assert_ne!(one.code(&[b"x"]), other.code(&[b"x"]));
        assert_ne!(one.code(&[b"x"]), PairKey::new([1; KEY_BYTES]).code(&[b"x"]));
    }
}
