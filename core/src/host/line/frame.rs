//! Frames of a serial line: a header, a payload and a CRC-32, stuffed by COBS between zero bytes.
//!
//! | bytes | meaning |
//! |---|---|
//! | 0 | kind in bits 0–3, how many frames the sender can take in bits 4–7 |
//! | 1–2 | number of the link, or of the datagram, little-endian |
//! | 3 | sequence number |
//! | 4 | the sequence number that is expected next; in a datagram 1 in its last frame, else 0 |
//! | 5– | payload |
//! | last 4 | CRC-32 (ISO-HDLC) over all before it, little-endian |

use crate::bytes::copy;
use crate::config::LINE_FRAME_BYTES;

const HEADER_BYTES: usize = 5;
const CHECK_BYTES: usize = 4;
/// Two delimiters and the byte that COBS adds.
const STUFFING_BYTES: usize = 3;
/// Longest payload of a frame.
pub(super) const PAYLOAD_BYTES: usize = LINE_FRAME_BYTES - HEADER_BYTES - CHECK_BYTES - STUFFING_BYTES;
const DELIMITER: u8 = 0;

// One byte of COBS reaches over the whole frame.
const _: () = assert!(LINE_FRAME_BYTES <= 255);

/// What a frame is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Dials: its number becomes that of the link, its payload is the port.
    Open = 1,
    /// The link that was dialled is taken.
    Accept = 2,
    /// There is no such link, or no longer.
    Close = 3,
    /// A piece of the stream.
    Data = 4,
    /// Only acknowledges.
    Acknowledge = 5,
    /// Acknowledges, and asks for what follows once more: a frame was missing or damaged.
    Repeat = 6,
    /// A piece of a datagram.
    Datagram = 7,
}

impl Kind {
    const ALL: [Self; 7] =
        [Self::Open, Self::Accept, Self::Close, Self::Data, Self::Acknowledge, Self::Repeat, Self::Datagram];
}

/// A frame, its payload borrowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Frame<'b> {
    pub(super) kind: Kind,
    /// Frames of the stream that the sender can take, 15 at most.
    pub(super) credit: u8,
    pub(super) number: u16,
    pub(super) sequence: u8,
    pub(super) acknowledged: u8,
    pub(super) payload: &'b [u8],
}

impl<'b> Frame<'b> {
    /// A frame that has nothing but a number.
    pub(super) const fn bare(kind: Kind, number: u16) -> Self {
        Self { kind, credit: 0, number, sequence: 0, acknowledged: 0, payload: &[] }
    }

    /// Writes the frame as it is on the wire. Of a payload longer than [`PAYLOAD_BYTES`] nothing is written.
    pub(super) fn encode<'o>(&self, out: &'o mut [u8; LINE_FRAME_BYTES]) -> &'o [u8] {
        let check = HEADER_BYTES.saturating_add(self.payload.len());
        let length = check.saturating_add(CHECK_BYTES);
        let [n0, n1] = self.number.to_le_bytes();
        let header = [self.kind as u8 | self.credit.min(15) << 4, n0, n1, self.sequence, self.acknowledged];
        let space = out.get_mut(2..LINE_FRAME_BYTES - 1).and_then(|space| space.get_mut(..length));
        let Some(content) = space else { return &[] };
        copy(&header, content.get_mut(..HEADER_BYTES).unwrap_or_default());
        copy(self.payload, content.get_mut(HEADER_BYTES..check).unwrap_or_default());
        let code = checksum(content.get(..check).unwrap_or_default());
        copy(&code.to_le_bytes(), content.get_mut(check..).unwrap_or_default());
        // The leading delimiter ends noise from before the frame.
        let stuffed = out.get_mut(1..length.saturating_add(STUFFING_BYTES)).unwrap_or_default();
        stuff(stuffed);
        let end = stuffed.len().saturating_add(1);
        copy(&[DELIMITER], out.get_mut(..1).unwrap_or_default());
        out.get(..end).unwrap_or_default()
    }

    /// Reads what was between two delimiters; `None` if it is damaged.
    fn decode(bytes: &'b mut [u8]) -> Option<Self> {
        let (content, check) = unstuff(bytes)?.split_last_chunk::<CHECK_BYTES>()?;
        let (&[first, n0, n1, sequence, acknowledged], payload) = content.split_first_chunk::<HEADER_BYTES>()?;
        if checksum(content) != u32::from_le_bytes(*check) {
            return None;
        }
        let kind = Kind::ALL.into_iter().find(|kind| *kind as u8 == first & 15)?;
        let number = u16::from_le_bytes([n0, n1]);
        Some(Self { kind, credit: first >> 4, number, sequence, acknowledged, payload })
    }
}

/// Collects the bytes of a frame.
pub(super) struct Reader {
    bytes: [u8; LINE_FRAME_BYTES],
    /// Goes on counting in a frame that is too long.
    length: usize,
}

impl Reader {
    pub(super) const fn new() -> Self {
        Self { bytes: [0; LINE_FRAME_BYTES], length: 0 }
    }

