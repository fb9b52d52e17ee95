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

/// The two directions of a link after its handshake.
pub struct Channel {
    sending: Direction,
    receiving: Direction,
}

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
