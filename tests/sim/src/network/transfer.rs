//! A stream's bytes on their way: segments leave, are lost or arrive, strays are answered.

use super::streams::{End, State};
use super::{Happening, Network};
use crate::event::{NetEvent, StreamId};
use crate::faults::Fault;
use crate::pipe::{End as PipeEnd, FIRST_RETRANSMISSION, LONGEST_RETRANSMISSION, Transmitter};

/// Bytes of one segment, as on Ethernet.
const SEGMENT: usize = 1460;
/// Losses of one segment in a row after which the stream counts as reset: after a quarter of an hour.
const RETRANSMISSIONS: u32 = 15;

impl Network {
    /// Sends as much as bandwidth, window and retransmission allow now.
    pub(super) fn transmit(&mut self, writer: StreamId) {
        while self.end(writer).outgoing.transmitter == Transmitter::Idle {
            let (from, to) = (self.end(writer).host, self.end(writer.peer()).host);
            let window = self.host(to).receive_window;
            let pipe = &mut self.end_mut(writer).outgoing;
            let unsent = pipe.unsent();
            let length = unsent.min(window.saturating_sub(pipe.outstanding()));
            let ends = unsent == 0 && pipe.end == PipeEnd::Wanted;
            if length == 0 && unsent > 0 {
                pipe.transmitter = Transmitter::WindowClosed;
                return;
            }
            if length == 0 && !ends && !pipe.unacknowledged {
                return;
            }
            let path = self.path(from, to);
            // Without a limit everything leaves in one train; otherwise the path is shared segment by segment.
            let length = if path.bytes_per_second == 0 { length } else { length.min(SEGMENT) };
            if path.bytes_per_second == 0 {
                self.depart(writer, length);
            } else {
                self.end_mut(writer).outgoing.transmitter = Transmitter::Sending { length };
                let at = self.leave(from, to, path, length);
                self.push(at, Happening::Step(writer));
            }
        }
    }

    pub(super) fn step(&mut self, writer: StreamId) {
        if !matches!(self.end(writer).state, State::Open | State::Closing) {
            return;
        }
        match self.end(writer).outgoing.transmitter {
            Transmitter::Sending { length } => {
                self.end_mut(writer).outgoing.transmitter = Transmitter::Idle;
                self.depart(writer, length);
            }
            Transmitter::BackingOff => self.end_mut(writer).outgoing.transmitter = Transmitter::Idle,
            Transmitter::Idle | Transmitter::WindowClosed => return,
        }
        self.transmit(writer);
    }

    /// The last of `length` bytes leaves now: they arrive, or a part is lost and its stream backs off.
    fn depart(&mut self, writer: StreamId, length: usize) {
        let (from, to) = (self.end(writer).host, self.end(writer.peer()).host);
        let passed = self.passing(writer, length);
        if passed == Some(length) || passed.is_some_and(|bytes| bytes > 0) {
            let at = self.arrival(self.now, self.path(from, to));
            let pipe = &mut self.end_mut(writer).outgoing;
            pipe.unacknowledged = false;
            let up_to = pipe.send(passed.unwrap_or(0));
            let end = pipe.unsent() == 0 && pipe.end == PipeEnd::Wanted;
            if end {
                pipe.end = PipeEnd::Sent;
            }
            let at = at.max(pipe.last_arrival);
            pipe.last_arrival = at;
            self.push(at, Happening::Arrive { writer, up_to, end });
        }
        if passed != Some(length) {
            self.back_off(writer);
        }
        self.announce_room(writer);
    }

    /// How many of `length` bytes pass before the first lost segment; `None` when the very first one is lost.
    fn passing(&mut self, writer: StreamId, length: usize) -> Option<usize> {
        let (from, to) = (self.end(writer).host, self.end(writer.peer()).host);
        let reaches = self.host(to).power
            && self.is_at_its_address(writer)
            && self.is_at_its_address(writer.peer())
            && !self.is_cut(from, to);
        if !reaches {
            return None;
        }
        let loss = self.path(from, to).loss;
        let segments = length.div_ceil(SEGMENT).max(1);
        let first_lost = (0..segments).find(|_| loss.hits(&mut self.random));
        match first_lost {
            None => Some(length),
            Some(0) => None,
            Some(segment) => Some(segment * SEGMENT),
        }
    }

