//! The stream of a serial line: a link is dialled and taken, its bytes travel in numbered frames, and what is not
//! acknowledged is sent again from there on (go-back-N).

use super::frame::{Frame, Kind, PAYLOAD_BYTES};
use super::{Counters, State};
use crate::bytes::{copy, move_down};
use crate::config::{LINE_FRAME_BYTES, LINE_LOST, LINE_WINDOW};
use crate::error::CloseReason;
use crate::random::Random;
use crate::time::{Duration, Instant};

const FRAMES: usize = LINE_WINDOW as usize;
/// Bytes that have come and are not taken yet.
const RECEIVE_BYTES: usize = PAYLOAD_BYTES * FRAMES;
/// How long a link that was closed may still send what was written.
const FAREWELL: Duration = Duration::from_secs(1);
/// What an adapter, its driver and the other end's scheduler may add to an answer.
const LATENCY: Duration = Duration::from_millis(30);

const _: () = assert!(LINE_WINDOW.is_power_of_two() && LINE_WINDOW < 16);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Idle,
    Dialing {
        is_due: bool,
    },
    Open,
    /// What was written is still sent, until then at most.
    Closing(Instant),
    Ended(CloseReason),
}

pub(super) struct Stream {
    phase: Phase,
    /// The number of the link, or of the last one.
    number: u16,
    /// The port that is dialled.
    port: [u8; 2],
    random: Random,
    /// A link that the other end dials: its number and its port.
    offered: Option<(u16, u16)>,
    /// An answer that is owed, to the link of that number.
    answer: Option<(Kind, u16)>,
    sender: Sender,
    receiver: Receiver,
    /// How long an answer may take.
    patience: Duration,
    /// When what is unanswered is sent again.
    timer: Instant,
    /// Since when nothing was answered.
    unanswered: Instant,
}

impl Stream {
    pub(super) fn new(bits_per_second: u32, seed: u64) -> Self {
        // A byte takes ten bits. Each end may be behind a window of the other's frames.
        let frame_bits = (LINE_FRAME_BYTES as u64).saturating_mul(10);
        let frame = frame_bits.saturating_mul(1_000_000).checked_div(bits_per_second.into()).unwrap_or(0);
        let frames = u64::from(LINE_WINDOW).saturating_mul(2);
        Self {
            phase: Phase::Idle,
            number: 0,
            port: [0; 2],
            random: Random::new(seed),
            offered: None,
            answer: None,
            sender: Sender::new(),
            receiver: Receiver::new(),
            patience: Duration::from_micros(frame.saturating_mul(frames)) + LATENCY,
            timer: Instant::FAR_FUTURE,
            unanswered: Instant::START,
        }
    }

    pub(super) const fn state(&self) -> State {
        match (self.phase, self.offered) {
            (Phase::Idle, Some((_, port))) => State::Offered(port),
            (Phase::Idle, None) => State::Idle,
            (Phase::Dialing { .. }, _) => State::Dialing,
            (Phase::Open, _) => State::Open,
            (Phase::Closing(_), _) => State::Closing,
            (Phase::Ended(reason), _) => State::Ended(reason),
        }
    }

    pub(super) fn dial(&mut self, port: u16) -> bool {
        if self.state() != State::Idle {
            return false;
        }
        self.port = port.to_le_bytes();
        let number = self.fresh_number();
        self.begin(number, Phase::Dialing { is_due: true });
        true
    }

    pub(super) fn accept(&mut self) -> bool {
        let State::Offered(_) = self.state() else { return false };
        let Some((number, _)) = self.offered.take() else { return false };
        self.begin(number, Phase::Open);
        self.answer = Some((Kind::Accept, number));
        true
    }

    pub(super) fn close(&mut self, now: Instant) {
        match self.phase {
            Phase::Open => {
                self.receiver.bytes.clear();
                self.phase = Phase::Closing(now + FAREWELL);
            }
            Phase::Closing(_) => {}
            Phase::Idle => self.refuse(),
            Phase::Dialing { .. } | Phase::Ended(_) => self.abort(),
        }
    }

