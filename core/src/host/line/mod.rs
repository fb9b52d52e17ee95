//! A point-to-point serial line without an IP stack: one stream and datagrams over a wire that loses and damages bytes.
//!
//! A [`Line`] is one end. It takes what the wire brought and gives what the wire is to carry; it reads no clock, so that a
//! port polls it as it polls a session. It does not encrypt, and does not address: both are the business of what runs on
//! it. A bus with more than two stations is out of its scope. `frame.rs` has the format of frames.
//!
//! # What a port does
//! - Lend what has come to [`receive`](Line::receive) until all of it is consumed, and take a datagram after each call.
//! - Whenever the wire is free, send what [`transmit`](Line::transmit) gives. Ask for a frame only when the one before is
//!   out: what lies in a queue below is not overtaken by an emergency.
//! - Call `transmit` also at the [`deadline`](Line::deadline), if the wire is free then, and after anything else was done to
//!   the line.
//! - When [`state`](Line::state) is [`State::Offered`], [`accept`](Line::accept) or [`close`](Line::close); when it is
//!   [`State::Ended`], read the rest with [`peek`](Line::peek) and [`take`](Line::take), and close.
//!
//! ```
//! use cara_core::config::LINE_FRAME_BYTES;
//! use cara_core::host::line::{Line, State};
//! use cara_core::time::Instant;
//!
//! let (mut near, mut far) = (Line::new(115_200, 1), Line::new(115_200, 2));
//! let (now, mut buffer) = (Instant::START, [0; LINE_FRAME_BYTES]);
//! assert!(near.dial(7));
//! far.receive(near.transmit(now, &mut buffer), now);
//! assert_eq!(far.state(), State::Offered(7));
//! assert!(far.accept());
//! near.receive(far.transmit(now, &mut buffer), now);
//! assert_eq!(near.write(b"hello"), 5);
//! far.receive(near.transmit(now, &mut buffer), now);
//! assert_eq!(far.peek(), b"hello");
//! ```

mod datagrams;
mod frame;
mod stream;
#[cfg(test)]
mod tests;

pub use datagrams::Datagram;

use self::datagrams::Datagrams;
use self::frame::{Kind, Reader};
use self::stream::Stream;
use crate::config::LINE_FRAME_BYTES;
use crate::error::CloseReason;
use crate::time::Instant;

/// Frames of datagrams in a row, behind which one of the stream goes, so that a flood of them does not stop it.
const DATAGRAMS_IN_A_ROW: u8 = 4;

/// What the stream of a line is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Nothing. It can be dialled.
    Idle,
    /// The other end has dialled this port.
    Offered(u16),
    /// It is dialled.
    Dialing,
    /// It carries bytes.
    Open,
    /// What was written before it was closed is still sent.
    Closing,
    /// It has ended: [`DialFailed`](CloseReason::DialFailed), [`Reset`](CloseReason::Reset) by the other end, or
    /// [`Silent`](CloseReason::Silent), since nothing was heard for [`LINE_LOST`](crate::config::LINE_LOST).
    Ended(CloseReason),
}

/// What has happened on a line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames that were damaged.
    pub bad: u32,
    /// Frames of the stream that were sent again.
    pub retransmitted: u32,
    /// Datagrams that were too long, gave way to newer ones, or did not come whole.
    pub dropped: u32,
}

/// One end of a serial line. It has about 4 KiB of buffers.
pub struct Line {
    reader: Reader,
    datagrams: Datagrams,
    stream: Stream,
    counters: Counters,
    /// Frames of datagrams that were sent in a row.
    row: u8,
}

impl Line {
    /// An end of an idle line of that rate. `seed` should differ from boot to boot: the numbers of links come from it.
    pub fn new(bits_per_second: u32, seed: u64) -> Self {
        Self {
            reader: Reader::new(),
            datagrams: Datagrams::new(),
            stream: Stream::new(bits_per_second, seed),
            counters: Counters::default(),
            row: 0,
        }
    }

