//! Puts frames and messages together from whatever pieces the network delivers.
//!
//! A link borrows one buffer at most for all that it receives: for a frame that is longer than the link's own bytes,
//! for a message in several chunks, or for both: the frame then follows the assembled part of the message. So a link
//! that waits for a buffer holds none, and links cannot deadlock.

use super::{Inbound, Received, Span, Store};
use crate::bytes;
use crate::config::{MINIMUM_CHUNK_BYTES, Priority};
use crate::error::CloseReason;
use crate::host::frame::{self, Chunk, Frame};
use crate::host::secure::Seal;
use crate::storage::{Buffer, Buffers, Storage};

pub(super) struct Receiver<S: Storage> {
    small: S::Slice<u8>,
    buffer: Option<Buffer<S>>,
    partial: Partial,
    assembly: Option<Assembly>,
    chunk_limit: usize,
    message_limit: usize,
}

/// A frame that came in pieces. Its bytes are in `small`, or in the buffer behind the assembly when it is longer.
#[derive(Default)]
struct Partial {
    length: usize,
    in_buffer: bool,
    /// It was handed up and is done with.
    done: bool,
}

/// A message in several chunks, at the start of the buffer.
struct Assembly {
    length: usize,
    total: usize,
    priority: Priority,
    /// It was handed up and is done with.
    done: bool,
}

/// A chunk without its bytes.
struct Piece {
    priority: Priority,
    total: Option<u32>,
    last: bool,
}

/// A frame without its bytes, which are the tail of its body.
// A wide tag, so that the rest is moved in words, not bytes.
#[repr(u32)]
enum Content {
    Hello,
    Refuse(u8),
    Close(u8),
    Ping,
    Pong,
    Session,
    Proof,
    Confirm,
    Skipped,
    Piece(Piece),
}

impl<S: Storage> Receiver<S> {
    pub(super) fn new(small: S::Slice<u8>, chunk_limit: usize, message_limit: usize) -> Self {
        Self { small, buffer: None, partial: Partial::default(), assembly: None, chunk_limit, message_limit }
    }

    pub(super) const fn set_chunk_limit(&mut self, limit: usize) {
        self.chunk_limit = limit;
    }

    pub(super) fn raise_message_limit(&mut self, limit: usize) {
        self.message_limit = self.message_limit.max(limit);
    }

    /// Whether received data is retained: a frame in pieces, a message, or the buffer of one that was handed up.
    pub(super) fn holds_anything(&self) -> bool {
        self.partial.length > 0 || self.buffer.is_some()
    }

    pub(super) fn store<'b>(&'b self, store: Store, lent: &'b [u8]) -> &'b [u8] {
        match store {
            Store::Lent => lent,
            Store::Small => &self.small,
            Store::Buffer => self.buffer.as_ref().map_or(&[][..], |buffer| buffer),
        }
    }

    /// Ingests bytes and reports in `received` what they completed. The report is lent, because moving it through each
    /// layer would cost a board more than parsing the frame.
    pub(super) fn receive<C: Seal>(
        &mut self,
        cipher: &mut C,
        buffers: &mut dyn Buffers<S>,
        lent: &mut [u8],
        received: &mut Received,
    ) -> Result<(), CloseReason> {
        loop {
            let before = received.consumed;
            self.step(cipher, buffers, lent, received)?;
            // Takes the chunks of a message in a row: returning between them would cost a call through the layers above
            // for each, and a frame that had waited for a buffer consumes no bytes, which would look as if nothing were
            // left to do.
            let progress = received.consumed > before;
            let continues = if progress { received.consumed < lent.len() } else { self.partial.done };
            if !continues || received.paused || received.inbound.is_some() {
                return Ok(());
            }
        }
    }

