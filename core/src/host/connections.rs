//! The paper's `Connections`: one link's stream of frames, what waits to be written, and whether the peer is alive.
//!
//! A [`Link`] owns little (a small buffer for partial frames, room for one emergency) and borrows full message buffers
//! from the unit's pool: one to put a chunked message together, one per priority class that cannot be written at once.
//! It knows nothing of requests; it hands up whole messages and takes whole messages down.

use crate::config::{EMERGENCY_BYTES, MINIMUM_CHUNK_BYTES, MISSED_KEEP_ALIVES, Priority, TCP_ONLY_LOSS};
use crate::counters::Counters;
use crate::error::{CloseReason, Error, Limit};
use crate::host::frame::{self, Chunk, ChunkWriter, Cut, Frame};
use crate::host::mailman::{LinkId, Mailman};
use crate::host::secure::Secure;
use crate::storage::{Buffer, Buffers, Storage};
use crate::time::{Duration, Instant};

/// Room for one emergency and the frames that keep a link going.
const URGENT_BYTES: usize = 2 * (EMERGENCY_BYTES + 64);
/// What an emergency may need of it: nothing else may take the last of these bytes.
const EMERGENCY_RESERVE: usize = EMERGENCY_BYTES + 64;

crate::counters::counters! {
    /// What a link counts (paper: "message monitoring").
    pub enum LinkCounter {
        /// Frames received.
        FramesReceived,
        /// Bytes received.
        BytesReceived,
        /// Messages received whole.
        MessagesReceived,
        /// Messages accepted for sending.
        MessagesSent,
        /// Bytes that the network took.
        BytesSent,
        /// Messages refused because the class's buffer was full or none was free.
        SendRefused,
        /// Times that reading paused because no message buffer was free.
        ReadPaused,
        /// Session datagrams received.
        DatagramsReceived,
        /// Session datagrams sent.
        DatagramsSent,
        /// Session datagrams that could not be read, or were not of this session.
        DatagramsDropped,
        /// Keep-alives that did not come in time.
        KeepAlivesMissed,
        /// Requests sent.
        RequestsSent,
        /// Requests received.
        RequestsReceived,
        /// Requests given to a handler.
        RequestsRun,
        /// Requests refused because their id had been seen.
        RequestsRepeated,
        /// Requests refused because they were too old.
        RequestsExpired,
        /// Requests refused because as many waited as may.
        RequestsBusy,
        /// Requests refused because they came too soon.
        RequestsTooSoon,
        /// Requests that did not fit a published function.
        RequestsRejected,
        /// Requests of this unit that it did not send itself because of its own limits.
        RequestsWithheld,
        /// Calls that ended without an answer in time.
        CallsTimedOut,
        /// Answers to calls that had ended already.
        RepliesLate,
        /// Answers that could not be sent.
        RepliesDropped,
        /// Functions of the peer's list that did not fit here.
        FunctionsSkipped,
        /// Leases that ended without being renewed.
        LeasesExpired,
        /// Renewals that came for no running lease.
        RenewalsIgnored,
    }
}

/// A whole frame or message that arrived; [`Link::view`] shows the bytes.
#[derive(Clone, Copy, Debug)]
pub enum Incoming {
    /// The peer's hello.
    Hello(Place),
    /// The peer refuses, with a code.
    Refuse(u8),
    /// The peer closes, with a code.
    Close(u8),
    /// To be answered.
    Ping,
    /// An answer to a ping.
    Pong,
    /// A session body that came in the stream.
    Session(Place),
    /// A whole message.
    Message(Priority, Place),
}

/// Where bytes that arrived lie, until the next call of [`Link::receive`].
#[derive(Clone, Copy, Debug)]
pub struct Place {
    store: Store,
    start: usize,
    end: usize,
}

impl Place {
    /// All of a lent slice of `length` bytes.
    pub const fn lent(length: usize) -> Self {
        Self { store: Store::Lent, start: 0, end: length }
    }