    pub(super) fn abort(&mut self) {
        if matches!(self.phase, Phase::Dialing { .. } | Phase::Open | Phase::Closing(_)) {
            self.answer = Some((Kind::Close, self.number));
        }
        self.begin(self.number, Phase::Idle);
    }

    fn refuse(&mut self) {
        if let Some((number, _)) = self.offered.take() {
            self.answer = Some((Kind::Close, number));
        }
    }

    /// Another number than that of the last link, whose frames may still be under way.
    fn fresh_number(&mut self) -> u16 {
        let number = self.random.bits() as u16;
        if number == self.number { number.wrapping_add(1) } else { number }
    }

    fn begin(&mut self, number: u16, phase: Phase) {
        self.number = number;
        self.phase = phase;
        self.sender = Sender::new();
        self.receiver = Receiver::new();
        self.timer = Instant::FAR_FUTURE;
    }

    /// The link is over; what has come of it can still be read.
    fn end(&mut self, reason: CloseReason) {
        self.phase = Phase::Ended(reason);
        self.timer = Instant::FAR_FUTURE;
    }

    pub(super) fn capacity(&self) -> usize {
        if self.phase == Phase::Open { self.sender.capacity() } else { 0 }
    }

    pub(super) fn write(&mut self, bytes: &[u8]) -> usize {
        if self.phase == Phase::Open { self.sender.write(bytes) } else { 0 }
    }

    pub(super) fn peek(&mut self) -> &mut [u8] {
        &mut self.receiver.bytes
    }

    pub(super) fn take(&mut self, count: usize) {
        self.receiver.take(count);
    }

    pub(super) fn deadline(&self) -> Instant {
        match self.phase {
            Phase::Closing(until) => until.min(self.timer),
            _ => self.timer,
        }
    }

    pub(super) fn receive(&mut self, frame: &Frame<'_>, now: Instant) {
        match frame.kind {
            Kind::Open => self.opened(frame),
            Kind::Accept => self.accepted(frame, now),
            Kind::Close => self.closed(frame.number),
            Kind::Data | Kind::Acknowledge | Kind::Repeat => self.carried(frame, now),
            Kind::Datagram => {}
        }
    }

    fn opened(&mut self, frame: &Frame<'_>) {
        let Ok(port) = frame.payload.try_into().map(u16::from_le_bytes) else { return };
        match self.phase {
            // Both dial: the larger number goes on.
            Phase::Dialing { .. } if frame.number < self.number => return,
            Phase::Dialing { .. } if frame.number == self.number => {
                let number = self.fresh_number();
                return self.begin(number, Phase::Dialing { is_due: true });
            }
            Phase::Dialing { .. } => self.end(CloseReason::DialFailed),
            // The acceptance was lost. Once data has come, it is another link with the same number.
            Phase::Open if frame.number == self.number && self.receiver.expected == 0 => {
                self.answer = Some((Kind::Accept, frame.number));
                return;
            }
            Phase::Open => self.end(CloseReason::Reset),
            Phase::Closing(_) => self.begin(self.number, Phase::Idle),
            Phase::Idle | Phase::Ended(_) => {}
        }
        self.offered = Some((frame.number, port));
    }

    fn accepted(&mut self, frame: &Frame<'_>, now: Instant) {
        if matches!(self.phase, Phase::Dialing { .. }) && frame.number == self.number {
            self.phase = Phase::Open;
            self.heard(now);
        }
    }

    fn closed(&mut self, number: u16) {
        if self.offered.is_some_and(|(offered, _)| offered == number) {
            self.offered = None;
        }
        match self.phase {
            _ if number != self.number => {}
            Phase::Dialing { .. } => self.end(CloseReason::DialFailed),
            Phase::Open => self.end(CloseReason::Reset),
            Phase::Closing(_) => self.begin(self.number, Phase::Idle),
            Phase::Idle | Phase::Ended(_) => {}
        }
    }

