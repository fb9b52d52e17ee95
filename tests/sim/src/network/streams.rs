//! Streams between hosts, as TCP shows them to a program.
//!
//! Bytes arrive in order or not at all. A lost segment is sent again after 200 ms, then after twice as long, and what
//! was written behind it waits. There is no congestion control and no fast retransmission: with single losses real
//! TCP is faster, in outages it is the same. Headers cost no bandwidth.

use std::net::{SocketAddr, SocketAddrV4};

use cara_core::time::Duration;

use super::{Happening, Network};
use crate::event::{HostId, NetEvent, StreamId, Trace};
use crate::faults::Fault;
use crate::pipe::{End as PipeEnd, Pipe};

/// A split read's remainder shows up this much later at most.
const SPLIT_PAUSE: Duration = Duration::from_micros(200);

/// The stream is gone: it was reset, closed here, or its host crashed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Broken;

impl std::fmt::Display for Broken {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("the stream is gone: it was reset, closed here, or its host crashed")
    }
}

impl std::error::Error for Broken {}

/// One end of a stream with the bytes that it writes.
#[derive(Debug)]
pub(super) struct End {
    pub(super) state: State,
    /// Means nothing while `state` is `Unborn`.
    pub(super) host: HostId,
    pub(super) local: SocketAddrV4,
    pub(super) outgoing: Pipe,
    /// All that was ever written.
    pub(super) sent: Trace,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// The accepting end before the dial has arrived.
    Unborn,
    Dialling,
    Open,
    /// Closed here; what was written still leaves.
    Closing,
    Gone,
}

impl Network {
    /// Dials; [`NetEvent::Connected`] or [`NetEvent::Refused`] follows.
    pub fn connect(&mut self, host: HostId, to: SocketAddr) -> StreamId {
        let stream = StreamId(self.ends.len() as u32);
        let to = match to {
            SocketAddr::V4(to) => to,
            SocketAddr::V6(_) => SocketAddrV4::new(std::net::Ipv4Addr::UNSPECIFIED, 0),
        };
        let dialler = self.host_mut(host);
        dialler.dial_port = dialler.dial_port.checked_add(1).unwrap_or(super::hosts::FIRST_DIAL_PORT);
        dialler.streams.push(stream);
        let local = SocketAddrV4::new(dialler.address, dialler.dial_port);
        self.ends.push(End { state: State::Dialling, host, local, outgoing: Pipe::new(), sent: Trace::new() });
        self.ends.push(End { state: State::Unborn, host, local: to, outgoing: Pipe::new(), sent: Trace::new() });
        self.dial(stream, 0);
        stream
    }

    /// Whether the end is open: connected, and neither closed here nor reset.
    pub fn is_open(&self, stream: StreamId) -> bool {
        self.end(stream).state == State::Open
    }

    /// Addresses of this end and of the other one.
    pub fn addresses(&self, stream: StreamId) -> (SocketAddr, SocketAddr) {
        (self.end(stream).local.into(), self.end(stream.peer()).local.into())
    }

    /// Writes what fits into the send buffer; returns how many bytes were taken in all. After a short write
    /// [`NetEvent::Writable`] follows when half of the buffer is free.
    pub fn write(&mut self, stream: StreamId, slices: &[&[u8]]) -> Result<usize, Broken> {
        let End { state, host, .. } = *self.end(stream);
        match state {
            State::Open => (),
            State::Dialling => {
                self.end_mut(stream).outgoing.wants_room = true;
                return Ok(0);
            }
            State::Unborn | State::Closing | State::Gone => return Err(Broken),
        }
        let capacity = self.host(host).send_buffer;
        let taken = self.end_mut(stream).outgoing.write(slices, capacity);
        self.trace_written(stream, slices, taken);
        self.transmit(stream);
        Ok(taken)
    }

    fn trace_written(&mut self, stream: StreamId, slices: &[&[u8]], mut taken: usize) {
        let sent = &mut self.end_mut(stream).sent;
        for slice in slices {
            let part = taken.min(slice.len());
            sent.note(&slice[..part]);
            taken -= part;
        }
    }

    /// Bytes written that have not left yet.
    pub fn unsent(&self, stream: StreamId) -> usize {
        self.end(stream).outgoing.unsent()
    }

    /// Lends what has arrived (or with split reads a prefix of it) to `reader`, which returns how many bytes it
    /// consumed; the rest is lent again with the next read. Returns what was consumed; 0 when nothing is there.
    ///
    /// [`NetEvent::Readable`] comes again when more arrives or a split read's rest shows up, not for bytes that were
    /// lent and left.
    pub fn read(&mut self, stream: StreamId, reader: impl FnOnce(&mut [u8]) -> usize) -> usize {
        if self.end(stream).state != State::Open {
            return 0;
        }
        let kept_back = self.split(stream);
        let pipe = &mut self.end_mut(stream.peer()).outgoing;
        if pipe.readable() == kept_back {
            return 0;
        }
        let consumed = pipe.read(kept_back, reader);
        if kept_back > 0 {
            let at = self.now + self.random_below(SPLIT_PAUSE);
            self.push(at, Happening::Remainder(stream));
        }
        if consumed > 0 {
            self.open_window(stream);
        }
        self.announce_closed(stream);
        consumed
    }