    /// The same without its first `count` bytes.
    pub fn after(self, count: usize) -> Self {
        Self { start: self.start.saturating_add(count).min(self.end), ..self }
    }
}

#[derive(Clone, Copy, Debug)]
enum Store {
    Lent,
    Partial,
    Assembly,
}

/// Result of [`Link::receive`].
#[derive(Clone, Copy, Debug)]
pub struct Received {
    /// How many of the lent bytes are used up.
    pub consumed: usize,
    /// What they completed.
    pub incoming: Option<Incoming>,
    /// No message buffer is free: stop reading, and offer the rest again later.
    pub paused: bool,
}

/// One end of a stream.
pub struct Link<S: Storage, C: Secure> {
    id: LinkId,
    cipher: C,
    receiver: Receiver<S>,
    sender: Sender<S>,
    /// What happened on this link.
    pub counters: Counters<LinkCounter, { LinkCounter::COUNT }>,
}

impl<S: Storage, C: Secure> Link<S, C> {
    /// A link; `small` is its own buffer of [`crate::config::LINK_BUFFER_BYTES`], the limits are what this unit told.
    pub fn new(id: LinkId, cipher: C, small: S::Slice<u8>, chunk_limit: usize, message_limit: usize) -> Self {
        Self {
            id,
            cipher,
            receiver: Receiver::new(small, chunk_limit, message_limit),
            sender: Sender::new(),
            counters: Counters::new(),
        }
    }

    /// The link's index.
    pub const fn id(&self) -> LinkId {
        self.id
    }

    /// Sets the longest chunk and message that the peer takes, as its hello told.
    pub fn set_peer_limits(&mut self, chunk: usize) {
        self.sender.cut.chunk = chunk.max(MINIMUM_CHUNK_BYTES);
    }

    /// Sets the longest message that this unit takes.
    pub fn set_message_limit(&mut self, limit: usize) {
        self.receiver.message_limit = limit;
    }

    /// Takes what the port has read. Call it again with the rest, and once with nothing, until it completes nothing:
    /// that call gives the buffer of the last message back.
    pub fn receive(&mut self, buffers: &mut impl Buffers<S>, bytes: &mut [u8]) -> Result<Received, CloseReason> {
        let available = bytes.len();
        let received = self.receiver.receive(&mut self.cipher, buffers, bytes)?;
        self.counters.add(LinkCounter::BytesReceived, received.consumed as u64);
        if received.paused && available > 0 {
            self.counters.add(LinkCounter::ReadPaused, 1);
        }
        if received.incoming.is_some() {
            self.counters.add(LinkCounter::FramesReceived, 1);
        }
        if let Some(Incoming::Message(..)) = received.incoming {
            self.counters.add(LinkCounter::MessagesReceived, 1);
        }
        Ok(received)
    }

    /// The bytes at `place`; `lent` is the slice that was lent to [`receive`](Self::receive).
    pub fn view<'b>(&'b self, place: Place, lent: &'b [u8]) -> &'b [u8] {
        let store = match place.store {
            Store::Lent => lent,
            Store::Partial => self.receiver.partial_store(),
            Store::Assembly => self.receiver.assembly.as_ref().map_or(&[][..], |assembly| &assembly.buffer),
        };
        store.get(place.start..place.end).unwrap_or(&[])
    }

    /// Accepts one message of `total` bytes, which `write` puts into the send buffer, and writes what the network takes.
    /// Refused before the first byte when it cannot be kept.
    pub fn send_message(
        &mut self,
        mailman: &mut impl Mailman,
        buffers: &mut impl Buffers<S>,
        priority: Priority,
        total: usize,
        hold: bool,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        self.sender.cut.overhead = C::OVERHEAD;
        if let Err(error) = self.sender.accept(buffers, priority, total, write) {
            self.counters.add(LinkCounter::SendRefused, 1);
            return Err(error);
        }
        self.counters.add(LinkCounter::MessagesSent, 1);
        if hold { Ok(()) } else { self.flush(mailman, buffers).map_err(Error::Closed) }
    }

