//! The frames of one link, sealed in place, each with the next number of its direction: none can be lost, repeated or reordered.

use cara_core::error::CloseReason;
use cara_core::host::secure::Seal;
use noise_protocol::CipherState;

use crate::suite::ChaCha20Poly1305;

/// Bytes that sealing adds.
pub const TAG_BYTES: usize = 16;
/// Frames that one key seals; then both ends derive the next key from it.
pub const FRAMES_PER_KEY: u64 = 1 << 20;
/// Number of frames in one direction after which a new handshake is due, whatever the age of the keys.
pub const FRAMES_PER_HANDSHAKE: u64 = 1 << 32;

/// The two directions of a link after its handshake.
pub struct Channel {
    sending: Direction,
    receiving: Direction,
}

#[derive(Clone)]
struct Direction {
    cipher: CipherState<ChaCha20Poly1305>,
    /// A frame could not be opened, which ends the channel: nothing after it can be trusted.
    broken: bool,
}

impl Channel {
    pub(crate) fn new(sending: CipherState<ChaCha20Poly1305>, receiving: CipherState<ChaCha20Poly1305>) -> Self {
        let direction = |cipher| Direction { cipher, broken: false };
        Self { sending: direction(sending), receiving: direction(receiving) }
    }

    /// Exchanges the sending keys with another channel.
    pub(crate) const fn swap_sending(&mut self, other: &mut Self) {
        core::mem::swap(&mut self.sending, &mut other.sending);
    }

    /// Exchanges the receiving keys with another channel.
    pub(crate) const fn swap_receiving(&mut self, other: &mut Self) {
        core::mem::swap(&mut self.receiving, &mut other.receiving);
    }

    pub(crate) fn is_worn(&self) -> bool {
        let numbers = [&self.sending, &self.receiving].map(|direction| direction.cipher.get_next_n());
        numbers.into_iter().any(|number| number >= FRAMES_PER_HANDSHAKE)
    }

    #[cfg(test)]
    pub(crate) fn jump(&mut self, number: u64) {
        self.receiving.cipher = CipherState::new(&[0; 32], number);
    }

    /// The key and number of the next frame to be sealed.
    pub(crate) fn next_seal(&self) -> ([u8; 32], u64) {
        let mut sending = self.sending.clone();
        sending.turn();
        let (key, number) = sending.cipher.extract();
        (*key, number)
    }
}

impl Direction {
    /// Rekeys before every 2^20th frame (Noise, section 11.3).
    fn turn(&mut self) {
        let number = self.cipher.get_next_n();
        if number != 0 && number.is_multiple_of(FRAMES_PER_KEY) {
            self.cipher.rekey();
        }
    }
}

impl Seal for Channel {
    fn overhead(&self) -> usize {
        TAG_BYTES
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        let length = frame.len().checked_sub(TAG_BYTES).ok_or(CloseReason::Protocol)?;
        self.sending.turn();
        self.sending.cipher.encrypt_in_place(frame, length);
        Ok(())
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        let length = frame.len();
        if self.receiving.broken || length < TAG_BYTES {
            return Err(CloseReason::Protocol);
        }
        self.receiving.turn();
        let opened = self.receiving.cipher.decrypt_in_place(frame, length).map_err(|()| CloseReason::Protocol);
        self.receiving.broken = opened.is_err();
        frame.get_mut(..opened?).ok_or(CloseReason::Protocol)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::indexing_slicing, clippy::unwrap_used)]
    use super::*;
    use noise_protocol::Cipher as _;

    const KEY: [u8; 32] = [9; 32];

    fn at(number: u64) -> CipherState<ChaCha20Poly1305> {
        CipherState::new(&KEY, number)
    }

    fn frame() -> [u8; 4 + TAG_BYTES] {
        let mut frame = [0; 4 + TAG_BYTES];
        frame[..4].copy_from_slice(b"stop");
        frame
    }

    /// Before frame 2^20 and each multiple of it, as docs/wire.md says: both ends, or what comes next does not open.
    #[test]
    fn a_key_seals_no_more_frames_than_it_may() {
        for times in [1, 2, 4095] {
            let last = times * FRAMES_PER_KEY - 1;
            let (mut one, mut other) = (Channel::new(at(last), at(0)), Channel::new(at(0), at(last)));
            let rekeyed = {
                let mut key = [0; 32];
                key.copy_from_slice(ChaCha20Poly1305::rekey(&noise_protocol::U8Array::from_slice(&KEY)).as_slice());
                key
            };
            for expected in [(KEY, last), (rekeyed, last + 1), (rekeyed, last + 2)] {
                assert_eq!(one.next_seal(), expected);
                let mut sealed = frame();
                one.seal(&mut sealed).unwrap();
                let mut without = at(expected.1);
                let opens = without.decrypt_in_place(&mut sealed.clone(), sealed.len()).is_ok();
                assert_eq!(opens, expected.0 == KEY, "frame {}", expected.1);
                assert_eq!(other.open(&mut sealed).unwrap(), b"stop");
            }
        }
    }
}