    /// Takes bytes that have come, up to the end of the next datagram; returns how many. A datagram that has not been taken
    /// with [`next_datagram`](Self::next_datagram) before is dropped when the next one comes.
    pub fn receive(&mut self, bytes: &[u8], now: Instant) -> usize {
        for (before, byte) in bytes.iter().enumerate() {
            match self.reader.push(*byte) {
                None => continue,
                Some(None) => self.counters.bad = self.counters.bad.saturating_add(1),
                Some(Some(frame)) if frame.kind == Kind::Datagram => {
                    let is_lost = !self.datagrams.receive(&frame);
                    self.count_dropped(is_lost);
                    if self.datagrams.has_arrived() {
                        return before.saturating_add(1);
                    }
                }
                Some(Some(frame)) => self.stream.receive(&frame, now),
            }
        }
        bytes.len()
    }

    /// Does what is due, and writes the next frame into `out`; nothing if there is none. To be called when the frame before
    /// has been sent.
    pub fn transmit<'o>(&mut self, now: Instant, out: &'o mut [u8; LINE_FRAME_BYTES]) -> &'o [u8] {
        if self.row < DATAGRAMS_IN_A_ROW
            && let Some(frame) = self.datagrams.next_frame()
        {
            self.row = self.row.saturating_add(1);
            return frame.encode(out);
        }
        self.row = 0;
        if let Some(frame) = self.stream.next_frame(now, &mut self.counters) {
            return frame.encode(out);
        }
        self.datagrams.next_frame().map_or(&[], |frame| frame.encode(out))
    }

    /// When [`transmit`](Self::transmit) has something to do without anything new.
    pub fn deadline(&self) -> Instant {
        self.stream.deadline()
    }

    /// What the stream is doing.
    pub fn state(&self) -> State {
        self.stream.state()
    }

    /// Dials `port` of the other end; `false` unless the stream is idle.
    pub fn dial(&mut self, port: u16) -> bool {
        self.stream.dial(port)
    }

    /// Takes the stream that is offered; `false` if none is.
    pub fn accept(&mut self) -> bool {
        self.stream.accept()
    }

    /// Ends the stream behind what was written, or refuses that which is offered. What has come is discarded.
    pub fn close(&mut self, now: Instant) {
        self.stream.close(now);
    }

    /// Ends the stream now.
    pub fn abort(&mut self) {
        self.stream.abort();
    }

    /// How many bytes [`write`](Self::write) would take.
    pub fn capacity(&self) -> usize {
        self.stream.capacity()
    }

    /// Writes to the stream; returns how many bytes it took, 0 unless it is open.
    pub fn write(&mut self, bytes: &[u8]) -> usize {
        self.stream.write(bytes)
    }

    /// Bytes of the stream that have come.
    pub fn peek(&mut self) -> &mut [u8] {
        self.stream.peek()
    }

    /// Drops the first `count` of them.
    pub fn take(&mut self, count: usize) {
        self.stream.take(count);
    }

    /// Sends a datagram before the stream, and before datagrams that still wait. `to` is 0 for all units. `false` if it is
    /// longer than [`LINE_DATAGRAM_BYTES`](crate::config::LINE_DATAGRAM_BYTES).
    pub fn send_datagram(&mut self, to: u16, from: u16, bytes: &[u8]) -> bool {
        let fits = bytes.len() <= crate::config::LINE_DATAGRAM_BYTES;
        let is_lost = !self.datagrams.send(to, from, bytes);
        self.count_dropped(is_lost);
        fits
    }

    /// Whether a datagram has come and was not taken.
    pub const fn has_datagram(&self) -> bool {
        self.datagrams.has_arrived()
    }

    /// The datagram that has come.
    pub fn next_datagram(&mut self) -> Option<Datagram<'_>> {
        self.datagrams.take()
    }

    /// What has happened since the start.
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    fn count_dropped(&mut self, is_lost: bool) {
        self.counters.dropped = self.counters.dropped.saturating_add(u32::from(is_lost));
    }
}