    /// Accepts a frame that is no chunk. `false` when the room reserved for such frames is full.
    pub fn send_frame(&mut self, frame: &Frame<'_>) -> bool {
        self.sender.accept_frame(frame, C::OVERHEAD)
    }

    /// Writes what the network takes now.
    pub fn flush(&mut self, mailman: &mut impl Mailman, buffers: &mut impl Buffers<S>) -> Result<(), CloseReason> {
        let written = self.sender.flush(self.id, &mut self.cipher, mailman, buffers)?;
        self.counters.add(LinkCounter::BytesSent, written);
        Ok(())
    }

    /// Whether bytes wait to be written: the port asks to be told when the stream is writable.
    pub fn wants_to_write(&self) -> bool {
        !self.sender.is_empty()
    }

    /// Bytes that wait to be written.
    pub fn queued(&self) -> usize {
        let lanes = self.sender.lanes.iter().flatten().map(|lane| lane.end.saturating_sub(lane.start));
        lanes.fold(self.sender.urgent.len(), usize::saturating_add)
    }

    /// Gives every borrowed buffer back. The link is of no use afterwards.
    pub fn release(&mut self, buffers: &mut impl Buffers<S>) {
        self.receiver.release(buffers);
        self.sender.release(buffers);
    }
}

/// Puts frames and messages together from whatever pieces the network delivers.
struct Receiver<S: Storage> {
    small: S::Slice<u8>,
    /// A frame that is not complete: in `small`, or in a buffer when it is longer.
    large: Option<Buffer<S>>,
    partial: usize,
    /// The frame in the partial buffer was handed up and is done with.
    partial_done: bool,
    assembly: Option<Assembly<S>>,
    chunk_limit: usize,
    message_limit: usize,
}

struct Assembly<S: Storage> {
    buffer: Buffer<S>,
    length: usize,
    total: usize,
    priority: Priority,
    done: bool,
}

impl<S: Storage> Receiver<S> {
    fn new(small: S::Slice<u8>, chunk_limit: usize, message_limit: usize) -> Self {
        Self { small, large: None, partial: 0, partial_done: false, assembly: None, chunk_limit, message_limit }
    }

    fn receive<C: Secure>(
        &mut self,
        cipher: &mut C,
        buffers: &mut impl Buffers<S>,
        bytes: &mut [u8],
    ) -> Result<Received, CloseReason> {
        self.clear_finished(buffers);
        if self.partial == 0 {
            match frame::first_frame_length(bytes) {
                Some(length) if length <= bytes.len() => return self.take_whole(cipher, buffers, bytes, length),
                _ => {}
            }
        }
        self.take_partial(cipher, buffers, bytes)
    }

    /// The frame lies whole in the lent bytes: it is opened there.
    fn take_whole<C: Secure>(
        &mut self,
        cipher: &mut C,
        buffers: &mut impl Buffers<S>,
        bytes: &mut [u8],
        length: usize,
    ) -> Result<Received, CloseReason> {
        self.check_length(length)?;
        let Some(spare) = self.reserve(buffers, length) else {
            return Ok(Received { consumed: 0, incoming: None, paused: true });
        };
        let sealed = bytes.get_mut(frame::HEADER_BYTES..length).ok_or(CloseReason::Protocol)?;
        let body = cipher.open(sealed)?;
        let incoming = deliver::<S>(&mut self.assembly, buffers, spare, self.message_limit, Store::Lent, body)?;
        Ok(Received { consumed: length, incoming, paused: false })
    }

