//! The frames of one link, sealed in place: each with the next number of its direction, so that none can be left out,
//! repeated or moved.

use cara_core::error::CloseReason;
use cara_core::host::secure::Seal;
use noise_protocol::CipherState;

use crate::suite::ChaCha20Poly1305;

/// Bytes that sealing adds.
pub const TAG_BYTES: usize = 16;
/// Frames that are sealed with one key; then both ends derive the next one from it.
pub const FRAMES_PER_KEY: u64 = 1 << 20;
/// Frames of one direction after which a new handshake is due, however young the keys are.
pub const FRAMES_PER_HANDSHAKE: u64 = 1 << 32;

/// The two directions of a link after its handshake.
pub struct Channel {
    sending: Direction,
    receiving: Direction,
}

#[derive(Clone)]
struct Direction {
    cipher: CipherState<ChaCha20Poly1305>,
    /// A frame that did not open ends the channel: what comes after it cannot be told from noise.
    broken: bool,
}

impl Channel {
    pub(crate) fn new(sending: CipherState<ChaCha20Poly1305>, receiving: CipherState<ChaCha20Poly1305>) -> Self {
        let direction = |cipher| Direction { cipher, broken: false };
        Self { sending: direction(sending), receiving: direction(receiving) }
    }

    /// What is sent from here on is sealed with the key of the other channel, and the old one is with that.
    pub(crate) const fn swap_sending(&mut self, other: &mut Self) {
        core::mem::swap(&mut self.sending, &mut other.sending);
    }

    /// The same for what comes.
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

    /// The key and the number of the next frame that is sealed.
    pub(crate) fn next_seal(&self) -> ([u8; 32], u64) {
        let mut sending = self.sending.clone();
        sending.turn();
        let (key, number) = sending.cipher.extract();
        (*key, number)
    }
}

impl Direction {
    /// The key of the next frame.
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
