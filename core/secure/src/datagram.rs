//! Datagrams beside a link. They may be lost, duplicated or reordered, so each has a number, and a window detects replays.
//!
//! Their keys are not the stream's: each end draws its own and sends it in the first sealed frames of the link. When an end sends
//! a new key, datagrams under the previous one are accepted until the owner ends that.

use noise_protocol::U8Array;
use zeroize::{Zeroize, ZeroizeOnDrop};

use crate::channel::TAG_BYTES;
use crate::keys::KEY_BYTES;
use crate::suite::{Key, Suite};

/// Bytes before a sealed body: the key's generation, and the datagram's number, little-endian.
pub const HEADER_BYTES: usize = 1 + 8;
/// Bytes that sealing adds in total.
pub const OVERHEAD: usize = HEADER_BYTES + TAG_BYTES;
/// Number of datagrams in one direction after which a new key is due, whatever its age.
pub const DATAGRAMS_PER_KEY: u64 = 1 << 32;
/// How many numbers behind the newest the replay window remembers.
pub const WINDOW: u64 = 64;

/// A key for datagrams of one direction.
#[derive(Clone, Zeroize, ZeroizeOnDrop)]
pub struct DatagramKey {
    bytes: [u8; KEY_BYTES],
    #[zeroize(skip)]
    suite: Suite,
}

impl DatagramKey {
    /// A key of 32 random bytes, drawn for it and the link's suite.
    pub const fn new(suite: Suite, bytes: [u8; KEY_BYTES]) -> Self {
        Self { bytes, suite }
    }

    /// Its bytes, to be sent in a sealed frame.
    pub const fn expose(&self) -> &[u8; KEY_BYTES] {
        &self.bytes
    }

    fn cipher_key(&self) -> Key {
        Key::from_slice(&self.bytes)
    }
}

/// Why a datagram is dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DatagramError {
    /// Shorter than any sealed one.
    #[error("the datagram is too short")]
    Short,
    /// Sealed with a key that is unknown, or no longer accepted.
    #[error("the datagram is sealed with a key that is not in use")]
    Key,
    /// A duplicate, or too far behind the newest to tell.
    #[error("the datagram came before")]
    Repeated,
    /// Not sealed by the peer, or changed in transit.
    #[error("the datagram is not from the other end of the link")]
    Forged,
}

/// Seals the datagrams of one direction.
pub struct Sealer {
    key: DatagramKey,
    generation: u8,
    next: u64,
}

impl Sealer {
    /// Seals with a key that was not used before.
    pub const fn new(key: DatagramKey, generation: u8) -> Self {
        Self { key, generation, next: 0 }
    }

    /// The key, to be sent to the peer.
    pub const fn key(&self) -> &DatagramKey {
        &self.key
    }

    /// The key's generation.
    pub const fn generation(&self) -> u8 {
        self.generation
    }

    pub(crate) const fn is_worn(&self) -> bool {
        self.next >= DATAGRAMS_PER_KEY
    }

    #[cfg(test)]
    pub(crate) const fn at(next: u64) -> Self {
        Self { key: DatagramKey::new(Suite::ChaChaPoly, [0; KEY_BYTES]), generation: 0, next }
    }

    /// The number of the next datagram.
    pub(crate) const fn next_number(&self) -> u64 {
        self.next
    }

    /// Seals `datagram` in place: [`HEADER_BYTES`] free bytes, the body, [`TAG_BYTES`] free bytes. `bound` is the plain header of
    /// the datagram, which is authenticated but not encrypted. `None` without these free bytes.
    pub fn seal(&mut self, bound: &[u8], datagram: &mut [u8]) -> Option<()> {
        let length = datagram.len().checked_sub(OVERHEAD)?;
        let number = self.next;
        self.next = number.checked_add(1)?;
        let (header, body) = datagram.split_first_chunk_mut::<HEADER_BYTES>()?;
        *header = header_of(self.generation, number);
        self.key.suite.seal(&self.key.cipher_key(), number, &Bound::of(bound, header)?.0, body, length);
        Some(())
    }
}

/// Longest plain header.
const BOUND_BYTES: usize = 48;

/// The associated data: what is authenticated beside the body, in one piece.
struct Bound([u8; BOUND_BYTES + HEADER_BYTES + 1]);

impl Bound {
    fn of(plain: &[u8], header: &[u8; HEADER_BYTES]) -> Option<Self> {
        let mut whole = [0; BOUND_BYTES + HEADER_BYTES + 1];
        let (length, rest) = whole.split_first_mut()?;
        *length = u8::try_from(plain.len()).ok()?;
        let (to_header, to_plain) = rest.split_first_chunk_mut::<HEADER_BYTES>()?;
        *to_header = *header;
        to_plain.get_mut(..plain.len())?.copy_from_slice(plain);
        Some(Self(whole))
    }
}