    /// The frame came in pieces: it is collected in the link's own buffer, or in a borrowed one when it is longer.
    fn take_partial<C: Secure>(
        &mut self,
        cipher: &mut C,
        buffers: &mut impl Buffers<S>,
        bytes: &[u8],
    ) -> Result<Received, CloseReason> {
        let mut consumed = 0;
        if self.partial < frame::HEADER_BYTES {
            consumed = self.collect(bytes, frame::HEADER_BYTES);
        }
        let collected = self.partial_store().get(..self.partial).unwrap_or(&[]);
        let Some(length) = frame::first_frame_length(collected) else {
            return Ok(Received { consumed, incoming: None, paused: false });
        };
        self.check_length(length)?;
        if length > self.small.len() && self.large.is_none() && !self.move_to_large(buffers) {
            return Ok(Received { consumed, incoming: None, paused: true });
        }
        let rest = bytes.get(consumed..).unwrap_or(&[]);
        consumed = consumed.saturating_add(self.collect(rest, length));
        if self.partial < length {
            return Ok(Received { consumed, incoming: None, paused: false });
        }
        let Some(spare) = self.reserve(buffers, length) else {
            return Ok(Received { consumed, incoming: None, paused: true });
        };
        self.partial_done = true;
        let store = match &mut self.large {
            Some(large) => large,
            None => &mut self.small,
        };
        let sealed = store.get_mut(frame::HEADER_BYTES..length).ok_or(CloseReason::Protocol)?;
        let body = cipher.open(sealed)?;
        let incoming = deliver::<S>(&mut self.assembly, buffers, spare, self.message_limit, Store::Partial, body)?;
        Ok(Received { consumed, incoming, paused: false })
    }

    fn check_length(&self, length: usize) -> Result<(), CloseReason> {
        if length > self.chunk_limit.saturating_add(frame::HEADER_BYTES) { Err(CloseReason::Oversize) } else { Ok(()) }
    }

    /// A frame that may begin a chunked message needs a buffer before it is opened, since it cannot be closed again.
    /// `None` when one is needed and the pool is empty.
    fn reserve(&self, buffers: &mut impl Buffers<S>, length: usize) -> Option<Option<Buffer<S>>> {
        if self.assembly.is_some() || length < MINIMUM_CHUNK_BYTES {
            return Some(None);
        }
        buffers.take().map(Some)
    }

    fn partial_store(&self) -> &[u8] {
        self.large.as_ref().unwrap_or(&self.small)
    }

    /// Copies from `bytes` until the partial frame has `length` bytes; returns how many were copied.
    fn collect(&mut self, bytes: &[u8], length: usize) -> usize {
        let store = match &mut self.large {
            Some(large) => large,
            None => &mut self.small,
        };
        let count = length.saturating_sub(self.partial).min(bytes.len());
        let end = self.partial.saturating_add(count);
        let (Some(place), Some(piece)) = (store.get_mut(self.partial..end), bytes.get(..count)) else { return 0 };
        place.copy_from_slice(piece);
        self.partial = end;
        count
    }

    fn move_to_large(&mut self, buffers: &mut impl Buffers<S>) -> bool {
        let Some(mut large) = buffers.take() else { return false };
        if let (Some(to), Some(from)) = (large.get_mut(..self.partial), self.small.get(..self.partial)) {
            to.copy_from_slice(from);
        }
        self.large = Some(large);
        true
    }

    fn clear_finished(&mut self, buffers: &mut impl Buffers<S>) {
        if self.partial_done {
            self.partial_done = false;
            self.partial = 0;
            if let Some(large) = self.large.take() {
                buffers.give(large);
            }
        }
        if self.assembly.as_ref().is_some_and(|assembly| assembly.done)
            && let Some(assembly) = self.assembly.take()
        {
            buffers.give(assembly.buffer);
        }
    }

    fn release(&mut self, buffers: &mut impl Buffers<S>) {
        if let Some(large) = self.large.take() {
            buffers.give(large);
        }
        if let Some(assembly) = self.assembly.take() {
            buffers.give(assembly.buffer);
        }
        self.partial = 0;
    }
}

