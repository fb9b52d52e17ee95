//! Frames of a stream and the chunks in which messages travel.
//!
//! A frame is a `u16` length (little-endian, of what follows) and a body whose first byte is its kind. A message of any
//! length travels as chunk frames of one priority; only an emergency, which always fits one chunk, may stand between
//! two chunks of another message. The first chunk tells the message's length.

use crate::bytes::copy;
use crate::config::{MINIMUM_CHUNK_BYTES, Priority};
use crate::error::CloseReason;

/// Bytes before a frame's body.
pub const HEADER_BYTES: usize = 2;
/// Kind and priority at the start of each chunk's body.
const CHUNK_BYTES: usize = 2;
/// Kind, priority and the message's length at the start of a first chunk's body.
const FIRST_CHUNK_BYTES: usize = 6;

const HELLO: u8 = 1;
const REFUSE: u8 = 2;
const CLOSE: u8 = 3;
const PING: u8 = 4;
const PONG: u8 = 5;
const SESSION: u8 = 6;
const PROOF: u8 = 7;
const CONFIRM: u8 = 8;
const CHUNK: u8 = 0x10;
/// Kinds of frames that a live link passes over if it does not know them.
const SKIPPABLE: core::ops::RangeInclusive<u8> = 0x40..=0x7F;
const FIRST: u8 = 0x01;
const LAST: u8 = 0x02;