    fn back_off(&mut self, writer: StreamId) {
        self.counts.count(Fault::Retransmission);
        let now = self.now;
        let pipe = &mut self.end_mut(writer).outgoing;
        let at = now + pipe.retransmission;
        pipe.retransmission = pipe.retransmission.times(2).min(LONGEST_RETRANSMISSION);
        pipe.transmitter = Transmitter::BackingOff;
        pipe.lost_in_a_row += 1;
        if pipe.lost_in_a_row > RETRANSMISSIONS {
            return self.reset_arrives(writer);
        }
        self.push(at, Happening::Step(writer));
    }

    /// The reader's news of room takes the way back; where that is cut, the writer asks again and again.
    pub(super) fn open_window(&mut self, reader: StreamId) {
        if self.end(reader.peer()).outgoing.transmitter != Transmitter::WindowClosed {
            return;
        }
        let at = self.now + self.path(self.end(reader).host, self.end(reader.peer()).host).delay;
        self.push(at, Happening::WindowOpens(reader.peer()));
    }

    pub(super) fn window_opens(&mut self, writer: StreamId) {
        let (from, to) = (self.end(writer).host, self.end(writer.peer()).host);
        let alive = matches!(self.end(writer).state, State::Open | State::Closing);
        if !alive || self.end(writer).outgoing.transmitter != Transmitter::WindowClosed {
            return;
        }
        if self.is_cut(to, from) || !self.is_at_its_address(writer) {
            let at = self.now + FIRST_RETRANSMISSION;
            return self.push(at, Happening::WindowOpens(writer));
        }
        self.end_mut(writer).outgoing.transmitter = Transmitter::Idle;
        self.transmit(writer);
    }

    // --- arriving

    pub(super) fn arrive(&mut self, writer: StreamId, up_to: u64, end: bool) {
        let reader = writer.peer();
        // Bytes of the other end answer a dial as well as the answer itself does.
        self.dial_answered_by_bytes(reader);
        let End { state, host, .. } = *self.end(reader);
        if state == State::Open {
            let pipe = &mut self.end_mut(writer).outgoing;
            pipe.arrive(up_to);
            if end {
                pipe.end = PipeEnd::Arrived;
            }
            if pipe.unseen() > 0 {
                self.announce_readable(reader);
            }
            return self.announce_closed(reader);
        }
        if self.host(host).power {
            return self.stray_arrives(reader, end);
        }
        self.probe_later(writer);
    }

    fn dial_answered_by_bytes(&mut self, reader: StreamId) {
        if self.end(reader).state == State::Dialling {
            self.dial_answered(reader);
        }
    }

    /// A segment for a stream that no longer exists reached its host.
    fn stray_arrives(&mut self, reader: StreamId, end: bool) {
        let closing = self.end(reader).state == State::Closing;
        if closing && end {
            self.end_mut(reader.peer()).outgoing.end = PipeEnd::Report;
            return self.bury_if_finished(reader);
        }
        if closing {
            self.bury(reader);
        }
        if self.host(self.end(reader).host).answers_strays {
            self.send_reset(reader);
        }
    }

    /// The machine was off when the bytes came: the writer goes on asking.
    fn probe_later(&mut self, writer: StreamId) {
        let pipe = &mut self.end_mut(writer).outgoing;
        pipe.unacknowledged = true;
        if pipe.transmitter == Transmitter::Idle && matches!(self.end(writer).state, State::Open | State::Closing) {
            self.back_off(writer);
        }
    }

    pub(super) fn send_reset(&mut self, from: StreamId) {
        let (host, to) = (self.end(from).host, self.end(from.peer()).host);
        if self.end(from.peer()).state == State::Unborn || self.loses(host, to) || !self.is_at_its_address(from) {
            return;
        }
        let at = self.arrival(self.now, self.path(host, to));
        self.push(at, Happening::ResetArrives { end: from.peer() });
    }

    pub(super) fn reset_arrives(&mut self, stream: StreamId) {
        let End { state, host, .. } = *self.end(stream);
        if !matches!(state, State::Open | State::Dialling | State::Closing) {
            return;
        }
        self.bury(stream);
        if state != State::Closing {
            self.ready.push_back(NetEvent::Reset { host, stream });
        }
    }
}