/// Turns an opened frame into what it completes. `spare` is the buffer reserved for a chunked message.
fn deliver<S: Storage>(
    assembly: &mut Option<Assembly<S>>,
    buffers: &mut impl Buffers<S>,
    spare: Option<Buffer<S>>,
    message_limit: usize,
    store: Store,
    body: &[u8],
) -> Result<Option<Incoming>, CloseReason> {
    let frame = Frame::parse(body);
    let begins = matches!(&frame, Ok(Frame::Chunk(Chunk { total: Some(_), last: false, .. })));
    let spare = match spare {
        Some(spare) if !begins => {
            buffers.give(spare);
            None
        }
        spare => spare,
    };
    // What a frame carries is the tail of its body, and the body starts behind the header.
    let end = body.len().saturating_add(frame::HEADER_BYTES);
    let tail = |bytes: &[u8]| Place { store, start: end.saturating_sub(bytes.len()), end };
    Ok(Some(match frame? {
        Frame::Hello(bytes) => Incoming::Hello(tail(bytes)),
        Frame::Refuse(code) => Incoming::Refuse(code),
        Frame::Close(code) => Incoming::Close(code),
        Frame::Ping => Incoming::Ping,
        Frame::Pong => Incoming::Pong,
        Frame::Session(bytes) => Incoming::Session(tail(bytes)),
        Frame::Chunk(chunk) => match (chunk.total, chunk.last) {
            (Some(total), true) => {
                check_whole(&chunk, total, message_limit)?;
                Incoming::Message(chunk.priority, tail(chunk.bytes))
            }
            (Some(total), false) => {
                begin_assembly::<S>(assembly, buffers, spare, &chunk, total, message_limit)?;
                return Ok(None);
            }
            (None, _) => return continue_assembly::<S>(assembly, &chunk),
        },
    }))
}

fn check_whole(chunk: &Chunk<'_>, total: u32, message_limit: usize) -> Result<(), CloseReason> {
    let length = total as usize;
    if length > message_limit {
        return Err(CloseReason::Oversize);
    }
    if length == chunk.bytes.len() { Ok(()) } else { Err(CloseReason::Protocol) }
}

fn begin_assembly<S: Storage>(
    assembly: &mut Option<Assembly<S>>,
    buffers: &mut impl Buffers<S>,
    spare: Option<Buffer<S>>,
    chunk: &Chunk<'_>,
    total: u32,
    message_limit: usize,
) -> Result<(), CloseReason> {
    // Without a spare buffer, another message is being put together already.
    let Some(mut buffer) = spare else { return Err(CloseReason::Protocol) };
    let total = total as usize;
    let refusal = if total > message_limit || total > buffer.len() {
        Some(CloseReason::Oversize)
    } else if chunk.bytes.len() >= total {
        Some(CloseReason::Protocol)
    } else {
        None
    };
    let length = chunk.bytes.len();
    if let (None, Some(place)) = (refusal, buffer.get_mut(..length)) {
        place.copy_from_slice(chunk.bytes);
        *assembly = Some(Assembly { buffer, length, total, priority: chunk.priority, done: false });
        return Ok(());
    }
    buffers.give(buffer);
    Err(refusal.unwrap_or(CloseReason::Protocol))
}

fn continue_assembly<S: Storage>(
    assembly: &mut Option<Assembly<S>>,
    chunk: &Chunk<'_>,
) -> Result<Option<Incoming>, CloseReason> {
    let assembly = assembly.as_mut().ok_or(CloseReason::Protocol)?;
    let end = assembly.length.saturating_add(chunk.bytes.len());
    if chunk.priority != assembly.priority || end > assembly.total || chunk.last != (end == assembly.total) {
        return Err(CloseReason::Protocol);
    }
    let place = assembly.buffer.get_mut(assembly.length..end).ok_or(CloseReason::Protocol)?;
    place.copy_from_slice(chunk.bytes);
    assembly.length = end;
    if !chunk.last {
        return Ok(None);
    }
    assembly.done = true;
    Ok(Some(Incoming::Message(assembly.priority, Place { store: Store::Assembly, start: 0, end })))
}