    fn step<C: Seal>(
        &mut self,
        cipher: &mut C,
        buffers: &mut dyn Buffers<S>,
        lent: &mut [u8],
        received: &mut Received,
    ) -> Result<(), CloseReason> {
        self.clear_finished(buffers);
        let rest = lent.get(received.consumed..).unwrap_or_default();
        let frame = match frame::first_frame_length(rest) {
            Some(length) if length <= rest.len() && self.partial.length == 0 => {
                self.take_whole(buffers, length, received)?
            }
            _ => self.take_partial(buffers, lent, received)?,
        };
        if let Some((store, start, length)) = frame {
            self.open(cipher, store, lent, start, length, received)?;
            self.give_unused(buffers);
        }
        Ok(())
    }

    /// The frame lies whole in the lent bytes: it is opened there.
    fn take_whole(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        length: usize,
        received: &mut Received,
    ) -> Result<Option<(Store, usize, usize)>, CloseReason> {
        self.check_length(length)?;
        // Before the frame is consumed: without a buffer its bytes stay with the port, and the peer's window fills.
        if !self.reserve(buffers, length) {
            received.paused = true;
            return Ok(None);
        }
        let start = received.consumed;
        received.consumed = start.saturating_add(length);
        Ok(Some((Store::Lent, start, length)))
    }

    /// The frame came in pieces: it is collected, and opened when it is whole.
    fn take_partial(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        lent: &[u8],
        received: &mut Received,
    ) -> Result<Option<(Store, usize, usize)>, CloseReason> {
        let rest = lent.get(received.consumed..).unwrap_or_default();
        received.consumed = received.consumed.saturating_add(self.collect(rest, frame::HEADER_BYTES));
        let Some(length) = self.partial_frame_length() else { return Ok(None) };
        self.check_length(length)?;
        if length > self.small.len() && !self.partial.in_buffer {
            if !self.borrow(buffers) {
                received.paused = true;
                return Ok(None);
            }
            self.move_to_buffer(length)?;
        }
        let rest = lent.get(received.consumed..).unwrap_or(&[]);
        received.consumed = received.consumed.saturating_add(self.collect(rest, length));
        if self.partial.length < length {
            return Ok(None);
        }
        if !self.partial.in_buffer && !self.reserve(buffers, length) {
            received.paused = true;
            return Ok(None);
        }
        self.partial.done = true;
        let (store, start) = self.partial_span();
        Ok(Some((store, start, length)))
    }

    fn check_length(&self, length: usize) -> Result<(), CloseReason> {
        if length > self.chunk_limit.saturating_add(frame::HEADER_BYTES) { Err(CloseReason::Oversize) } else { Ok(()) }
    }

    /// A frame that may begin a chunked message needs a buffer before it is opened, since it cannot be closed again.
    /// `false` when one is needed and the pool is empty.
    fn reserve(&mut self, buffers: &mut dyn Buffers<S>, length: usize) -> bool {
        self.assembly.is_some() || length < MINIMUM_CHUNK_BYTES || self.borrow(buffers)
    }

    fn borrow(&mut self, buffers: &mut dyn Buffers<S>) -> bool {
        if self.buffer.is_none() {
            self.buffer = buffers.take();
        }
        self.buffer.is_some()
    }

    /// Bytes of the message that is being put together.
    fn assembled(&self) -> usize {
        self.assembly.as_ref().map_or(0, |assembly| assembly.length)
    }

    /// Where the partial frame begins.
    fn partial_span(&self) -> (Store, usize) {
        if self.partial.in_buffer { (Store::Buffer, self.assembled()) } else { (Store::Small, 0) }
    }

    fn partial_frame_length(&self) -> Option<usize> {
        let (store, start) = self.partial_span();
        let end = start.saturating_add(self.partial.length);
        frame::first_frame_length(self.store(store, &[]).get(start..end)?)
    }