const fn header_of(generation: u8, number: u64) -> [u8; HEADER_BYTES] {
    let [a, b, c, d, e, f, g, h] = number.to_le_bytes();
    [generation, a, b, c, d, e, f, g, h]
}

/// Opens the datagrams of one direction.
pub struct Opener {
    current: Keyed,
    previous: Option<Keyed>,
}

struct Keyed {
    key: DatagramKey,
    generation: u8,
    window: Window,
}

impl Opener {
    /// Opens with the key that the peer has sent.
    pub const fn new(key: DatagramKey, generation: u8) -> Self {
        Self { current: Keyed { key, generation, window: Window::NEW }, previous: None }
    }

    /// The peer has sent a new key. Datagrams under the old one are accepted until [`Self::forget_previous`].
    pub fn replace(&mut self, key: DatagramKey, generation: u8) {
        let new = Keyed { key, generation, window: Window::NEW };
        self.previous = Some(core::mem::replace(&mut self.current, new));
    }

    /// The generation of the newest key.
    pub const fn generation(&self) -> u8 {
        self.current.generation
    }

    /// Whether a datagram under the newest key has been opened.
    pub const fn hears_newest(&self) -> bool {
        self.current.window.end > 0
    }

    pub(crate) const fn is_worn(&self) -> bool {
        self.current.window.end >= DATAGRAMS_PER_KEY
    }

    /// No longer accepts datagrams under the previous key.
    pub fn forget_previous(&mut self) {
        self.previous = None;
    }

    /// Opens a datagram in place; returns its body. A forged datagram has no effect: it must not move the replay window.
    pub fn open<'d>(&mut self, bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], DatagramError> {
        let (header, body) = datagram.split_first_chunk_mut::<HEADER_BYTES>().ok_or(DatagramError::Short)?;
        if body.len() < TAG_BYTES {
            return Err(DatagramError::Short);
        }
        let [generation, number @ ..] = *header;
        let number = u64::from_le_bytes(number);
        let keyed = match &mut self.previous {
            _ if self.current.generation == generation => &mut self.current,
            Some(previous) if previous.generation == generation => previous,
            _ => return Err(DatagramError::Key),
        };
        if !keyed.window.is_new(number) {
            return Err(DatagramError::Repeated);
        }
        let bound = Bound::of(bound, header).ok_or(DatagramError::Forged)?;
        let opened = keyed.key.suite.open(&keyed.key.cipher_key(), number, &bound.0, body);
        let opened = opened.map_err(|()| DatagramError::Forged)?;
        keyed.window.take(number);
        body.get_mut(..opened).ok_or(DatagramError::Short)
    }
}

/// The numbers seen: the newest, and one bit for each before it.
struct Window {
    /// One above the newest.
    end: u64,
    /// Bit n: `end - 1 - n` was seen.
    seen: u64,
}

impl Window {
    const NEW: Self = Self { end: 0, seen: 0 };

    /// Whether a number is new. The last number is never valid, since `end` could not be above it.
    fn is_new(&self, number: u64) -> bool {
        if number == u64::MAX {
            return false;
        }
        match self.end.checked_sub(number) {
            None | Some(0) => true,
            Some(behind) => behind <= WINDOW && self.seen & bit(behind) == 0,
        }
    }

    fn take(&mut self, number: u64) {
        if number >= self.end {
            let end = number.saturating_add(1);
            let moved = end.saturating_sub(self.end);
            self.seen = u32::try_from(moved).ok().and_then(|moved| self.seen.checked_shl(moved)).unwrap_or(0);
            self.end = end;
        }
        self.seen |= bit(self.end.saturating_sub(number));
    }
}