/// What waits to be written: one lane per class and the urgent frames that go between chunks.
///
/// Frames are sealed just before they are written, in the order in which they go out. On a link that keeps up, all that
/// waits is sealed and written in one go; on one that does not, one frame at a time, so that an emergency waits for one
/// chunk at most.
struct Sender<S: Storage> {
    cut: Cut,
    urgent: heapless::Vec<u8, URGENT_BYTES>,
    urgent_sealed: usize,
    lanes: [Option<Lane<S>>; 3],
    /// The lane whose frames were sealed last and are not all written, or whose message is not complete.
    current: Option<usize>,
    congested: bool,
}

struct Lane<S: Storage> {
    buffer: Buffer<S>,
    start: usize,
    sealed: usize,
    end: usize,
    /// The last sealed frame ended a message.
    at_boundary: bool,
}

/// Whether a step of writing went through, or the network took no more.
enum Progress {
    Through,
    Blocked,
}

impl<S: Storage> Sender<S> {
    fn new() -> Self {
        Self {
            cut: Cut { chunk: MINIMUM_CHUNK_BYTES, overhead: 0 },
            urgent: heapless::Vec::new(),
            urgent_sealed: 0,
            lanes: [const { None }; 3],
            current: None,
            congested: false,
        }
    }

    fn is_empty(&self) -> bool {
        self.urgent.is_empty() && self.lanes.iter().all(Option::is_none)
    }

    fn accept(
        &mut self,
        buffers: &mut impl Buffers<S>,
        priority: Priority,
        total: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        let Some(index) = lane_index(priority) else { return self.accept_emergency(total, write) };
        let framed = self.cut.framed_length(total);
        let slot = self.lanes.get_mut(index).ok_or(Error::Full(Limit::SendQueue))?;
        let lane = match slot {
            Some(lane) => lane,
            None => {
                let buffer = buffers.take().ok_or(Error::Full(Limit::Buffers))?;
                slot.insert(Lane { buffer, start: 0, sealed: 0, end: 0, at_boundary: true })
            }
        };
        let result = lane.append(self.cut, priority, total, framed, write);
        if lane.is_drained()
            && let Some(lane) = slot.take()
        {
            buffers.give(lane.buffer);
        }
        result
    }

