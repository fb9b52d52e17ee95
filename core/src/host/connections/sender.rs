//! What waits to be written: one queue per class and the urgent frames that go between chunks.
//!
//! Frames are sealed just before they are written, in the order in which they go out. What is sealed cannot be
//! overtaken, so no more is sealed at a time than a chunk, or than the port asks for ([`Mailman::seals_ahead`]), and one
//! frame at a time on a link that does not keep up. In plain mode, where sealing changes nothing, all that waits is written
//! in one go, and a frame that the network has not begun to take may still be overtaken. So in the stream an emergency
//! waits for one chunk at most, or for what the port lets be sealed ahead.

use super::urgent::Urgent;
use crate::bytes;
use crate::config::{EMERGENCY_BYTES, MINIMUM_CHUNK_BYTES, Priority};
use crate::error::{CloseReason, Error, Limit};
use crate::host::frame::{self, ChunkWriter, Chunking, Frame};
use crate::host::mailman::{LinkId, Mailman};
use crate::host::secure::Seal;
use crate::storage::{Buffer, Buffers, LEFT_BY_SENDING, Storage};

/// Space for one emergency and the frames that keep a link alive.
const URGENT_BYTES: usize = 2 * EMERGENCY_RESERVE;
/// The part reserved for an emergency: other frames must leave these bytes free.
const EMERGENCY_RESERVE: usize = EMERGENCY_BYTES + 64;

pub(super) struct Sender<S: Storage> {
    chunking: Chunking,
    urgent: Urgent<URGENT_BYTES>,
    queues: [Option<SendQueue<S>>; 3],
    /// The queue whose frames were sealed last and are not all written, or whose message is not complete.
    current: Option<usize>,
    /// The network took less than was offered, and the rest still waits.
    blocked: bool,
}

/// The framed messages of one class: written up to `start`, sealed up to `sealed`, filled up to `end`.
struct SendQueue<S: Storage> {
    buffer: Buffer<S>,
    start: usize,
    sealed: usize,
    end: usize,
    /// The last sealed frame ended a message.
    at_boundary: bool,
    /// `sealed` and `at_boundary` before the last step of sealing.
    before: (usize, bool),
}

/// Whether a write completed, or the network took no more.
#[derive(PartialEq, Eq)]
enum Progress {
    Through,
    Blocked,
}

impl<S: Storage> Sender<S> {
    pub(super) fn new(overhead: usize) -> Self {
        Self {
            chunking: Chunking { chunk: MINIMUM_CHUNK_BYTES, overhead },
            urgent: Urgent::new(),
            queues: [const { None }; 3],
            current: None,
            blocked: false,
        }
    }

    pub(super) fn set_chunk(&mut self, chunk: usize) {
        self.chunking.chunk = chunk;
    }

    /// The network did not take all that it was offered.
    pub(super) const fn is_blocked(&self) -> bool {
        self.blocked
    }

    pub(super) fn queued(&self) -> usize {
        self.queues.iter().flatten().map(SendQueue::waiting).fold(self.urgent.len(), usize::saturating_add)
    }

    /// Whether queued messages prevent one more message of `total` bytes: its class's queue is too full, or the other
    /// queues hold the buffer that it needs.
    pub(super) fn is_in_the_way(&self, buffers: &mut dyn Buffers<S>, priority: Priority, total: usize) -> bool {
        match queue_index(priority).and_then(|index| self.queues.get(index)) {
            Some(Some(queue)) => self.chunking.framed_length(total) > queue.room(),
            // The buffer is only looked for, not kept: between this question and the message another link may need it.
            Some(None) if self.queues.iter().any(Option::is_some) => match buffers.take_leaving(LEFT_BY_SENDING) {
                Some(buffer) => {
                    buffers.give(buffer);
                    false
                }
                None => true,
            },
            _ => false,
        }
    }

    pub(super) fn accept(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        let Some(index) = queue_index(priority) else { return self.accept_emergency(total, write) };
        let slot = self.queues.get_mut(index).ok_or(Error::Full(Limit::SendQueue))?;
        let queue = match slot {
            Some(queue) => queue,
            None => {
                slot.insert(SendQueue::new(buffers.take_leaving(LEFT_BY_SENDING).ok_or(Error::Full(Limit::Buffers))?))
            }
        };
        let Err(error) = queue.append(self.chunking, priority, total, write) else { return Ok(()) };
        if queue.waiting() == 0
            && let Some(queue) = slot.take()
        {
            buffers.give(queue.buffer);
        }
        Err(error)
    }

