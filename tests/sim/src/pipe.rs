//! The bytes of one direction of a stream: read, arrived, in flight or unsent, in one buffer and never moved between.

use cara_core::time::{Duration, Instant};

/// First wait before a lost segment is sent again; doubles up to [`LONGEST_RETRANSMISSION`].
pub(crate) const FIRST_RETRANSMISSION: Duration = Duration::from_millis(200);
pub(crate) const LONGEST_RETRANSMISSION: Duration = Duration::from_secs(120);

/// What the sending side is doing. All but `Idle` have exactly one step in the queue, except `WindowClosed`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Transmitter {
    /// Nothing to send.
    Idle,
    /// A segment is leaving at the path's bandwidth.
    Sending { length: usize },
    /// The last segment was lost; waits to send it again.
    BackingOff,
    /// The reader has no room.
    WindowClosed,
}

/// How far the end of the stream has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum End {
    /// The writer may write more.
    Open,
    /// The writer has closed; the end follows its bytes.
    Wanted,
    /// The end is in flight.
    Sent,
    /// The end has arrived, perhaps before the bytes were read.
    Arrived,
    /// The reader was told.
    Report,
}

/// One direction of a stream. Offsets count from the stream's first byte: read ≤ lent ≤ arrived ≤ sent ≤ written.
#[derive(Debug)]
pub(crate) struct Pipe {
    bytes: Vec<u8>,
    /// Where `read` lies in `bytes`.
    start: usize,
    read: u64,
    lent: u64,
    arrived: u64,
    sent: u64,
    pub(crate) end: End,
    pub(crate) transmitter: Transmitter,
    pub(crate) retransmission: Duration,
    /// How often the segment that is due next was lost.
    pub(crate) lost_in_a_row: u32,
    /// Nothing of this stream arrives before it.
    pub(crate) last_arrival: Instant,
    /// A write was short, so that the writer waits for room.
    pub(crate) wants_room: bool,
    /// Bytes were sent to a host that was down, so that a probe must find out what became of it.
    pub(crate) unacknowledged: bool,
}

impl Pipe {
    pub(crate) fn new() -> Self {
        Self {
            bytes: Vec::new(),
            start: 0,
            read: 0,
            lent: 0,
            arrived: 0,
            sent: 0,
            end: End::Open,
            transmitter: Transmitter::Idle,
            retransmission: FIRST_RETRANSMISSION,
            lost_in_a_row: 0,
            last_arrival: Instant::START,
            wants_room: false,
            unacknowledged: false,
        }
    }

    /// Takes what fits into a send buffer of `capacity` bytes; returns how many bytes that was.
    pub(crate) fn write(&mut self, slices: &[&[u8]], capacity: usize) -> usize {
        let mut taken = 0;
        for slice in slices {
            let room = capacity.saturating_sub(self.unsent()).min(slice.len());
            self.bytes.extend_from_slice(&slice[..room]);
            taken += room;
            if room < slice.len() {
                self.wants_room = true;
                break;
            }
        }
        taken
    }

    pub(crate) fn unsent(&self) -> usize {
        self.bytes.len() - self.start - (self.sent - self.read) as usize
    }

    /// Bytes that were sent and not read yet: what fills the reader's window.
    pub(crate) fn outstanding(&self) -> usize {
        (self.sent - self.read) as usize
    }

    /// The next `length` bytes leave; returns the offset behind them.
    pub(crate) fn send(&mut self, length: usize) -> u64 {
        self.sent += length as u64;
        self.retransmission = FIRST_RETRANSMISSION;
        self.lost_in_a_row = 0;
        self.sent
    }

    /// All bytes before the offset `up_to` have arrived.
    pub(crate) fn arrive(&mut self, up_to: u64) {
        self.arrived = self.arrived.max(up_to);
    }

    pub(crate) fn readable(&self) -> usize {
        (self.arrived - self.read) as usize
    }

    /// Bytes that arrived and that no reader has seen.
    pub(crate) fn unseen(&self) -> usize {
        (self.arrived - self.lent) as usize
    }

    /// Lends all readable bytes but the last `kept_back` to `reader`, which says how many it consumed.
    pub(crate) fn read(&mut self, kept_back: usize, reader: impl FnOnce(&mut [u8]) -> usize) -> usize {
        let lent = self.readable() - kept_back;
        let consumed = reader(&mut self.bytes[self.start..self.start + lent]).min(lent);
        self.lent = self.lent.max(self.read + lent as u64);
        self.read += consumed as u64;
        self.start += consumed;
        self.compact();
        consumed
    }

    /// Forgets what is not in flight: the writer is gone.
    pub(crate) fn drop_unsent(&mut self) {
        let unsent = self.unsent();
        self.bytes.truncate(self.bytes.len() - unsent);
        self.transmitter = Transmitter::Idle;
    }

    /// Frees the memory: the reader is gone.
    pub(crate) fn drop_all(&mut self) {
        *self = Self { end: End::Report, ..Self::new() };
    }

    fn compact(&mut self) {
        if self.start == self.bytes.len() {
            self.bytes.clear();
            self.start = 0;
        } else if self.start > self.bytes.len() / 2 {
            self.bytes.drain(..self.start);
            self.start = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_pass_in_order_through_every_stage() {
        let mut pipe = Pipe::new();
        assert_eq!(pipe.write(&[b"abc", b"def"], 5), 5);
        assert!(pipe.wants_room);
        let first = pipe.send(2);
        assert_eq!((pipe.unsent(), pipe.outstanding(), pipe.readable()), (3, 2, 0));
        pipe.arrive(first);
        assert_eq!(
            pipe.read(1, |bytes| {
                assert_eq!(bytes, b"a");
                1
            }),
            1
        );
        assert_eq!(pipe.unseen(), 1);
        let rest = pipe.send(3);
        pipe.arrive(rest);
        assert_eq!(
            pipe.read(0, |bytes| {
                assert_eq!(bytes, b"bcde");
                9
            }),
            4
        );
        assert_eq!((pipe.readable(), pipe.outstanding(), pipe.unsent()), (0, 0, 0));
    }

    #[test]
    fn what_is_in_flight_survives_the_writer() {
        let mut pipe = Pipe::new();
        pipe.write(&[b"abcdef"], 100);
        let flight = pipe.send(4);
        pipe.drop_unsent();
        pipe.arrive(flight);
        assert_eq!(
            pipe.read(0, |bytes| {
                assert_eq!(bytes, b"abcd");
                4
            }),
            4
        );
    }
}