/// What a frame's body holds.
#[derive(Debug, PartialEq, Eq)]
pub enum Frame<'b> {
    /// The sender's hello, encoded.
    Hello(&'b [u8]),
    /// The link is refused, with a code of [`crate::error::Refusal`].
    Refuse(u8),
    /// The link ends, with a code of [`CloseReason`].
    Close(u8),
    /// To be answered with a pong at once.
    Ping,
    /// The answer to a ping.
    Pong,
    /// A session body (keep-alive, renewal), as it otherwise travels in a datagram.
    Session(&'b [u8]),
    /// A message of the proof that opens a secured link, or rekeys it.
    Proof(&'b [u8]),
    /// The first frame of an end under its keys: it has proven itself, and tells what is needed for its datagrams.
    Confirm(&'b [u8]),
    /// A piece of a message.
    Chunk(Chunk<'b>),
    /// Of a later version; a live link passes over it.
    Skipped,
}

/// A piece of a message.
#[derive(Debug, PartialEq, Eq)]
pub struct Chunk<'b> {
    /// The message's priority.
    pub priority: Priority,
    /// In a first chunk, the length of the whole message.
    pub total: Option<u32>,
    /// No chunk of this message follows.
    pub last: bool,
    /// The piece.
    pub bytes: &'b [u8],
}

impl<'b> Frame<'b> {
    /// A proof that says nothing more: the last frame of its direction under the keys so far.
    pub const TURN: Self = Self::Proof(&[]);
    /// A confirmation that tells nothing: the other end's has come.
    pub const ACKNOWLEDGEMENT: Self = Self::Confirm(&[]);

    /// Reads a frame's body. Any deviation from the format is a protocol error.
    #[inline]
    pub fn parse(body: &'b [u8]) -> Result<Self, CloseReason> {
        let (&kind, rest) = body.split_first().ok_or(CloseReason::Protocol)?;
        match kind {
            HELLO => Ok(Self::Hello(rest)),
            REFUSE => Ok(Self::Refuse(*rest.first().ok_or(CloseReason::Protocol)?)),
            CLOSE => Ok(Self::Close(*rest.first().ok_or(CloseReason::Protocol)?)),
            PING if rest.is_empty() => Ok(Self::Ping),
            PONG if rest.is_empty() => Ok(Self::Pong),
            SESSION => Ok(Self::Session(rest)),
            PROOF => Ok(Self::Proof(rest)),
            CONFIRM => Ok(Self::Confirm(rest)),
            kind if kind & !(FIRST | LAST) == CHUNK => Chunk::parse(kind, body.len(), rest).map(Self::Chunk),
            kind if SKIPPABLE.contains(&kind) => Ok(Self::Skipped),
            _ => Err(CloseReason::Protocol),
        }
    }
}

impl<'b> Chunk<'b> {
    #[inline]
    fn parse(kind: u8, body_length: usize, rest: &'b [u8]) -> Result<Self, CloseReason> {
        let (&priority, rest) = rest.split_first().ok_or(CloseReason::Protocol)?;
        let priority = Priority::from_wire(priority).ok_or(CloseReason::Protocol)?;
        let (total, bytes) = if kind & FIRST == 0 {
            (None, rest)
        } else {
            let (total, bytes) = rest.split_first_chunk().ok_or(CloseReason::Protocol)?;
            (Some(u32::from_le_bytes(*total)), bytes)
        };
        let last = kind & LAST != 0;
        if priority == Priority::Emergency && !(last && total.is_some()) {
            return Err(CloseReason::Protocol);
        }
        // A unit that is out of buffers must know from a frame's length alone whether it may need one.
        if !last && body_length < MINIMUM_CHUNK_BYTES {
            return Err(CloseReason::Protocol);
        }
        Ok(Self { priority, total, last, bytes })
    }
}

/// The frames that are not chunks, encoded into `out`; returns how many bytes were written, 0 where they do not fit.
pub fn encode(frame: &Frame<'_>, overhead: usize, out: &mut [u8]) -> usize {
    let Some((kind, payload)) = kind_and_payload(frame) else { return 0 };
    let body_length = payload.len().saturating_add(1).saturating_add(overhead);
    let Some(frame_length) = frame_length(body_length) else { return 0 };
    let Some(out) = out.get_mut(..frame_length) else { return 0 };
    let mut writer = Writer { out, position: 0 };
    writer.put(&length_bytes(body_length));
    writer.put(&[kind]);
    writer.put(payload);
    frame_length
}

/// Bytes on the wire of a frame that is no chunk.
pub(crate) fn encoded_length(frame: &Frame<'_>, overhead: usize) -> usize {
    let payload = kind_and_payload(frame).map_or(0, |(_, payload)| payload.len());
    payload.saturating_add(HEADER_BYTES).saturating_add(1).saturating_add(overhead)
}

/// `None` for a chunk, and for what this version does not send.
fn kind_and_payload<'b>(frame: &'b Frame<'_>) -> Option<(u8, &'b [u8])> {
    Some(match frame {
        Frame::Hello(bytes) => (HELLO, bytes),
        Frame::Refuse(code) => (REFUSE, core::slice::from_ref(code)),
        Frame::Close(code) => (CLOSE, core::slice::from_ref(code)),
        Frame::Ping => (PING, &[]),
        Frame::Pong => (PONG, &[]),
        Frame::Session(bytes) => (SESSION, bytes),
        Frame::Proof(bytes) => (PROOF, bytes),
        Frame::Confirm(bytes) => (CONFIRM, bytes),
        Frame::Chunk(_) | Frame::Skipped => return None,
    })
}

/// Whether the frame at the start of `bytes` (not sealed yet) is a [`Frame::TURN`].
pub(crate) fn is_turn(bytes: &[u8], overhead: usize) -> bool {
    bytes.get(HEADER_BYTES) == Some(&PROOF) && first_frame_length(bytes) == Some(encoded_length(&Frame::TURN, overhead))
}

fn frame_length(body_length: usize) -> Option<usize> {
    u16::try_from(body_length).ok()?;
    body_length.checked_add(HEADER_BYTES)
}

fn length_bytes(body_length: usize) -> [u8; 2] {
    (body_length as u16).to_le_bytes()
}

/// How a sender cuts messages: the peer's chunk limit (of a frame's body) and what sealing adds.
#[derive(Clone, Copy, Debug)]
pub struct Chunking {
    /// Longest body of a frame.
    pub chunk: usize,
    /// Bytes that sealing adds to a body.
    pub overhead: usize,
}

impl Chunking {
    #[inline]
    fn first_payload(self) -> usize {
        self.chunk.saturating_sub(FIRST_CHUNK_BYTES).saturating_sub(self.overhead)
    }

    fn next_payload(self) -> usize {
        self.chunk.saturating_sub(CHUNK_BYTES).saturating_sub(self.overhead).max(1)
    }

    /// Bytes on the wire of a message of `total` bytes.
    #[inline]
    pub fn framed_length(self, total: usize) -> usize {
        let first = HEADER_BYTES.saturating_add(FIRST_CHUNK_BYTES).saturating_add(self.overhead);
        if total <= self.first_payload() {
            return total.saturating_add(first);
        }
        let next = HEADER_BYTES.saturating_add(CHUNK_BYTES).saturating_add(self.overhead);
        let more = total.saturating_sub(self.first_payload()).div_ceil(self.next_payload());
        total.saturating_add(first).saturating_add(more.saturating_mul(next))
    }
}

/// Writes one message of known length as chunk frames, copying each byte once.
pub struct ChunkWriter<'b> {
    writer: Writer<'b>,
    chunking: Chunking,
    priority: Priority,
    /// Bytes of the message that no frame header covers yet.
    uncovered: usize,
    /// Bytes that the frame being written still takes.
    room: usize,
}

impl<'b> ChunkWriter<'b> {
    /// A writer of a message of `total` bytes into `out`, which must hold [`Chunking::framed_length`] of them.
    #[inline]
    pub fn new(out: &'b mut [u8], chunking: Chunking, priority: Priority, total: usize) -> Option<Self> {
        let out = out.get_mut(..chunking.framed_length(total))?;
        let mut writer = Self { writer: Writer { out, position: 0 }, chunking, priority, uncovered: total, room: 0 };
        let payload = total.min(chunking.first_payload());
        writer.open_frame(FIRST, FIRST_CHUNK_BYTES, payload);
        writer.writer.put(&(total as u32).to_le_bytes());
        Some(writer)
    }

    /// Appends bytes of the message. What goes beyond the announced length is ignored.
    #[inline]
    pub fn put(&mut self, bytes: &[u8]) {
        match self.room.checked_sub(bytes.len()) {
            Some(room) => {
                self.writer.put(bytes);
                self.room = room;
            }
            None => self.put_across(bytes),
        }
    }

    /// The same for bytes that need another frame.
    fn put_across(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            if self.room == 0 {
                if self.uncovered == 0 {
                    return;
                }
                self.writer.skip(self.chunking.overhead);
                self.open_frame(0, CHUNK_BYTES, self.uncovered.min(self.chunking.next_payload()));
            }
            let (now, later) = bytes.split_at_checked(self.room).unwrap_or((bytes, &[]));
            self.writer.put(now);
            self.room = self.room.saturating_sub(now.len());
            bytes = later;
        }
    }

    #[inline]
    fn open_frame(&mut self, first: u8, head: usize, payload: usize) {
        self.uncovered = self.uncovered.saturating_sub(payload);
        self.room = payload;
        let last = if self.uncovered == 0 { LAST } else { 0 };
        let body = head.saturating_add(payload).saturating_add(self.chunking.overhead);
        self.writer.put(&length_bytes(body));
        self.writer.put(&[CHUNK | first | last, self.priority.to_wire()]);
    }
}