    fn accept_emergency(&mut self, total: usize, write: impl FnOnce(&mut ChunkWriter<'_>)) -> Result<(), Error> {
        if total > EMERGENCY_BYTES {
            return Err(Error::TooLarge { limit: EMERGENCY_BYTES as u32 });
        }
        let start = self.urgent.len();
        let end = start.saturating_add(self.cut.framed_length(total));
        self.urgent.resize(end, 0).map_err(|_| Error::Full(Limit::SendQueue))?;
        let place = self.urgent.get_mut(start..end).unwrap_or(&mut []);
        let mut writer =
            ChunkWriter::new(place, self.cut, Priority::Emergency, total).ok_or(Error::Full(Limit::SendQueue))?;
        write(&mut writer);
        Ok(())
    }

    fn accept_frame(&mut self, frame: &Frame<'_>, overhead: usize) -> bool {
        let start = self.urgent.len();
        let mut scratch = [0; EMERGENCY_RESERVE];
        let length = frame::encode(frame, overhead, &mut scratch);
        if length == 0 || start.saturating_add(length) > URGENT_BYTES.saturating_sub(EMERGENCY_RESERVE) {
            return false;
        }
        self.urgent.extend_from_slice(scratch.get(..length).unwrap_or(&[])).is_ok()
    }

    fn flush<C: Secure>(
        &mut self,
        id: LinkId,
        cipher: &mut C,
        mailman: &mut impl Mailman,
        buffers: &mut impl Buffers<S>,
    ) -> Result<u64, CloseReason> {
        let mut written = 0;
        loop {
            if let Progress::Blocked = self.finish_sealed(id, mailman, &mut written)? {
                self.congested = true;
                return Ok(written);
            }
            self.give_drained(buffers);
            if !self.urgent.is_empty() {
                self.seal_urgent(cipher)?;
                continue;
            }
            let Some(index) = self.next_lane() else {
                self.congested = false;
                return Ok(written);
            };
            self.current = Some(index);
            if let Some(Some(lane)) = self.lanes.get_mut(index) {
                lane.seal(cipher, self.congested)?;
            }
        }
    }

    /// Writes what is sealed: the rest of the current lane's frames, then sealed urgent ones.
    fn finish_sealed(
        &mut self,
        id: LinkId,
        mailman: &mut impl Mailman,
        written: &mut u64,
    ) -> Result<Progress, CloseReason> {
        if let Some(Some(lane)) = self.current.and_then(|index| self.lanes.get_mut(index)) {
            while lane.start < lane.sealed {
                let piece = lane.buffer.get(lane.start..lane.sealed).unwrap_or(&[]);
                let count = mailman.write(id, &[piece])?;
                if count == 0 {
                    return Ok(Progress::Blocked);
                }
                lane.start = lane.start.saturating_add(count);
                *written = written.saturating_add(count as u64);
            }
        }
        while self.urgent_sealed > 0 {
            let piece = self.urgent.get(..self.urgent_sealed).unwrap_or(&[]);
            let count = mailman.write(id, &[piece])?;
            if count == 0 {
                return Ok(Progress::Blocked);
            }
            drop_front(&mut self.urgent, count);
            self.urgent_sealed = self.urgent_sealed.saturating_sub(count);
            *written = written.saturating_add(count as u64);
        }
        Ok(Progress::Through)
    }

    fn seal_urgent<C: Secure>(&mut self, cipher: &mut C) -> Result<(), CloseReason> {
        while self.urgent_sealed < self.urgent.len() {
            let rest = self.urgent.get_mut(self.urgent_sealed..).unwrap_or(&mut []);
            let length = seal_first(cipher, rest)?;
            self.urgent_sealed = self.urgent_sealed.saturating_add(length);
        }
        Ok(())
    }

    fn next_lane(&self) -> Option<usize> {
        let unfinished = self.current.filter(|&index| match self.lanes.get(index) {
            Some(Some(lane)) => !lane.at_boundary,
            _ => false,
        });
        unfinished.or_else(|| self.lanes.iter().position(Option::is_some))
    }

    fn give_drained(&mut self, buffers: &mut impl Buffers<S>) {
        for slot in &mut self.lanes {
            if slot.as_ref().is_some_and(Lane::is_drained)
                && let Some(lane) = slot.take()
            {
                buffers.give(lane.buffer);
            }
        }
    }

    fn release(&mut self, buffers: &mut impl Buffers<S>) {
        for lane in self.lanes.iter_mut().filter_map(Option::take) {
            buffers.give(lane.buffer);
        }
        self.urgent.clear();
        self.urgent_sealed = 0;
    }
}

impl<S: Storage> Lane<S> {
    fn is_drained(&self) -> bool {
        self.start >= self.end
    }

    /// Bytes that still fit, counting those that moving the rest to the front would free.
    fn room(&self) -> usize {
        self.buffer.len().saturating_sub(self.end.saturating_sub(self.start))
    }