    /// A frame of an open link.
    fn carried(&mut self, frame: &Frame<'_>, now: Instant) {
        // The other end has accepted, whether that was heard or not.
        self.accepted(frame, now);
        if frame.number != self.number || !matches!(self.phase, Phase::Open | Phase::Closing(_)) {
            if frame.kind == Kind::Data {
                self.answer = Some((Kind::Close, frame.number));
            }
            return;
        }
        self.unanswered = now;
        // What acknowledges nothing new must not put off what is to be sent again.
        if self.sender.acknowledged(frame.acknowledged, frame.credit) || self.sender.filled == 0 {
            self.heard(now);
        }
        if frame.kind == Kind::Repeat {
            self.sender.go_back();
        }
        if frame.kind == Kind::Data {
            self.receiver.receive(frame.sequence, frame.payload);
            if self.phase != Phase::Open {
                self.receiver.bytes.clear();
            }
        }
    }

    fn heard(&mut self, now: Instant) {
        self.unanswered = now;
        self.timer = if self.sender.filled == 0 { Instant::FAR_FUTURE } else { now + self.patience };
    }

    /// Does what is due, and returns the next frame to send.
    pub(super) fn next_frame(&mut self, now: Instant, counters: &mut Counters) -> Option<Frame<'_>> {
        self.poll(now);
        if let Some((kind, number)) = self.answer.take() {
            return Some(Frame::bare(kind, number));
        }
        match self.phase {
            Phase::Idle | Phase::Ended(_) => None,
            Phase::Dialing { is_due: false } => None,
            Phase::Dialing { is_due: true } => {
                self.phase = Phase::Dialing { is_due: false };
                self.expect_answer(now);
                Some(Frame { payload: &self.port, ..Frame::bare(Kind::Open, self.number) })
            }
            Phase::Closing(until) if self.sender.filled == 0 || now >= until => {
                self.abort();
                self.answer.take().map(|(kind, number)| Frame::bare(kind, number))
            }
            Phase::Open | Phase::Closing(_) => {
                if self.sender.filled > 0 {
                    self.expect_answer(now);
                }
                self.receiver.frame(self.number, &mut self.sender, counters)
            }
        }
    }

    fn expect_answer(&mut self, now: Instant) {
        if self.timer == Instant::FAR_FUTURE {
            self.unanswered = now;
            self.timer = now + self.patience;
        }
    }

    fn poll(&mut self, now: Instant) {
        if now < self.timer {
            return;
        }
        self.timer = now + self.patience;
        let is_lost = now.since(self.unanswered) >= LINE_LOST;
        match &mut self.phase {
            Phase::Dialing { .. } if is_lost => self.end(CloseReason::DialFailed),
            Phase::Dialing { is_due } => *is_due = true,
            Phase::Open if is_lost => self.end(CloseReason::Silent),
            _ => self.sender.probe(),
        }
    }
}

/// A frame that is kept until it is acknowledged.
struct Slot {
    bytes: [u8; PAYLOAD_BYTES],
    length: usize,
}

/// What is written. Counted from `base`: `sent` <= `fixed` <= `filled`.
struct Sender {
    slots: [Slot; FRAMES],
    /// The sequence number of the first frame that is not acknowledged.
    base: u8,
    /// Frames sent since the last step back.
    sent: u8,
    /// Frames ever sent, which no more bytes are added to.
    fixed: u8,
    filled: u8,
    /// How many frames from `base` on the other end takes.
    credit: u8,
}

impl Sender {
    const fn new() -> Self {
        let slots = [const { Slot { bytes: [0; PAYLOAD_BYTES], length: 0 } }; FRAMES];
        Self { slots, base: 0, sent: 0, fixed: 0, filled: 0, credit: LINE_WINDOW }
    }

