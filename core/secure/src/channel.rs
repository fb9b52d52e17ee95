//! The frames of one link, sealed in place, each with the next number of its direction: none can be lost, repeated or reordered.

use crate::suite::{FrameKey, Key, Suite};
use cara_core::error::CloseReason;
use cara_core::host::secure::Seal;

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

struct Direction {
    key: FrameKey,
    /// Of the next frame.
    number: u64,
    /// A frame could not be opened, which ends the channel: nothing after it can be trusted.
    broken: bool,
}

impl Channel {
    pub(crate) fn new(suite: Suite, sending: Key, receiving: Key) -> Self {
        Self { sending: Direction::new(suite, sending), receiving: Direction::new(suite, receiving) }
    }

    /// The suite of its frames.
    pub(crate) const fn suite(&self) -> Suite {
        self.sending.key.suite()
    }

    /// Exchanges the sending keys with another channel.
    pub(crate) const fn swap_sending(&mut self, other: &mut Self) {
        core::mem::swap(&mut self.sending, &mut other.sending);
    }

    /// Exchanges the receiving keys with another channel.
    pub(crate) const fn swap_receiving(&mut self, other: &mut Self) {
        core::mem::swap(&mut self.receiving, &mut other.receiving);
    }

    pub(crate) const fn is_worn(&self) -> bool {
        self.sending.number >= FRAMES_PER_HANDSHAKE || self.receiving.number >= FRAMES_PER_HANDSHAKE
    }

    #[cfg(test)]
    pub(crate) const fn jump(&mut self, number: u64) {
        self.receiving.number = number;
    }

    /// The key and number of the next frame to be sealed.
    pub(crate) fn next_seal(&self) -> ([u8; 32], u64) {
        let Direction { key, number, .. } = &self.sending;
        (if self.sending.turns() { **key.next().key() } else { **key.key() }, *number)
    }
}

impl Direction {
    fn new(suite: Suite, key: Key) -> Self {
        Self { key: FrameKey::new(suite, key), number: 0, broken: false }
    }

    const fn turns(&self) -> bool {
        self.number != 0 && self.number.is_multiple_of(FRAMES_PER_KEY)
    }

    /// The number of the next frame, under the key that seals it: rekeys before every 2^20th (Noise, section 11.3).
    fn turn(&mut self) -> Result<u64, CloseReason> {
        let number = self.number;
        let next = number.checked_add(1).ok_or(CloseReason::Protocol)?;
        if self.turns() {
            self.key = self.key.next();
        }
        self.number = next;
        Ok(number)
    }
}

impl Seal for Channel {
    fn overhead(&self) -> usize {
        TAG_BYTES
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        let length = frame.len().checked_sub(TAG_BYTES).ok_or(CloseReason::Protocol)?;
        let number = self.sending.turn()?;
        self.sending.key.seal(number, frame, length);
        Ok(())
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        let receiving = &mut self.receiving;
        if receiving.broken || frame.len() < TAG_BYTES {
            return Err(CloseReason::Protocol);
        }
        let number = receiving.turn()?;
        let opened = receiving.key.open(number, frame).map_err(|()| CloseReason::Protocol);
        receiving.broken = opened.is_err();
        frame.get_mut(..opened?).ok_or(CloseReason::Protocol)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::indexing_slicing, clippy::unwrap_used)]
    use super::*;
    use crate::suite::tests::suites;
    use noise_protocol::U8Array as _;

    const KEY: [u8; 32] = [9; 32];

    fn at(suite: Suite, number: u64) -> Direction {
        Direction { number, ..Direction::new(suite, Key::from_slice(&KEY)) }
    }

    fn frame() -> [u8; 4 + TAG_BYTES] {
        let mut frame = [0; 4 + TAG_BYTES];
        frame[..4].copy_from_slice(b"stop");
        frame
    }

    /// Before frame 2^20 and each multiple of it, as docs/wire.md says: both ends, or what comes next does not open.
    #[test]
    fn a_key_seals_no_more_frames_than_it_may() {
        for (suite, times) in suites().into_iter().flat_map(|suite| [1, 2, 4095].map(|times| (suite, times))) {
            let last = times * FRAMES_PER_KEY - 1;
            let mut one = Channel { sending: at(suite, last), receiving: at(suite, 0) };
            let mut other = Channel { sending: at(suite, 0), receiving: at(suite, last) };
            let rekeyed = *suite.next(&Key::from_slice(&KEY));
            for expected in [(KEY, last), (rekeyed, last + 1), (rekeyed, last + 2)] {
                assert_eq!(one.next_seal(), expected);
                let mut sealed = frame();
                one.seal(&mut sealed).unwrap();
                let opens = suite.open(&Key::from_slice(&KEY), expected.1, &[], &mut sealed.clone()).is_ok();
                assert_eq!(opens, expected.0 == KEY, "frame {}", expected.1);
                assert_eq!(other.open(&mut sealed).unwrap(), b"stop");
            }
        }
    }

    #[test]
    fn the_last_number_is_not_used() {
        for suite in suites() {
            let mut channel = Channel { sending: at(suite, u64::MAX), receiving: at(suite, u64::MAX) };
            assert_eq!(channel.seal(&mut frame()), Err(CloseReason::Protocol));
            assert!(channel.open(&mut frame()).is_err());
        }
    }
}
