//! The paper's `Connections`: one link's stream of frames, what waits to be written, and whether the peer is alive.
//!
//! A [`Link`] owns little (a small buffer for partial frames, room for one emergency) and borrows full message buffers
//! from the unit's pool: one for what is being received, one per priority class that cannot be written at once. It
//! knows nothing of requests; it hands up whole messages and takes whole messages down.

mod counters;
mod delivery;
mod liveness;
mod receiver;
mod sender;
mod urgent;

pub use counters::LinkCounter;
pub use delivery::Report;
pub use liveness::{Liveness, Look};

use crate::config::{MINIMUM_CHUNK_BYTES, Priority};
use crate::counters::Counters;
use crate::error::{CloseReason, Error};
use crate::host::frame::{ChunkWriter, Frame};
use crate::host::mailman::{LinkId, Mailman};
use crate::host::secure::{PROOF_BYTES, Seal, Secure};
use crate::storage::{Buffers, Storage};
use receiver::Receiver;
use sender::Sender;

/// A whole frame or message that arrived; [`Link::view`] shows the bytes.
#[derive(Clone, Copy, Debug)]
// A wide tag, so that the rest is moved in words, not bytes.
#[repr(u32)]
pub enum Inbound {
    /// The peer's hello.
    Hello(Span),
    /// The peer refuses, with a code.
    Refuse(u8),
    /// The peer closes, with a code.
    Close(u8),
    /// To be answered.
    Ping,
    /// An answer to a ping.
    Pong,
    /// A session body that came in the stream.
    Session(Span),
    /// A message of the proof.
    Proof(Span),
    /// What the peer tells in its first frame under its keys.
    Confirm(Span),
    /// A whole message.
    Message(Priority, Span),
    /// A frame of a later version, which a live link passes over.
    Skipped,
}

/// Where bytes that arrived lie, until the next call of [`Link::receive`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    store: Store,
    start: usize,
    end: usize,
}

impl Span {
    /// All of a lent slice of `length` bytes.
    pub(crate) const fn lent(length: usize) -> Self {
        Self { store: Store::Lent, start: 0, end: length }
    }

    /// Whether it lies in a buffer of the pool, which the link gives back before it looks at anything else.
    pub(crate) fn is_in_buffer(self) -> bool {
        matches!(self.store, Store::Buffer)
    }

    /// The last `length` bytes of it.
    #[inline]
    pub fn last(self, length: usize) -> Self {
        Self { start: self.end.saturating_sub(length).max(self.start), ..self }
    }

    fn length(self) -> usize {
        self.end.saturating_sub(self.start)
    }
}

/// Which bytes a [`Span`] is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Store {
    /// Those that the port lent.
    Lent,
    /// The link's own.
    Small,
    /// The buffer that the link borrows for receiving.
    Buffer,
}

/// Result of [`Link::receive`].
#[derive(Clone, Copy, Debug)]
pub struct Received {
    /// How many of the lent bytes are used up.
    pub consumed: usize,
    /// What they completed.
    pub inbound: Option<Inbound>,
    /// No message buffer is free: stop reading, and offer the rest again later.
    pub paused: bool,
}

/// One end of a stream.
#[doc(alias = "Connections")]
pub struct Link<S: Storage, C: Seal> {
    id: LinkId,
    cipher: C,
    receiver: Receiver<S>,
    sender: Sender<S>,
    /// What happened on this link.
    pub counters: Counters<LinkCounter, { LinkCounter::COUNT }>,
}

impl<S: Storage, C: Seal> Link<S, C> {
    /// A link; `small` is its own buffer of [`crate::config::LINK_BUFFER_BYTES`], the limits are those that this unit advertises.
    pub fn new(id: LinkId, cipher: C, small: S::Slice<u8>, chunk_limit: usize, message_limit: usize) -> Self {
        let overhead = cipher.overhead();
        Self {
            id,
            cipher,
            receiver: Receiver::new(small, chunk_limit.max(MINIMUM_CHUNK_BYTES), message_limit),
            sender: Sender::new(overhead),
            counters: Counters::new(),
        }
    }