    /// Whether a message is short and nothing else is queued: it is written from the link's own buffer, and needs none
    /// of the pool if the network takes it.
    pub(super) fn takes_at_once(&self, priority: Priority, total: usize) -> bool {
        self.urgent.is_empty()
            && !self.blocked
            && self.queues.iter().all(Option::is_none)
            && priority != Priority::Emergency
            && self.chunking.framed_length(total) <= MINIMUM_CHUNK_BYTES
    }

    /// After an attempt to write the only message, which went with the urgent frames: if the network has not begun to
    /// take it, it waits in its queue, where those of higher classes overtake it. A seal is not taken back.
    pub(super) fn put_back(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        priority: Priority,
        total: usize,
    ) -> Result<(), Error> {
        let framed = self.chunking.framed_length(total);
        let Some(index) = queue_index(priority) else { return Ok(()) };
        if !self.blocked || self.chunking.overhead > 0 || self.urgent.len() != framed {
            return Ok(());
        }
        let queue = buffers.take_leaving(LEFT_BY_SENDING).map(|buffer| SendQueue::of(buffer, self.urgent.sealed()));
        self.urgent.clear();
        self.blocked = queue.is_some();
        let slot = self.queues.get_mut(index).ok_or(Error::Full(Limit::SendQueue))?;
        *slot = queue;
        if slot.is_some() { Ok(()) } else { Err(Error::Full(Limit::Buffers)) }
    }