    fn slot(&mut self, frame: u8) -> Option<&mut Slot> {
        let index = self.base.wrapping_add(frame) % LINE_WINDOW;
        self.slots.get_mut(usize::from(index))
    }

    /// Bytes that the last frame takes, if it was never sent, and those that are free.
    fn capacity(&self) -> usize {
        let last = self.base.wrapping_add(self.filled).wrapping_sub(1) % LINE_WINDOW;
        let last = self.slots.get(usize::from(last)).filter(|_| self.filled > self.fixed);
        let free = usize::from(LINE_WINDOW.saturating_sub(self.filled)).saturating_mul(PAYLOAD_BYTES);
        free.saturating_add(last.map_or(0, |slot| PAYLOAD_BYTES.saturating_sub(slot.length)))
    }

    fn write(&mut self, bytes: &[u8]) -> usize {
        let mut rest = bytes;
        while !rest.is_empty() && self.capacity() > 0 {
            let last = self.filled.saturating_sub(1);
            let has_space = self.filled > self.fixed && self.slot(last).is_some_and(|slot| slot.length < PAYLOAD_BYTES);
            if !has_space {
                self.filled = self.filled.saturating_add(1);
            }
            let Some(slot) = self.slot(self.filled.saturating_sub(1)) else { break };
            if !has_space {
                slot.length = 0;
            }
            let count = rest.len().min(PAYLOAD_BYTES.saturating_sub(slot.length));
            let (now, later) = rest.split_at_checked(count).unwrap_or_default();
            let end = slot.length.saturating_add(count);
            copy(now, slot.bytes.get_mut(slot.length..end).unwrap_or_default());
            slot.length = end;
            rest = later;
        }
        bytes.len().saturating_sub(rest.len())
    }

    /// The other end expects the frame of that sequence number. Whether that acknowledges anything.
    fn acknowledged(&mut self, expected: u8, credit: u8) -> bool {
        let count = expected.wrapping_sub(self.base);
        if count > self.fixed {
            return false;
        }
        self.base = expected;
        self.sent = self.sent.saturating_sub(count);
        self.fixed = self.fixed.saturating_sub(count);
        self.filled = self.filled.saturating_sub(count);
        self.credit = credit;
        count > 0
    }

    fn go_back(&mut self) {
        self.sent = 0;
    }

    /// Nothing was answered in time. Where the other end could take nothing, one frame asks again.
    fn probe(&mut self) {
        self.go_back();
        self.credit = self.credit.max(1);
    }

    /// The next frame: its sequence number and its bytes.
    fn next(&mut self, counters: &mut Counters) -> Option<(u8, &[u8])> {
        if self.sent >= self.filled || self.sent >= self.credit {
            return None;
        }
        let frame = self.sent;
        counters.retransmitted = counters.retransmitted.saturating_add(u32::from(frame < self.fixed));
        self.sent = frame.saturating_add(1);
        self.fixed = self.fixed.max(self.sent);
        let sequence = self.base.wrapping_add(frame);
        let slot = self.slot(frame)?;
        Some((sequence, slot.bytes.get(..slot.length)?))
    }
}

/// What has come.
struct Receiver {
    bytes: heapless::Vec<u8, RECEIVE_BYTES>,
    /// The sequence number of the next frame.
    expected: u8,
    /// How many frames the other end may send, as it heard last.
    credit: u8,
    must_acknowledge: bool,
    /// A frame is missing, and asked for again once.
    is_missing: bool,
    must_ask: bool,
}

impl Receiver {
    const fn new() -> Self {
        Self {
            bytes: heapless::Vec::new(),
            expected: 0,
            credit: LINE_WINDOW,
            must_acknowledge: false,
            is_missing: false,
            must_ask: false,
        }
    }