    /// The link's index.
    pub const fn id(&self) -> LinkId {
        self.id
    }

    /// The link's cipher.
    pub(crate) const fn cipher(&mut self) -> &mut C {
        &mut self.cipher
    }

    /// Sets the longest chunk that this unit accepts; small until the peer has proven itself, so that it costs little
    /// memory.
    pub(crate) fn set_chunk_limit(&mut self, limit: usize) {
        self.receiver.set_chunk_limit(limit);
    }

    /// Sets the longest chunk that the peer accepts, from its hello.
    pub(crate) fn set_peer_limits(&mut self, chunk: usize) {
        self.sender.set_chunk(chunk.max(MINIMUM_CHUNK_BYTES));
    }

    /// Raises the longest message that this unit accepts. A limit below the one advertised to the peer changes nothing
    /// here, since longer messages may be in flight: the reader of the message refuses them.
    pub(crate) fn set_message_limit(&mut self, limit: usize) {
        self.receiver.raise_message_limit(limit);
    }

    /// Ingests what the port has read. Call it again with the unconsumed rest, and then with an empty slice, until it
    /// completes nothing: that last call returns the buffer of the last message.
    pub fn receive(&mut self, buffers: &mut dyn Buffers<S>, bytes: &mut [u8]) -> Result<Received, CloseReason> {
        let available = bytes.len();
        let mut received = Received { consumed: 0, inbound: None, paused: false };
        self.receiver.receive(&mut self.cipher, buffers, bytes, &mut received)?;
        self.counters.add(LinkCounter::BytesReceived, received.consumed as u64);
        if received.paused && available > 0 {
            self.counters.count(LinkCounter::ReadPaused);
        }
        if received.inbound.is_some() {
            self.counters.count(LinkCounter::FramesReceived);
        }
        if let Some(Inbound::Message(..)) = received.inbound {
            self.counters.count(LinkCounter::MessagesReceived);
        }
        Ok(received)
    }

    /// Whether received data is retained; otherwise a [`receive`](Self::receive) of an empty slice does nothing.
    pub fn holds_received(&self) -> bool {
        self.receiver.holds_anything()
    }

    /// The bytes at `span`; `lent` is the slice that was lent to [`receive`](Self::receive).
    pub fn view<'b>(&'b self, span: Span, lent: &'b [u8]) -> &'b [u8] {
        view(&self.receiver, span, lent)
    }