struct Writer<'b> {
    out: &'b mut [u8],
    position: usize,
}

impl Writer<'_> {
    #[inline]
    fn put(&mut self, bytes: &[u8]) {
        let end = self.position.saturating_add(bytes.len());
        if let Some(span) = self.out.get_mut(self.position..end) {
            copy(bytes, span);
            self.position = end;
        }
    }

    fn skip(&mut self, count: usize) {
        self.position = self.position.saturating_add(count);
    }
}

/// The first frame in `bytes`: its whole length, header included. `None` while the header is incomplete.
#[inline]
pub fn first_frame_length(bytes: &[u8]) -> Option<usize> {
    let header = bytes.first_chunk::<HEADER_BYTES>()?;
    Some(usize::from(u16::from_le_bytes(*header)).saturating_add(HEADER_BYTES))
}

/// Whether the frame at the start of `bytes` (not sealed yet) ends a message, or is no chunk at all.
pub(crate) fn ends_message(bytes: &[u8]) -> bool {
    match bytes.get(HEADER_BYTES) {
        Some(kind) if kind & CHUNK != 0 => kind & LAST != 0,
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]
    use super::*;
    use proptest::prelude::*;
    use std::vec;
    use std::vec::Vec;

    fn reassemble(mut framed: &[u8], overhead: usize) -> Vec<u8> {
        let mut message = Vec::new();
        let mut total = None;
        while !framed.is_empty() {
            let length = first_frame_length(framed).unwrap();
            let body = &framed[HEADER_BYTES..length - overhead];
            let Frame::Chunk(chunk) = Frame::parse(body).unwrap() else { unreachable!() };
            total = total.or(chunk.total);
            message.extend_from_slice(chunk.bytes);
            framed = &framed[length..];
            assert_eq!(chunk.last, framed.is_empty());
        }
        assert_eq!(total.unwrap() as usize, message.len());
        message
    }

    proptest! {
        #[test]
        fn a_message_survives_any_cut(
            message in prop::collection::vec(any::<u8>(), 0..10_000),
            chunk in MINIMUM_CHUNK_BYTES + 16..4096usize,
            overhead in prop::sample::select(vec![0usize, 16]),
            piece in 1..3000usize,
        ) {
            let chunking = Chunking { chunk, overhead };
            let mut out = vec![0; chunking.framed_length(message.len())];
            let mut writer = ChunkWriter::new(&mut out, chunking, Priority::Normal, message.len()).unwrap();
            for piece in message.chunks(piece) {
                writer.put(piece);
            }
            prop_assert_eq!(reassemble(&out, overhead), message);
        }

        #[test]
        fn parsing_never_panics(body in prop::collection::vec(any::<u8>(), 0..64)) {
            let _ = Frame::parse(&body);
        }
    }

    #[test]
    fn a_writer_refuses_a_buffer_that_is_too_short() {
        let chunking = Chunking { chunk: 1024, overhead: 0 };
        let mut out = [0; 100];
        assert!(ChunkWriter::new(&mut out, chunking, Priority::Normal, 100).is_none());
    }

    #[test]
    fn a_turn_is_told_from_every_other_frame() {
        for overhead in [0, 16] {
            let mut out = [0; 128];
            for (frame, turns) in [
                (Frame::TURN, true),
                (Frame::Proof(&[0; 48]), false),
                (Frame::ACKNOWLEDGEMENT, false),
                (Frame::Confirm(&[7; 33]), false),
                (Frame::Session(&[7]), false),
                (Frame::Ping, false),
            ] {
                let length = encode(&frame, overhead, &mut out);
                assert_eq!(length, encoded_length(&frame, overhead));
                assert_eq!(is_turn(&out[..length], overhead), turns, "{frame:?}");
            }
        }
        assert!(!is_turn(&[], 0) && !is_turn(&[1, 0], 0));
    }
}