    /// Copies from `bytes` until the partial frame has `length` bytes; returns how many were copied.
    fn collect(&mut self, bytes: &[u8], length: usize) -> usize {
        let (_, start) = self.partial_span();
        let store: &mut [u8] = match &mut self.buffer {
            Some(buffer) if self.partial.in_buffer => buffer,
            _ => &mut self.small,
        };
        let count = length.saturating_sub(self.partial.length).min(bytes.len());
        let from = start.saturating_add(self.partial.length);
        let span = store.get_mut(from..from.saturating_add(count));
        let (Some(span), Some(piece)) = (span, bytes.get(..count)) else { return 0 };
        bytes::copy(piece, span);
        self.partial.length = self.partial.length.saturating_add(count);
        count
    }

    /// Moves the partial frame, which has `length` bytes when it is whole, behind the assembly.
    fn move_to_buffer(&mut self, length: usize) -> Result<(), CloseReason> {
        let start = self.assembled();
        let buffer = self.buffer.as_mut().ok_or(CloseReason::Protocol)?;
        let span = buffer.get_mut(start..start.saturating_add(length)).ok_or(CloseReason::Oversize)?;
        let collected = self.small.get(..self.partial.length).unwrap_or(&[]);
        if let Some(span) = span.get_mut(..collected.len()) {
            bytes::copy(collected, span);
        }
        self.partial.in_buffer = true;
        Ok(())
    }

    /// Opens the frame of `length` bytes at `start` of `store`.
    fn open<C: Seal>(
        &mut self,
        cipher: &mut C,
        store: Store,
        lent: &mut [u8],
        start: usize,
        length: usize,
        received: &mut Received,
    ) -> Result<(), CloseReason> {
        let bytes: &mut [u8] = match (store, &mut self.buffer) {
            (Store::Lent, _) => lent,
            (Store::Buffer, Some(buffer)) => buffer,
            _ => &mut self.small,
        };
        let body_at = start.saturating_add(frame::HEADER_BYTES);
        let sealed = bytes.get_mut(body_at..start.saturating_add(length)).ok_or(CloseReason::Protocol)?;
        let body = cipher.open(sealed)?;
        let end = body_at.saturating_add(body.len());
        let (content, tail) = Content::of(Frame::parse(body)?);
        self.deliver(content, Span { store, start: end.saturating_sub(tail), end }, lent, received)
    }

    fn deliver(
        &mut self,
        content: Content,
        span: Span,
        lent: &[u8],
        received: &mut Received,
    ) -> Result<(), CloseReason> {
        // Totals and lengths are the peer's word. Each arm compares them with the limits before a byte is copied.
        received.inbound = Some(match content {
            Content::Hello => Inbound::Hello(span),
            Content::Refuse(code) => Inbound::Refuse(code),
            Content::Close(code) => Inbound::Close(code),
            Content::Ping => Inbound::Ping,
            Content::Pong => Inbound::Pong,
            Content::Session => Inbound::Session(span),
            Content::Proof => Inbound::Proof(span),
            Content::Confirm => Inbound::Confirm(span),
            Content::Skipped => Inbound::Skipped,
            Content::Piece(Piece { priority, total: Some(total), last: true }) => {
                self.check_whole(span, total as usize)?;
                Inbound::Message(priority, span)
            }
            Content::Piece(Piece { priority, total: Some(total), last: false }) => {
                return self.begin(priority, total as usize, span, lent);
            }
            Content::Piece(piece) => match self.go_on(&piece, span, lent)? {
                Some(whole) => Inbound::Message(piece.priority, whole),
                None => return Ok(()),
            },
        });
        Ok(())
    }

    fn check_whole(&self, span: Span, total: usize) -> Result<(), CloseReason> {
        if total > self.message_limit {
            return Err(CloseReason::Oversize);
        }
        if total == span.length() { Ok(()) } else { Err(CloseReason::Protocol) }
    }