    /// Bytes that have arrived and were not consumed.
    pub fn readable(&self, stream: StreamId) -> usize {
        self.end(stream.peer()).outgoing.readable()
    }

    /// Closes in an orderly way: what was written still arrives, then the other end sees [`NetEvent::Closed`].
    pub fn close(&mut self, stream: StreamId) {
        match self.end(stream).state {
            State::Open => {
                let end = self.end_mut(stream);
                end.state = State::Closing;
                end.outgoing.end = PipeEnd::Wanted;
                self.forget_events(stream);
                self.transmit(stream);
                self.bury_if_finished(stream);
            }
            State::Dialling => self.bury(stream),
            State::Unborn | State::Closing | State::Gone => (),
        }
    }

    /// Ends the stream at once; what was not sent is lost, and the other end sees [`NetEvent::Reset`].
    pub fn reset(&mut self, stream: StreamId) {
        if matches!(self.end(stream).state, State::Open | State::Closing | State::Dialling) {
            self.bury(stream);
            self.send_reset(stream);
        }
    }

    // --- telling

    pub(super) fn announce_readable(&mut self, stream: StreamId) {
        let End { state, host, .. } = *self.end(stream);
        let event = NetEvent::Readable { host, stream };
        if state == State::Open && !self.ready.contains(&event) {
            self.ready.push_back(event);
        }
    }

    pub(super) fn announce_closed(&mut self, reader: StreamId) {
        let host = self.end(reader).host;
        let pipe = &mut self.end_mut(reader.peer()).outgoing;
        if pipe.end == PipeEnd::Arrived && pipe.unseen() == 0 {
            pipe.end = PipeEnd::Report;
            self.ready.push_back(NetEvent::Closed { host, stream: reader });
        }
    }

    pub(super) fn announce_room(&mut self, writer: StreamId) {
        let half = self.host(self.end(writer).host).send_buffer / 2;
        if self.end(writer).outgoing.unsent() <= half {
            self.announce_writable(writer);
        }
    }

    pub(super) fn announce_writable(&mut self, writer: StreamId) {
        let end = self.end_mut(writer);
        if end.state == State::Open && end.outgoing.wants_room {
            end.outgoing.wants_room = false;
            let host = end.host;
            self.ready.push_back(NetEvent::Writable { host, stream: writer });
        }
    }

    // --- ends

    /// The host that writes at this end and the host that reads it.
    pub(super) fn link_of(&self, writer: StreamId) -> (HostId, HostId) {
        (self.end(writer).host, self.end(writer.peer()).host)
    }

    /// How many of the readable bytes a split read keeps back.
    fn split(&mut self, stream: StreamId) -> usize {
        let pipe = &self.end(stream.peer()).outgoing;
        let unseen = pipe.unseen();
        if unseen < 2 || !self.split_reads.hits(&mut self.random) {
            return 0;
        }
        self.counts.count(Fault::SplitRead);
        1 + self.random.below(unseen as u64 - 1) as usize
    }

    pub(super) fn end(&self, stream: StreamId) -> &End {
        &self.ends[stream.index()]
    }

    pub(super) fn end_mut(&mut self, stream: StreamId) -> &mut End {
        &mut self.ends[stream.index()]
    }

    pub(super) fn is_at_its_address(&self, stream: StreamId) -> bool {
        let end = self.end(stream);
        self.host(end.host).address == *end.local.ip()
    }

    /// Whether something small on a stream's way is lost now.
    pub(super) fn loses(&mut self, from: HostId, to: HostId) -> bool {
        self.is_cut(from, to) || self.path(from, to).loss.hits(&mut self.random)
    }

    /// The end is no more: its host hears nothing of it, what was not sent is lost.
    pub(super) fn bury(&mut self, stream: StreamId) {
        let end = self.end_mut(stream);
        end.state = State::Gone;
        end.outgoing.drop_unsent();
        let host = end.host;
        self.host_mut(host).streams.retain(|other| *other != stream);
        self.forget_events(stream);
        if matches!(self.end(stream.peer()).state, State::Gone) {
            self.end_mut(stream).outgoing.drop_all();
            self.end_mut(stream.peer()).outgoing.drop_all();
        }
    }

    /// Both ends have closed, and both know it of the other.
    pub(super) fn bury_if_finished(&mut self, stream: StreamId) {
        let finished = |end: &End| end.state == State::Closing && end.outgoing.end >= PipeEnd::Arrived;
        if finished(self.end(stream)) && finished(self.end(stream.peer())) {
            self.bury(stream);
            self.bury(stream.peer());
        }
    }

    pub(super) fn forget_events(&mut self, gone: StreamId) {
        self.ready.retain(|event| match event {
            NetEvent::Readable { stream, .. }
            | NetEvent::Writable { stream, .. }
            | NetEvent::Closed { stream, .. }
            | NetEvent::Connected { stream, .. }
            | NetEvent::Accepted { stream, .. } => *stream != gone,
            _ => true,
        });
    }
}