/// The bit of the number that is `behind` numbers below the end, 1 to [`WINDOW`].
fn bit(behind: u64) -> u64 {
    u32::try_from(behind.saturating_sub(1)).ok().and_then(|at| 1_u64.checked_shl(at)).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::indexing_slicing, clippy::unwrap_used)]
    use super::*;
    use crate::suite::tests::suites;
    use proptest::prelude::*;
    use std::collections::HashSet;
    use std::vec::Vec;

    const PLAIN: &[u8] = b"plain header";

    fn key(byte: u8) -> DatagramKey {
        DatagramKey::new(Suite::ChaChaPoly, [byte; KEY_BYTES])
    }

    fn sealed(sealer: &mut Sealer, body: &[u8]) -> Vec<u8> {
        let mut datagram = std::vec![0; body.len() + OVERHEAD];
        datagram[HEADER_BYTES..HEADER_BYTES + body.len()].copy_from_slice(body);
        sealer.seal(PLAIN, &mut datagram).unwrap();
        datagram
    }

    #[test]
    fn what_is_sealed_opens_once() {
        let (mut sealer, mut opener) = (Sealer::new(key(1), 0), Opener::new(key(1), 0));
        let datagram = sealed(&mut sealer, b"stop");
        assert!(!datagram.windows(4).any(|window| window == b"stop"));
        assert_eq!(opener.open(PLAIN, &mut datagram.clone()).unwrap(), b"stop");
        assert_eq!(opener.open(PLAIN, &mut datagram.clone()), Err(DatagramError::Repeated));
    }

    #[test]
    fn every_flipped_bit_is_noticed_and_shuts_nothing() {
        suites().into_iter().for_each(flip_every_bit);
    }

    fn flip_every_bit(suite: Suite) {
        let key = DatagramKey::new(suite, [1; KEY_BYTES]);
        let (mut sealer, mut opener) = (Sealer::new(key.clone(), 3), Opener::new(key, 3));
        let datagram = sealed(&mut sealer, b"stop");
        for bit in 0..datagram.len() * 8 {
            let mut changed = datagram.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            assert!(opener.open(PLAIN, &mut changed).is_err(), "bit {bit}");
        }
        assert_eq!(opener.open(b"other header", &mut datagram.clone()), Err(DatagramError::Forged));
        assert!((0..datagram.len()).all(|length| opener.open(PLAIN, &mut datagram.clone()[..length]).is_err()));
        assert_eq!(opener.open(PLAIN, &mut datagram.clone()).unwrap(), b"stop");
    }

    #[test]
    fn the_key_before_is_taken_until_it_is_forgotten() {
        let (mut old, mut new) = (Sealer::new(key(1), 0), Sealer::new(key(2), 1));
        let mut opener = Opener::new(key(1), 0);
        let late = [sealed(&mut old, b"one"), sealed(&mut old, b"two")];
        opener.replace(key(2), 1);
        assert_eq!(opener.open(PLAIN, &mut sealed(&mut new, b"new")).unwrap(), b"new");
        assert_eq!(opener.open(PLAIN, &mut late[0].clone()).unwrap(), b"one");
        assert_eq!(opener.open(PLAIN, &mut late[0].clone()), Err(DatagramError::Repeated));
        opener.forget_previous();
        assert_eq!(opener.open(PLAIN, &mut late[1].clone()), Err(DatagramError::Key));
    }

    #[test]
    fn the_last_number_is_not_used_twice() {
        let mut sealer = Sealer { key: key(1), generation: 0, next: u64::MAX };
        assert_eq!(sealer.seal(PLAIN, &mut [0; OVERHEAD]), None);
    }

    #[test]
    fn the_last_number_is_not_taken_and_the_one_before_it_once() {
        let mut opener = Opener::new(key(1), 0);
        let mut sealer = Sealer { key: key(1), generation: 0, next: u64::MAX - 1 };
        let last = sealed(&mut sealer, b"stop");
        assert_eq!(opener.open(PLAIN, &mut last.clone()).unwrap(), b"stop");
        assert_eq!(opener.open(PLAIN, &mut last.clone()), Err(DatagramError::Repeated));
        // Sealed by a peer that counts on, with the right key.
        let mut beyond = std::vec![0; OVERHEAD];
        let header = header_of(0, u64::MAX);
        beyond[..HEADER_BYTES].copy_from_slice(&header);
        let bound = Bound::of(PLAIN, &header).unwrap();
        Suite::ChaChaPoly.seal(&key(1).cipher_key(), u64::MAX, &bound.0, &mut beyond[HEADER_BYTES..], 0);
        for _ in 0..3 {
            assert_eq!(opener.open(PLAIN, &mut beyond.clone()), Err(DatagramError::Repeated));
        }
    }

    proptest! {
        /// Against a set that remembers everything.
        #[test]
        fn the_window_takes_each_number_once(numbers in prop::collection::vec(0_u64..200, 0..200)) {
            let mut window = Window::NEW;
            let mut taken = HashSet::new();
            let mut newest = 0;
            for number in numbers {
                newest = newest.max(number);
                let too_old = newest - number >= WINDOW;
                prop_assert_eq!(window.is_new(number), !taken.contains(&number) && !too_old);
                if window.is_new(number) {
                    window.take(number);
                    taken.insert(number);
                }
            }
        }

        #[test]
        fn nothing_panics(mut bytes in prop::collection::vec(any::<u8>(), 0..80), plain in prop::collection::vec(any::<u8>(), 0..80)) {
            let mut opener = Opener::new(key(1), 0);
            prop_assert!(opener.open(&plain, &mut bytes).is_err());
        }
    }
}