    fn receive(&mut self, sequence: u8, payload: &[u8]) {
        self.must_acknowledge = true;
        let ahead = sequence.wrapping_sub(self.expected);
        if ahead == 0 && self.bytes.extend_from_slice(payload).is_ok() {
            self.expected = sequence.wrapping_add(1);
            self.is_missing = false;
        } else if (1..LINE_WINDOW).contains(&ahead) && !core::mem::replace(&mut self.is_missing, true) {
            self.must_ask = true;
        }
    }

    fn take(&mut self, count: usize) {
        let length = self.bytes.len();
        move_down(&mut self.bytes, count.min(length)..length);
        self.bytes.truncate(length.saturating_sub(count));
        if self.credit == 0 && self.free_frames() > 0 {
            self.must_acknowledge = true;
        }
    }

    fn free_frames(&self) -> u8 {
        let free = RECEIVE_BYTES.saturating_sub(self.bytes.len());
        (free / PAYLOAD_BYTES) as u8
    }

    /// The next frame of the link: data if there are some, each with the acknowledgement of what has come.
    fn frame<'s>(&mut self, number: u16, sender: &'s mut Sender, counters: &mut Counters) -> Option<Frame<'s>> {
        let (kind, sequence, payload): (_, _, &[u8]) = if core::mem::take(&mut self.must_ask) {
            (Kind::Repeat, 0, &[])
        } else if let Some((sequence, payload)) = sender.next(counters) {
            (Kind::Data, sequence, payload)
        } else if self.must_acknowledge {
            (Kind::Acknowledge, 0, &[])
        } else {
            return None;
        };
        self.must_acknowledge = false;
        self.credit = self.free_frames();
        Some(Frame { kind, credit: self.credit, number, sequence, acknowledged: self.expected, payload })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::arithmetic_side_effects)]
    use super::*;

    /// At each sequence number, with each number of frames on their way and behind them.
    #[test]
    #[cfg_attr(miri, ignore = "so many cases take the interpreter hours")]
    fn an_acknowledgement_frees_what_was_sent_before_it_and_nothing_else() {
        let mut sender = Sender::new();
        let windows = (0..=LINE_WINDOW).flat_map(|filled| (0..=filled).map(move |fixed| (filled, fixed)));
        for ((filled, fixed), base) in windows.flat_map(|window| (0..=u8::MAX).map(move |base| (window, base))) {
            for expected in 0..=u8::MAX {
                (sender.base, sender.sent, sender.fixed, sender.filled) = (base, fixed, fixed, filled);
                let frees =
                    (0..=fixed).find(|count| (u16::from(base) + u16::from(*count)) % 256 == u16::from(expected));
                assert_eq!(sender.acknowledged(expected, 3), frees.is_some_and(|count| count > 0));
                let count = frees.unwrap_or(0);
                let left = (sender.base.wrapping_sub(base), sender.sent, sender.fixed, sender.filled);
                assert_eq!(left, (count, fixed - count, fixed - count, filled - count), "{base}: {expected}");
            }
        }
    }

    #[test]
    #[cfg_attr(miri, ignore = "so many cases take the interpreter hours")]
    fn only_the_frame_that_is_expected_is_taken_and_only_one_of_the_window_is_missed() {
        let mut receiver = Receiver::new();
        for (expected, sequence) in (0..=u8::MAX).flat_map(|a| (0..=u8::MAX).map(move |b| (a, b))) {
            receiver.bytes.clear();
            (receiver.expected, receiver.is_missing, receiver.must_ask) = (expected, false, false);
            receiver.receive(sequence, b"x");
            let ahead = (256 + u16::from(sequence) - u16::from(expected)) % 256;
            assert_eq!((receiver.bytes.len(), receiver.expected != expected), (usize::from(ahead == 0), ahead == 0));
            assert_eq!(receiver.must_ask, ahead > 0 && ahead < u16::from(LINE_WINDOW), "{expected}: {sequence}");
        }
    }
}
