//! Datagrams of a serial line, which pass its stream. The newest goes first, so that an emergency waits for no keep-alive.

use super::frame::{Frame, Kind, PAYLOAD_BYTES};
use crate::bytes::copy;
use crate::config::LINE_DATAGRAM_BYTES;

/// Both ports, in front of a datagram.
const PORT_BYTES: usize = 4;
/// Datagrams that wait to be sent; one more takes the place of the oldest.
const WAITING: usize = 3;

/// A datagram that has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Datagram<'b> {
    /// The port that it is for; 0 for all units.
    pub to: u16,
    /// The port that it comes from.
    pub from: u16,
    /// What was sent.
    pub bytes: &'b [u8],
}

struct Slot {
    bytes: [u8; LINE_DATAGRAM_BYTES + PORT_BYTES],
    /// With the ports; 0 in a free slot.
    length: usize,
}

impl Slot {
    const FREE: Self = Self { bytes: [0; LINE_DATAGRAM_BYTES + PORT_BYTES], length: 0 };

    /// Appends; `false` if it does not fit.
    fn append(&mut self, bytes: &[u8]) -> bool {
        let end = self.length.saturating_add(bytes.len());
        let Some(free) = self.bytes.get_mut(self.length..end) else { return false };
        copy(bytes, free);
        self.length = end;
        true
    }
}

/// Those of one line, in both directions.
pub(super) struct Datagrams {
    /// The newest first.
    waiting: [Slot; WAITING],
    /// The number of the first one, and how many frames of it were sent.
    number: u16,
    sent: u8,
    arrived: Slot,
    /// The number of that which arrives, and of its frame that comes next.
    arriving: Option<(u16, u8)>,
    is_complete: bool,
}

impl Datagrams {
    pub(super) const fn new() -> Self {
        Self {
            waiting: [const { Slot::FREE }; WAITING],
            number: 0,
            sent: 0,
            arrived: Slot::FREE,
            arriving: None,
            is_complete: false,
        }
    }

    /// Queues a datagram; `false` if it is too long, or in place of another one.
    pub(super) fn send(&mut self, to: u16, from: u16, bytes: &[u8]) -> bool {
        if bytes.len() > LINE_DATAGRAM_BYTES {
            return false;
        }
        // What was sent in part begins again behind the new one: the other end collects one datagram at a time.
        self.start_next();
        self.waiting.rotate_right(1);
        let [newest, ..] = &mut self.waiting;
        let is_kept = newest.length == 0;
        newest.length = 0;
        let [t0, t1] = to.to_le_bytes();
        let [f0, f1] = from.to_le_bytes();
        newest.append(&[t0, t1, f0, f1]);
        newest.append(bytes);
        is_kept
    }

    fn start_next(&mut self) {
        self.number = self.number.wrapping_add(1);
        self.sent = 0;
    }

    /// The next frame to send.
    pub(super) fn next_frame(&mut self) -> Option<Frame<'_>> {
        let (number, sequence) = (self.number, self.sent);
        let [newest, ..] = &self.waiting;
        if newest.length == 0 {
            return None;
        }
        let start = usize::from(sequence).saturating_mul(PAYLOAD_BYTES);
        let end = start.saturating_add(PAYLOAD_BYTES).min(newest.length);
        let is_last = end == newest.length;
        self.sent = sequence.saturating_add(1);
        if is_last {
            self.start_next();
            self.waiting.rotate_left(1);
            let [.., gone] = &mut self.waiting;
            gone.length = 0;
            let payload = gone.bytes.get(start..end)?;
            return Some(frame(number, sequence, true, payload));
        }
        let [newest, ..] = &self.waiting;
        Some(frame(number, sequence, false, newest.bytes.get(start..end)?))
    }

    /// Takes a frame; `false` if a datagram is lost by it.
    pub(super) fn receive(&mut self, frame: &Frame<'_>) -> bool {
        let begins = frame.sequence == 0;
        let is_lost = core::mem::take(&mut self.is_complete);
        if begins {
            self.arrived.length = 0;
        } else if self.arriving != Some((frame.number, frame.sequence)) {
            return self.arriving.take().is_none() && !is_lost;
        }
        self.arriving = None;
        if !self.arrived.append(frame.payload) {
            return false;
        }
        self.is_complete = frame.acknowledged != 0 && self.arrived.length >= PORT_BYTES;
        if frame.acknowledged == 0 {
            self.arriving = Some((frame.number, frame.sequence.saturating_add(1)));
        }
        !is_lost
    }

    pub(super) const fn has_arrived(&self) -> bool {
        self.is_complete
    }

    /// The datagram that has arrived, once.
    pub(super) fn take(&mut self) -> Option<Datagram<'_>> {
        if !core::mem::take(&mut self.is_complete) {
            return None;
        }
        let (&[t0, t1, f0, f1], bytes) = self.arrived.bytes.get(..self.arrived.length)?.split_first_chunk()?;
        Some(Datagram { to: u16::from_le_bytes([t0, t1]), from: u16::from_le_bytes([f0, f1]), bytes })
    }
}

const fn frame(number: u16, sequence: u8, is_last: bool, payload: &[u8]) -> Frame<'_> {
    Frame { kind: Kind::Datagram, credit: 0, number, sequence, acknowledged: is_last as u8, payload }
}