    /// Takes the next byte. A delimiter ends a frame, which is `Some(None)` if it is damaged.
    pub(super) fn push(&mut self, byte: u8) -> Option<Option<Frame<'_>>> {
        if byte != DELIMITER {
            if let Some(free) = self.bytes.get_mut(self.length) {
                *free = byte;
            }
            self.length = self.length.saturating_add(1);
            return None;
        }
        match core::mem::take(&mut self.length) {
            0 => None,
            length => Some(self.bytes.get_mut(..length).and_then(Frame::decode)),
        }
    }
}

/// Writes the first and the last byte, and takes the zeros in between away: each byte that was zero, and the first one, says
/// how far the next such place is (consistent overhead byte stuffing).
fn stuff(bytes: &mut [u8]) {
    let mut distance = 0_u8;
    for (at, byte) in bytes.iter_mut().enumerate().rev() {
        // The distance of the last byte is 0, which makes it the delimiter.
        let is_end = distance == 0;
        if is_end || at == 0 || *byte == DELIMITER {
            *byte = distance;
            distance = 0;
        }
        distance = distance.saturating_add(1);
    }
}

/// The content without its stuffing; `None` if a distance points past the end.
fn unstuff(bytes: &mut [u8]) -> Option<&[u8]> {
    let mut at = 0;
    while at < bytes.len() {
        let byte = bytes.get_mut(at)?;
        at = at.checked_add(usize::from(core::mem::take(byte)))?;
    }
    if at == bytes.len() { bytes.get(1..) } else { None }
}

/// CRC-32 as of Ethernet, four bits a step: 64 bytes of table where the usual one has 1,024.
fn checksum(bytes: &[u8]) -> u32 {
    const TABLE: [u32; 16] = [
        0x0000_0000,
        0x1DB7_1064,
        0x3B6E_20C8,
        0x26D9_30AC,
        0x76DC_4190,
        0x6B6B_51F4,
        0x4DB2_6158,
        0x5005_713C,
        0xEDB8_8320,
        0xF00F_9344,
        0xD6D6_A3E8,
        0xCB61_B38C,
        0x9B64_C2B0,
        0x86D3_D2D4,
        0xA00A_E278,
        0xBDBD_F21C,
    ];
    let step = |crc: u32| crc >> 4 ^ TABLE.get(crc as usize & 15).copied().unwrap_or_default();
    !bytes.iter().fold(!0, |crc, byte| step(step(crc ^ u32::from(*byte))))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_checksum_is_that_of_the_standard() {
        assert_eq!(checksum(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn noise_before_a_frame_does_not_damage_it() {
        let mut out = [0; LINE_FRAME_BYTES];
        let frame = Frame::bare(Kind::Close, 7);
        let mut reader = Reader::new();
        assert_eq!(reader.push(0xA5), None);
        let found: std::vec::Vec<_> = frame
            .encode(&mut out)
            .iter()
            .filter_map(|byte| reader.push(*byte).map(|read| read == Some(frame)))
            .collect();
        assert_eq!(found, [false, true]);
    }

    #[test]
    fn a_payload_that_is_too_long_is_not_written() {
        let payload = [1; PAYLOAD_BYTES + 1];
        let frame = Frame { payload: &payload, ..Frame::bare(Kind::Data, 0) };
        assert_eq!(frame.encode(&mut [0; LINE_FRAME_BYTES]), []);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_and_has_no_zero_inside(
            payload in prop::collection::vec(prop_oneof![Just(0_u8), any::<u8>()], 0..=PAYLOAD_BYTES),
            credit in 0..16_u8, number: u16, sequence: u8, acknowledged: u8,
        ) {
            let frame = Frame { kind: Kind::Data, credit, number, sequence, acknowledged, payload: &payload };
            let mut out = [0; LINE_FRAME_BYTES];
            let wire = frame.encode(&mut out);
            prop_assert_eq!(wire.len(), payload.len() + LINE_FRAME_BYTES - PAYLOAD_BYTES);
            prop_assert_eq!(wire.iter().filter(|byte| **byte == 0).count(), 2);
            let mut reader = Reader::new();
            let (last, rest) = wire.split_last().unwrap();
            prop_assert!(rest.iter().all(|byte| reader.push(*byte).is_none()));
            prop_assert_eq!(reader.push(*last), Some(Some(frame)));
        }

        #[test]
        fn damaged_bits_are_noticed(payload in prop::collection::vec(any::<u8>(), 0..=PAYLOAD_BYTES), bits in prop::collection::btree_set(0..1024_usize, 1..4)) {
            let frame = Frame { payload: &payload, ..Frame::bare(Kind::Data, 300) };
            let mut out = [0; LINE_FRAME_BYTES];
            let mut wire = frame.encode(&mut out).to_vec();
            let bits: std::vec::Vec<_> = bits.into_iter().filter(|bit| bit / 8 < wire.len() - 1 && bit / 8 > 0).collect();
            prop_assume!(!bits.is_empty());
            bits.iter().for_each(|bit| wire[bit / 8] ^= 1 << (bit % 8));
            let mut reader = Reader::new();
            prop_assert!(!wire.iter().any(|byte| matches!(reader.push(*byte), Some(Some(_)))));
        }
    }
}
