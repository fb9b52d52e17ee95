//! ChaCha20-Poly1305 of *ring*, whose assembly needs a tenth of the time for short frames and half of it for long ones.

use noise_protocol::{Cipher, U8Array};
use noise_rust_crypto::sensitive::Sensitive;
use ring::aead::{Aad, CHACHA20_POLY1305, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};

const TAG_BYTES: usize = 16;

/// The cipher, behind `noise-protocol`'s trait.
pub(crate) enum ChaCha20Poly1305 {}

impl Cipher for ChaCha20Poly1305 {
    type Key = Sensitive<[u8; 32]>;

    fn name() -> &'static str {
        "ChaChaPoly"
    }

    fn encrypt(key: &Self::Key, nonce: u64, bound: &[u8], plain: &[u8], out: &mut [u8]) {
        if let Some(body) = out.get_mut(..plain.len()) {
            body.copy_from_slice(plain);
        }
        Self::encrypt_in_place(key, nonce, bound, out, plain.len());
    }

    fn encrypt_in_place(key: &Self::Key, nonce: u64, bound: &[u8], buffer: &mut [u8], length: usize) -> usize {
        if seal(key, nonce, bound, buffer, length).is_none() {
            // Beyond 256 GiB, or without capacity for the tag. Never send plain text.
            buffer.fill(0);
        }
        length.saturating_add(TAG_BYTES)
    }

    fn decrypt(key: &Self::Key, nonce: u64, bound: &[u8], sealed: &[u8], out: &mut [u8]) -> Result<(), ()> {
        // Body and tag in one buffer. Only handshake messages, which are short, are opened like this.
        let mut both = [0; 64 + TAG_BYTES];
        let both = both.get_mut(..sealed.len()).ok_or(())?;
        both.copy_from_slice(sealed);
        let length = Self::decrypt_in_place(key, nonce, bound, both, sealed.len())?;
        out.copy_from_slice(both.get(..length).filter(|body| body.len() == out.len()).ok_or(())?);
        Ok(())
    }

    fn decrypt_in_place(
        key: &Self::Key,
        nonce: u64,
        bound: &[u8],
        buffer: &mut [u8],
        length: usize,
    ) -> Result<usize, ()> {
        let sealed = buffer.get_mut(..length).ok_or(())?;
        let opened = cipher(key).ok_or(())?.open_in_place(number(nonce), Aad::from(bound), sealed);
        opened.map(|body| body.len()).map_err(|_| ())
    }
}

fn seal(key: &Sensitive<[u8; 32]>, nonce: u64, bound: &[u8], buffer: &mut [u8], length: usize) -> Option<()> {
    let (body, rest) = buffer.split_at_mut_checked(length)?;
    let to = rest.get_mut(..TAG_BYTES)?;
    let tag = cipher(key)?.seal_in_place_separate_tag(number(nonce), Aad::from(bound), body).ok()?;
    to.copy_from_slice(tag.as_ref());
    Some(())
}

fn cipher(key: &Sensitive<[u8; 32]>) -> Option<LessSafeKey> {
    UnboundKey::new(&CHACHA20_POLY1305, key.as_slice()).ok().map(LessSafeKey::new)
}

/// The cipher's nonce in Noise: 32 zero bits, then the number, little-endian.
fn number(nonce: u64) -> Nonce {
    let mut bytes = [0; NONCE_LEN];
    let number = nonce.to_le_bytes();
    bytes.iter_mut().rev().zip(number.iter().rev()).for_each(|(to, from)| *to = *from);
    Nonce::assume_unique_for_key(bytes)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use noise_rust_crypto::ChaCha20Poly1305 as Portable;
    use proptest::prelude::*;
    use std::vec;

    proptest! {
        /// What either has sealed the other one opens, and neither opens what was changed.
        #[test]
        fn it_is_the_portable_one(
            key: [u8; 32],
            nonce: u64,
            bound in proptest::collection::vec(any::<u8>(), 0..64),
            plain in proptest::collection::vec(any::<u8>(), 0..5_000),
            at: proptest::sample::Index,
        ) {
            let key = Sensitive::from_slice(&key);
            let mut own = plain.clone();
            own.resize(plain.len() + TAG_BYTES, 0);
            let mut portable = own.clone();
            ChaCha20Poly1305::encrypt_in_place(&key, nonce, &bound, &mut own, plain.len());
            Portable::encrypt_in_place(&key, nonce, &bound, &mut portable, plain.len());
            prop_assert_eq!(&own, &portable);
            let length = own.len();
            let mut changed = own.clone();
            *changed.get_mut(at.index(length)).unwrap() ^= 1;
            prop_assert!(ChaCha20Poly1305::decrypt_in_place(&key, nonce, &bound, &mut changed, length).is_err());
            prop_assert_eq!(ChaCha20Poly1305::decrypt_in_place(&key, nonce, &bound, &mut own, length), Ok(plain.len()));
            prop_assert_eq!(own.get(..plain.len()), Some(&plain[..]));
        }

        /// The forms with two buffers, which handshakes use.
        #[test]
        fn short_texts_come_back(key: [u8; 32], nonce: u64, plain in proptest::collection::vec(any::<u8>(), 0..=64)) {
            let key = Sensitive::from_slice(&key);
            let mut sealed = vec![0; plain.len() + TAG_BYTES];
            ChaCha20Poly1305::encrypt(&key, nonce, b"bound", &plain, &mut sealed);
            let mut opened = vec![0; plain.len()];
            prop_assert_eq!(ChaCha20Poly1305::decrypt(&key, nonce, b"bound", &sealed, &mut opened), Ok(()));
            prop_assert_eq!(opened, plain);
        }

        #[test]
        fn keys_turn_as_the_portable_one_s_do(key: [u8; 32]) {
            let key = Sensitive::from_slice(&key);
            let (own, portable) = (ChaCha20Poly1305::rekey(&key), Portable::rekey(&key));
            prop_assert_eq!(own.as_slice(), portable.as_slice());
        }
    }

    #[test]
    fn without_room_for_the_tag_nothing_is_left_in_clear() {
        let mut buffer = *b"in clear";
        ChaCha20Poly1305::encrypt_in_place(&Sensitive::new(), 0, &[], &mut buffer, 8);
        assert_eq!(buffer, [0; 8]);
    }
}