    /// Accepts one message of `total` bytes, which `write` puts into the send buffer, and writes what the network takes
    /// unless it is to `hold`. Refused before the first byte when it cannot be kept: [`Error::Full`] when it can be
    /// later, [`Error::TooLarge`] when it never can.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn send_message<E>(
        &mut self,
        mailman: &mut dyn Mailman<E>,
        buffers: &mut dyn Buffers<S>,
        priority: Priority,
        total: usize,
        hold: bool,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        if !hold && self.sender.takes_at_once(priority, total) {
            return self.send_at_once(mailman, buffers, priority, total, write);
        }
        if self.sender.is_in_the_way(buffers, priority, total) {
            // What was held back goes out and makes room.
            self.flush(mailman, buffers).map_err(Error::Closed)?;
        }
        if let Err(error) = self.sender.accept(buffers, priority, total, write) {
            self.counters.count(LinkCounter::SendRefused);
            return Err(error);
        }
        self.counters.count(LinkCounter::MessagesSent);
        if hold { Ok(()) } else { self.flush(mailman, buffers).map_err(Error::Closed) }
    }

    /// The same for a short message while nothing waits.
    fn send_at_once<E>(
        &mut self,
        mailman: &mut dyn Mailman<E>,
        buffers: &mut dyn Buffers<S>,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        self.sender.append_urgent(priority, total, write);
        self.flush(mailman, buffers).map_err(Error::Closed)?;
        let kept = self.sender.put_back(buffers, priority, total);
        let counter = if kept.is_ok() { LinkCounter::MessagesSent } else { LinkCounter::SendRefused };
        self.counters.count(counter);
        kept
    }

    /// Accepts a message of one short chunk into the link's own bytes, for an answer that finds no buffer. It may overtake
    /// other messages. `false` when there is no room.
    pub(crate) fn send_short(
        &mut self,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> bool {
        let accepted = self.sender.accept_short(priority, total, write);
        self.counters.count(if accepted { LinkCounter::MessagesSent } else { LinkCounter::FramesWithheld });
        accepted
    }

    /// Accepts a frame that is no chunk. `false` when the room reserved for such frames is full.
    pub fn send_frame(&mut self, frame: &Frame<'_>) -> bool {
        let accepted = self.sender.accept_frame(frame);
        if !accepted {
            self.counters.count(LinkCounter::FramesWithheld);
        }
        accepted
    }

    /// Accepts all of these frames that are no chunks, one behind the other, or none: `false` when the room reserved for
    /// such frames is too full.
    pub(crate) fn send_frames(&mut self, frames: &[Frame<'_>]) -> bool {
        self.sender.has_room_for_frames(frames) && frames.iter().all(|frame| self.send_frame(frame))
    }

    /// Accepts a frame that is no chunk and is not sealed: before the proof. `false` as above.
    pub(crate) fn send_clear(&mut self, frame: &Frame<'_>) -> bool {
        let accepted = self.sender.accept_clear(frame);
        self.counters.add(LinkCounter::FramesWithheld, u64::from(!accepted));
        accepted
    }

    /// Writes what the network takes now.
    pub fn flush<E>(&mut self, mailman: &mut dyn Mailman<E>, buffers: &mut dyn Buffers<S>) -> Result<(), CloseReason> {
        let written = self.sender.flush(self.id, &mut self.cipher, mailman, buffers)?;
        self.counters.add(LinkCounter::BytesSent, written);
        Ok(())
    }

    /// Whether the network accepted less than was offered: the port then waits for the stream to become writable.
    pub fn wants_to_write(&self) -> bool {
        self.sender.is_blocked()
    }

    /// Bytes that wait to be written.
    pub(crate) fn queued(&self) -> usize {
        self.sender.queued()
    }

    /// Returns every borrowed buffer. The link must not be used afterwards.
    pub fn release(&mut self, buffers: &mut dyn Buffers<S>) {
        self.receiver.release(buffers);
        self.sender.release(buffers);
    }

    /// Its own buffer, for the next link.
    pub(crate) fn into_small(self) -> S::Slice<u8> {
        self.receiver.into_small()
    }
}

impl<S: Storage, C: Secure> Link<S, C> {
    /// Gives the hello at `span` to the cipher.
    pub(crate) fn introduce(&mut self, span: Span, lent: &[u8]) {
        self.cipher.introduce(view(&self.receiver, span, lent));
    }

    /// Gives the message of the proof at `span` to the cipher; the answer to send, if there is one.
    pub(crate) fn answer(&mut self, span: Span, lent: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        self.cipher.answer(view(&self.receiver, span, lent))
    }

    /// Gives the confirmation at `span` to the cipher.
    pub(crate) fn confirmed(&mut self, span: Span, lent: &[u8]) -> Result<(), CloseReason> {
        self.cipher.confirmed(view(&self.receiver, span, lent))
    }
}

fn view<'b, S: Storage>(receiver: &'b Receiver<S>, span: Span, lent: &'b [u8]) -> &'b [u8] {
    receiver.store(span.store, lent).get(span.start..span.end).unwrap_or(&[])
}

#[cfg(test)]
mod harness;