    fn append(
        &mut self,
        cut: Cut,
        priority: Priority,
        total: usize,
        framed: usize,
        write: impl FnOnce(&mut ChunkWriter<'_>),
    ) -> Result<(), Error> {
        if framed > self.room() {
            return Err(Error::Full(Limit::SendQueue));
        }
        if framed > self.buffer.len().saturating_sub(self.end) {
            self.buffer.copy_within(self.start..self.end, 0);
            self.end = self.end.saturating_sub(self.start);
            self.sealed = self.sealed.saturating_sub(self.start);
            self.start = 0;
        }
        let end = self.end.saturating_add(framed);
        let place = self.buffer.get_mut(self.end..end).unwrap_or(&mut []);
        let mut writer = ChunkWriter::new(place, cut, priority, total).ok_or(Error::Full(Limit::SendQueue))?;
        write(&mut writer);
        self.end = end;
        Ok(())
    }

    /// Seals the next frame, or all of them on a link that keeps up.
    fn seal<C: Secure>(&mut self, cipher: &mut C, one: bool) -> Result<(), CloseReason> {
        while self.sealed < self.end {
            let rest = self.buffer.get_mut(self.sealed..self.end).unwrap_or(&mut []);
            self.at_boundary = frame::ends_message(rest);
            let length = seal_first(cipher, rest)?;
            self.sealed = self.sealed.saturating_add(length);
            if one {
                break;
            }
        }
        Ok(())
    }
}

fn seal_first<C: Secure>(cipher: &mut C, frames: &mut [u8]) -> Result<usize, CloseReason> {
    let length = frame::first_frame_length(frames).ok_or(CloseReason::Protocol)?;
    let body = frames.get_mut(frame::HEADER_BYTES..length).ok_or(CloseReason::Protocol)?;
    cipher.seal(body)?;
    Ok(length)
}

const fn lane_index(priority: Priority) -> Option<usize> {
    match priority {
        Priority::Emergency => None,
        Priority::High => Some(0),
        Priority::Normal => Some(1),
        Priority::Low => Some(2),
    }
}

fn drop_front(bytes: &mut heapless::Vec<u8, URGENT_BYTES>, count: usize) {
    let count = count.min(bytes.len());
    let kept = bytes.len().saturating_sub(count);
    bytes.copy_within(count.., 0);
    bytes.truncate(kept);
}

/// Whether the peer is still there: any frame renews it, and each keep-alive period without one is counted.
///
/// At most one keep-alive counts as missed per poll, so that a suspended host or a jumped clock ends nothing by itself.
#[derive(Debug)]
pub struct Liveness {
    period: Duration,
    next_check: Instant,
    missed: u8,
    /// Session datagrams of the peer arrive: their absence is the faster signal.
    datagrams_pass: bool,
}

impl Liveness {
    /// A peer that was heard just now and sends a keep-alive every `period`.
    pub fn new(now: Instant, period: Duration) -> Self {
        let period = period.max(Duration::from_millis(1));
        Self { period, next_check: now + period + period.divided_by(2), missed: 0, datagrams_pass: false }
    }

    /// Something arrived in the stream.
    pub fn heard(&mut self, now: Instant) {
        self.missed = 0;
        self.next_check = now + self.period + self.period.divided_by(2);
    }

    /// A datagram of the session arrived.
    pub fn heard_datagram(&mut self, now: Instant) {
        self.datagrams_pass = true;
        self.heard(now);
    }

    /// Whether datagrams of the peer have come through.
    pub const fn datagrams_pass(&self) -> bool {
        self.datagrams_pass
    }

    /// When to look again.
    pub const fn deadline(&self) -> Instant {
        self.next_check
    }

    /// Counts one missed keep-alive if its time has come; returns (missed now, lost).
    pub fn poll(&mut self, now: Instant) -> (bool, bool) {
        if now < self.next_check {
            return (false, false);
        }
        self.missed = self.missed.saturating_add(1);
        self.next_check = now + self.period;
        (true, self.missed >= self.allowed())
    }

    fn allowed(&self) -> u8 {
        if self.datagrams_pass {
            return MISSED_KEEP_ALIVES;
        }
        let periods = TCP_ONLY_LOSS.as_micros().checked_div(self.period.as_micros()).unwrap_or(8);
        u8::try_from(periods).unwrap_or(u8::MAX).max(MISSED_KEEP_ALIVES)
    }
}