    /// The first of several chunks.
    fn begin(&mut self, priority: Priority, total: usize, span: Span, lent: &[u8]) -> Result<(), CloseReason> {
        let room = self.buffer.as_ref().map_or(0, |buffer| buffer.len());
        if self.assembly.is_some() || span.length() >= total {
            return Err(CloseReason::Protocol);
        }
        if total > self.message_limit || total > room {
            return Err(CloseReason::Oversize);
        }
        self.keep(span, lent, 0)?;
        self.assembly = Some(Assembly { length: span.length(), total, priority, done: false });
        Ok(())
    }

    /// A chunk behind the first one; the whole message with the last one.
    fn go_on(&mut self, piece: &Piece, span: Span, lent: &[u8]) -> Result<Option<Span>, CloseReason> {
        let Some(Assembly { length, total, priority, .. }) = self.assembly else { return Err(CloseReason::Protocol) };
        let end = length.saturating_add(span.length());
        // One message at a time and class: a chunk that does not continue it is no loss to be skipped, but another implementation's
        // mistake, and guessing on would mix two messages.
        if piece.priority != priority || end > total || piece.last != (end == total) {
            return Err(CloseReason::Protocol);
        }
        self.keep(span, lent, length)?;
        self.assembly = Some(Assembly { length: end, total, priority, done: piece.last });
        let whole = Span { store: Store::Buffer, start: 0, end };
        Ok(piece.last.then_some(whole))
    }

    /// Copies the bytes at `span` into the buffer at `at`; if they are in that buffer already, `at` is not behind
    /// them.
    fn keep(&mut self, span: Span, lent: &[u8], at: usize) -> Result<(), CloseReason> {
        let buffer = self.buffer.as_mut().ok_or(CloseReason::Protocol)?;
        let from = match span.store {
            Store::Lent => lent,
            Store::Small => &self.small,
            Store::Buffer => {
                let rest = buffer.get_mut(at..span.end).ok_or(CloseReason::Protocol)?;
                let end = rest.len();
                bytes::move_down(rest, span.start.saturating_sub(at)..end);
                return Ok(());
            }
        };
        let from = from.get(span.start..span.end).ok_or(CloseReason::Protocol)?;
        let to = buffer.get_mut(at..at.saturating_add(from.len())).ok_or(CloseReason::Oversize)?;
        bytes::copy(from, to);
        Ok(())
    }

    fn clear_finished(&mut self, buffers: &mut dyn Buffers<S>) {
        if self.partial.done {
            self.partial = Partial::default();
        }
        self.assembly.take_if(|assembly| assembly.done);
        self.give_unused(buffers);
    }

    fn give_unused(&mut self, buffers: &mut dyn Buffers<S>) {
        if self.assembly.is_none()
            && !self.partial.in_buffer
            && let Some(buffer) = self.buffer.take()
        {
            buffers.give(buffer);
        }
    }

    pub(super) fn release(&mut self, buffers: &mut dyn Buffers<S>) {
        self.assembly = None;
        self.partial = Partial::default();
        self.give_unused(buffers);
    }

    pub(super) fn into_small(self) -> S::Slice<u8> {
        self.small
    }
}

impl Content {
    /// The content of a frame, and the length of its payload at the end of the body.
    fn of(frame: Frame<'_>) -> (Self, usize) {
        match frame {
            Frame::Hello(bytes) => (Self::Hello, bytes.len()),
            Frame::Refuse(code) => (Self::Refuse(code), 0),
            Frame::Close(code) => (Self::Close(code), 0),
            Frame::Ping => (Self::Ping, 0),
            Frame::Pong => (Self::Pong, 0),
            Frame::Session(bytes) => (Self::Session, bytes.len()),
            Frame::Proof(bytes) => (Self::Proof, bytes.len()),
            Frame::Confirm(bytes) => (Self::Confirm, bytes.len()),
            Frame::Skipped => (Self::Skipped, 0),
            Frame::Chunk(Chunk { priority, total, last, bytes }) => {
                (Self::Piece(Piece { priority, total, last }), bytes.len())
            }
        }
    }
}

#[cfg(test)]
mod tests;