    fn accept_emergency(&mut self, total: usize, write: impl FnOnce(&mut ChunkWriter<'_>)) -> Result<(), Error> {
        if total > EMERGENCY_BYTES {
            return Err(Error::TooLarge { limit: EMERGENCY_BYTES as u32 });
        }
        if self.append_urgent(Priority::Emergency, total, write) { Ok(()) } else { Err(Error::Full(Limit::SendQueue)) }
    }

    /// A whole message of one chunk that goes with the urgent frames. It leaves the space reserved for an emergency.
    pub(super) fn accept_short(
        &mut self,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> bool {
        let framed = self.chunking.framed_length(total);
        let end = self.urgent.len().saturating_add(framed);
        framed <= MINIMUM_CHUNK_BYTES
            && end <= URGENT_BYTES.saturating_sub(EMERGENCY_RESERVE)
            && self.append_urgent(priority, total, write)
    }

    pub(super) fn append_urgent(
        &mut self,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> bool {
        let span = self.urgent.append(self.chunking.framed_length(total));
        let writer = span.and_then(|span| ChunkWriter::new(span, self.chunking, priority, total));
        writer.map(|mut writer| write(&mut writer)).is_some()
    }

    pub(super) fn accept_frame(&mut self, frame: &Frame<'_>) -> bool {
        self.append_frame(frame, self.chunking.overhead)
    }

    /// A frame in clear; only while no sealed frame is queued.
    pub(super) fn accept_clear(&mut self, frame: &Frame<'_>) -> bool {
        let accepted = !self.urgent.has_unsealed() && self.append_frame(frame, 0);
        if accepted {
            self.urgent.note_sealed(usize::MAX);
        }
        accepted
    }

    fn append_frame(&mut self, frame: &Frame<'_>, overhead: usize) -> bool {
        let mut scratch = [0; EMERGENCY_RESERVE];
        let length = frame::encode(frame, overhead, &mut scratch);
        let end = self.urgent.len().saturating_add(length);
        if length == 0 || end > URGENT_BYTES.saturating_sub(EMERGENCY_RESERVE) {
            return false;
        }
        let span = self.urgent.append(length);
        span.map(|span| bytes::copy(scratch.get(..length).unwrap_or(&[]), span)).is_some()
    }

    /// Whether all of these frames that are no chunks would be accepted now.
    pub(super) fn has_room_for_frames(&self, frames: &[Frame<'_>]) -> bool {
        let length = |frame| frame::encoded_length(frame, self.chunking.overhead);
        let end = frames.iter().map(length).fold(self.urgent.len(), usize::saturating_add);
        end <= URGENT_BYTES.saturating_sub(EMERGENCY_RESERVE)
    }

    /// Writes what the network takes now; returns how many bytes that were.
    pub(super) fn flush<C: Seal, E>(
        &mut self,
        id: LinkId,
        cipher: &mut C,
        mailman: &mut dyn Mailman<E>,
        buffers: &mut dyn Buffers<S>,
    ) -> Result<u64, CloseReason> {
        let mut written = 0;
        while self.write_sealed(id, mailman, &mut written)? == Progress::Through {
            if written > 0 {
                self.give_drained(buffers);
            }
            if !self.seal_next(cipher, mailman.seals_ahead())? {
                self.blocked = false;
                return Ok(written);
            }
        }
        self.blocked = true;
        Ok(written)
    }

    /// Writes what is sealed: the rest of the current queue's frames, then sealed urgent ones.
    fn write_sealed<E>(
        &mut self,
        id: LinkId,
        mailman: &mut dyn Mailman<E>,
        written: &mut u64,
    ) -> Result<Progress, CloseReason> {
        if let Some(Some(queue)) = self.current.and_then(|index| self.queues.get_mut(index)) {
            let progress = queue.write(id, mailman, written)?;
            if progress == Progress::Blocked {
                if self.chunking.overhead == 0 {
                    queue.unseal();
                }
                return Ok(progress);
            }
        }
        while self.urgent.has_sealed() {
            let count = mailman.write(id, &[self.urgent.sealed()])?;
            if count == 0 {
                return Ok(Progress::Blocked);
            }
            self.urgent.drop_front(count);
            *written = written.saturating_add(count as u64);
        }
        Ok(Progress::Through)
    }

    /// Seals what is to be written next: urgent frames before all others. `false` when nothing waits.
    fn seal_next<C: Seal>(&mut self, cipher: &mut C, ahead: usize) -> Result<bool, CloseReason> {
        // Urgent frames go between two frames of a message, never into one: the cipher counts frames in the order of the stream.
        while self.urgent.has_unsealed() {
            let rest = self.urgent.unsealed();
            let turns = frame::is_turn(rest, self.chunking.overhead);
            let length = seal_first(cipher, rest)?;
            self.urgent.note_sealed(length);
            if turns {
                cipher.turn()?;
            }
        }
        if self.urgent.has_sealed() {
            return Ok(true);
        }
        self.current = self.next_queue();
        let Some(Some(queue)) = self.current.and_then(|index| self.queues.get_mut(index)) else { return Ok(false) };
        let most = match self.chunking.overhead {
            0 => usize::MAX,
            // A seal cannot be taken back, and what is sealed cannot be overtaken. So no more is sealed than the network takes now.
            _ if self.blocked => 0,
            _ => ahead.max(self.chunking.chunk),
        };
        queue.seal(cipher, most)?;
        Ok(true)
    }

    /// The queue whose message is not complete, or else the highest one.
    fn next_queue(&self) -> Option<usize> {
        let unfinished = self.current.filter(|&index| match self.queues.get(index) {
            Some(Some(queue)) => !queue.at_boundary,
            _ => false,
        });
        unfinished.or_else(|| self.queues.iter().position(Option::is_some))
    }

    fn give_drained(&mut self, buffers: &mut dyn Buffers<S>) {
        for slot in &mut self.queues {
            if slot.as_ref().is_some_and(|queue| queue.waiting() == 0)
                && let Some(queue) = slot.take()
            {
                buffers.give(queue.buffer);
            }
        }
    }

    pub(super) fn release(&mut self, buffers: &mut dyn Buffers<S>) {
        for queue in self.queues.iter_mut().filter_map(Option::take) {
            buffers.give(queue.buffer);
        }
        self.urgent.clear();
        self.blocked = false;
    }
}

impl<S: Storage> SendQueue<S> {
    fn new(buffer: Buffer<S>) -> Self {
        Self { buffer, start: 0, sealed: 0, end: 0, at_boundary: true, before: (0, true) }
    }

    /// A queue that holds the frames of a short message, which fit into any buffer.
    fn of(buffer: Buffer<S>, frames: &[u8]) -> Self {
        let mut queue = Self::new(buffer);
        if let Some(span) = queue.buffer.get_mut(..frames.len()) {
            bytes::copy(frames, span);
            queue.end = frames.len();
        }
        queue
    }

    /// Bytes that are not written.
    fn waiting(&self) -> usize {
        self.end.saturating_sub(self.start)
    }

    /// Bytes that still fit, counting those that moving the rest to the front would free.
    fn room(&self) -> usize {
        self.buffer.len().saturating_sub(self.waiting())
    }

    fn append(
        &mut self,
        chunking: Chunking,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        let framed = chunking.framed_length(total);
        let size = self.buffer.len();
        if framed > size {
            let limit = size.saturating_sub(framed.saturating_sub(total));
            return Err(Error::TooLarge { limit: u32::try_from(limit).unwrap_or(u32::MAX) });
        }
        if framed > self.room() {
            return Err(Error::Full(Limit::SendQueue));
        }
        if framed > size.saturating_sub(self.end) {
            self.close_gap();
        }
        let end = self.end.saturating_add(framed);
        let span = self.buffer.get_mut(self.end..end).unwrap_or(&mut []);
        let mut writer = ChunkWriter::new(span, chunking, priority, total).ok_or(Error::Full(Limit::SendQueue))?;
        write(&mut writer);
        self.end = end;
        Ok(())
    }

    fn close_gap(&mut self) {
        bytes::move_down(&mut self.buffer, self.start..self.end);
        self.end = self.end.saturating_sub(self.start);
        self.sealed = self.sealed.saturating_sub(self.start);
        self.before = (self.sealed, self.at_boundary);
        self.start = 0;
    }

    /// Seals the next frame, and those behind it as long as no more than `most` bytes are ready to be written.
    fn seal<C: Seal>(&mut self, cipher: &mut C, most: usize) -> Result<(), CloseReason> {
        self.before = (self.sealed, self.at_boundary);
        while self.sealed < self.end {
            let rest = self.buffer.get_mut(self.sealed..self.end).unwrap_or(&mut []);
            self.at_boundary = frame::ends_message(rest);
            let length = seal_first(cipher, rest)?;
            self.sealed = self.sealed.saturating_add(length);
            let next = self.buffer.get(self.sealed..self.end).and_then(frame::first_frame_length);
            let ready = self.sealed.saturating_sub(self.start);
            if next.is_none_or(|next| ready.saturating_add(next) > most) {
                break;
            }
        }
        Ok(())
    }

    /// Takes back the seal of the frames that the network has not begun to take. For plain mode only.
    fn unseal(&mut self) {
        let (mut sealed, mut at_boundary) = self.before;
        while sealed < self.start {
            let rest = self.buffer.get(sealed..self.end).unwrap_or(&[]);
            let Some(length) = frame::first_frame_length(rest) else { return };
            at_boundary = frame::ends_message(rest);
            sealed = sealed.saturating_add(length);
        }
        self.sealed = sealed;
        self.at_boundary = at_boundary;
        self.before = (sealed, at_boundary);
    }

    fn write<E>(
        &mut self,
        id: LinkId,
        mailman: &mut dyn Mailman<E>,
        written: &mut u64,
    ) -> Result<Progress, CloseReason> {
        while self.start < self.sealed {
            let piece = self.buffer.get(self.start..self.sealed).unwrap_or(&[]);
            let count = mailman.write(id, &[piece])?;
            if count == 0 {
                return Ok(Progress::Blocked);
            }
            self.start = self.start.saturating_add(count);
            *written = written.saturating_add(count as u64);
        }
        Ok(Progress::Through)
    }
}

/// Seals the first of `frames`; returns its length.
fn seal_first<C: Seal>(cipher: &mut C, frames: &mut [u8]) -> Result<usize, CloseReason> {
    let length = frame::first_frame_length(frames).ok_or(CloseReason::Protocol)?;
    let body = frames.get_mut(frame::HEADER_BYTES..length).ok_or(CloseReason::Protocol)?;
    cipher.seal(body)?;
    Ok(length)
}

const fn queue_index(priority: Priority) -> Option<usize> {
    match priority {
        Priority::Emergency => None,
        Priority::High => Some(0),
        Priority::Normal => Some(1),
        Priority::Low => Some(2),
    }
}

#[cfg(test)]
mod tests;
