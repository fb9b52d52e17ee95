#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]
//! Two ends and a wire between them that has a rate, loses and damages bytes, and can be pulled, in virtual time.

use std::collections::VecDeque;
use std::vec::Vec;
use std::{println, vec};

use proptest::prelude::*;

use super::*;
use crate::config::{LINE_DATAGRAM_BYTES, LINE_LOST};
use crate::random::Random;
use crate::time::Duration;

/// One direction.
#[derive(Default)]
struct Way {
    /// Bytes that are under way, and when all of them have come.
    frame: Vec<u8>,
    free: Instant,
}

struct Wire {
    ends: [Line; 2],
    ways: [Way; 2],
    rate: u32,
    now: Instant,
    random: Random,
    /// One bit in so many is turned over; 0 for none.
    damaged: u64,
    /// One byte in so many is lost; 0 for none.
    lost: u64,
    pulled: bool,
    /// What each end received.
    streams: [Vec<u8>; 2],
    datagrams: [Vec<(Instant, Vec<u8>)>; 2],
    /// Ends that do not read their stream.
    unread: [bool; 2],
}

impl Wire {
    fn new(rate: u32, seed: u64) -> Self {
        Self {
            ends: [Line::new(rate, seed), Line::new(rate, seed + 1)],
            ways: Default::default(),
            rate,
            now: Instant::START,
            random: Random::new(seed),
            damaged: 0,
            lost: 0,
            pulled: false,
            streams: Default::default(),
            datagrams: Default::default(),
            unread: [false; 2],
        }
    }

    /// The first end has dialled and the second one has accepted.
    fn open(rate: u32, seed: u64) -> Self {
        let mut wire = Self::new(rate, seed);
        assert!(wire.ends[0].dial(7));
        wire.until(|wire| wire.ends[1].state() == State::Offered(7));
        assert!(wire.ends[1].accept());
        wire.until(|wire| wire.ends[0].state() == State::Open);
        wire
    }

    /// Goes to the next thing that happens.
    fn step(&mut self) {
        self.step_to(Instant::FAR_FUTURE);
    }

    /// The same, but no further than this time.
    fn step_to(&mut self, limit: Instant) {
        for from in [0, 1] {
            if self.ways[from].frame.is_empty() && self.ways[from].free <= self.now {
                let mut buffer = [0; LINE_FRAME_BYTES];
                let frame = self.ends[from].transmit(self.now, &mut buffer);
                let micros = frame.len() as u64 * 10_000_000 / u64::from(self.rate);
                self.ways[from] = Way { frame: frame.to_vec(), free: self.now + Duration::from_micros(micros) };
            }
        }
        // What is due waits for the wire.
        let due = |(end, way): (&Line, &Way)| if way.frame.is_empty() { end.deadline() } else { way.free };
        let next = self.ends.iter().zip(&self.ways).map(due).min().unwrap();
        // Nothing happens on an idle line: a millisecond passes.
        let next = if next == Instant::FAR_FUTURE { self.now + Duration::from_millis(1) } else { next.max(self.now) };
        self.now = next.min(limit);
        for from in [0, 1] {
            if self.ways[from].free <= self.now {
                let frame = core::mem::take(&mut self.ways[from].frame);
                let bytes = self.carried(&frame);
                self.deliver(1 - from, &bytes);
            }
        }
    }

    /// What comes of `frame` on the other side.
    fn carried(&mut self, frame: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for byte in frame {
            let mut byte = *byte;
            for bit in 0..8 {
                byte ^= u8::from(self.damaged > 0 && self.random.below(self.damaged) == 0) << bit;
            }
            if !self.pulled && (self.lost == 0 || self.random.below(self.lost) > 0) {
                bytes.push(byte);
            }
        }
        bytes
    }

    fn deliver(&mut self, to: usize, bytes: &[u8]) {
        let end = &mut self.ends[to];
        let mut rest = bytes;
        while !rest.is_empty() {
            rest = &rest[end.receive(rest, self.now)..];
            if let Some(datagram) = end.next_datagram() {
                self.datagrams[to].push((self.now, datagram.bytes.to_vec()));
            }
        }
        if !self.unread[to] {
            self.streams[to].extend_from_slice(end.peek());
            end.take(usize::MAX);
        }
    }

    #[track_caller]
    fn until(&mut self, condition: impl Fn(&Self) -> bool) {
        let end = self.now + Duration::from_secs(600);
        while !condition(self) {
            assert!(self.now < end, "not in ten minutes of the wire");
            self.step();
        }
    }

    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.step_to(end);
        }
    }

    /// Sends `bytes` from one end to the other and waits until they have come.
    #[track_caller]
    fn send(&mut self, from: usize, bytes: &[u8]) {
        let goal = self.streams[1 - from].len() + bytes.len();
        let mut rest = bytes;
        while !rest.is_empty() {
            // Of all lengths, so that frames are filled in several writes.
            let count = rest.len().min(self.random.below(200) as usize + 1);
            rest = &rest[self.ends[from].write(&rest[..count])..];
            self.step();
        }
        self.until(|wire| wire.streams[1 - from].len() >= goal);
    }
}

/// Bytes that do not repeat within a window.
fn bulk(length: usize) -> Vec<u8> {
    let mut random = Random::new(length as u64);
    (0..length).map(|_| random.bits() as u8).collect()
}

#[test]
fn a_stream_crosses_whole_and_in_order_in_both_directions() {
    let mut wire = Wire::open(115_200, 1);
    let (there, back) = (bulk(20_000), bulk(3_000));
    let mut waiting: [VecDeque<u8>; 2] = [there.iter().copied().collect(), back.iter().copied().collect()];
    while waiting.iter().any(|bytes| !bytes.is_empty()) {
        for (end, bytes) in wire.ends.iter_mut().zip(&mut waiting) {
            let count = end.write(bytes.make_contiguous());
            bytes.drain(..count);
        }
        wire.step();
    }
    wire.until(|wire| wire.streams[1].len() == there.len() && wire.streams[0].len() == back.len());
    assert!(wire.streams[1] == there && wire.streams[0] == back);
    assert_eq!(wire.ends.each_ref().map(Line::counters), [Counters::default(); 2]);
}

#[test]
fn a_line_that_damages_and_loses_bytes_delays_a_stream_and_changes_nothing() {
    for seed in 0..20 {
        let mut wire = Wire::open(115_200, seed);
        (wire.damaged, wire.lost) = (4_000, 1_000);
        let there = bulk(20_000);
        wire.send(0, &there);
        assert!(wire.streams[1] == there, "seed {seed}");
        assert!(wire.ends[1].counters().bad > 0 && wire.ends[0].counters().retransmitted > 0, "seed {seed}");
    }
}

#[test]
fn a_frame_that_is_missing_is_asked_for_at_once() {
    let mut wire = Wire::open(115_200, 3);
    let there = bulk(464);
    let start = wire.now;
    wire.pulled = true;
    assert_eq!(wire.ends[0].write(&there), there.len());
    wire.step();
    wire.pulled = false;
    wire.until(|wire| wire.streams[1] == there);
    // A time-out alone would be 119 ms.
    let after = wire.now.since(start);
    assert!(after < Duration::from_millis(100), "{after:?}");
}

/// The last frame of one end is lost, and no gap shows it, while the other end says something all the time.
#[test]
fn a_lost_last_frame_comes_however_much_the_other_way_carries() {
    let mut wire = Wire::open(115_200, 15);
    wire.pulled = true;
    assert_eq!(wire.ends[0].write(b"alone"), 5);
    // It stands in no queue any more, and did not come.
    wire.pass(Duration::from_millis(5));
    assert!(wire.streams[1].is_empty());
    wire.pulled = false;
    let start = wire.now;
    while wire.streams[1].is_empty() && wire.now < start + Duration::from_secs(2) {
        assert_eq!(wire.ends[1].write(b"sample"), 6);
        wire.pass(Duration::from_millis(50));
    }
    assert_eq!(wire.streams[1], b"alone");
}

#[test]
fn a_pulled_line_ends_a_stream_that_has_something_to_say() {
    let mut wire = Wire::open(115_200, 4);
    wire.pulled = true;
    wire.ends[0].write(b"still there?");
    let start = wire.now;
    wire.until(|wire| wire.ends[0].state() == State::Ended(CloseReason::Silent));
    let after = wire.now.since(start);
    assert!(after >= LINE_LOST && after < LINE_LOST + Duration::from_secs(1), "{after:?}");
    assert_eq!(wire.ends[1].state(), State::Open);
}

/// The end that has nothing to say keeps its link until the other one dials again.
#[test]
fn a_line_that_is_plugged_in_again_is_dialled_again() {
    let mut wire = Wire::open(115_200, 5);
    wire.pulled = true;
    wire.ends[0].write(b"lost");
    wire.until(|wire| wire.ends[0].state() == State::Ended(CloseReason::Silent));
    wire.pulled = false;
    let now = wire.now;
    wire.ends[0].close(now);
    assert!(wire.ends[0].dial(8));
    wire.until(|wire| wire.ends[1].state() == State::Ended(CloseReason::Reset));
    let now = wire.now;
    wire.ends[1].close(now);
    assert_eq!(wire.ends[1].state(), State::Offered(8));
    assert!(wire.ends[1].accept());
    wire.until(|wire| wire.ends[0].state() == State::Open);
    wire.send(0, b"again");
    assert_eq!(wire.streams[1], b"again");
}

#[test]
fn a_short_break_ends_nothing() {
    let mut wire = Wire::open(115_200, 6);
    let there = bulk(400);
    wire.pulled = true;
    assert_eq!(wire.ends[0].write(&there), there.len());
    wire.pass(Duration::from_secs(3));
    wire.pulled = false;
    wire.until(|wire| wire.streams[1] == there);
}

#[test]
fn an_end_that_restarts_ends_the_link_of_before() {
    let mut wire = Wire::open(115_200, 7);
    wire.ends[0] = Line::new(115_200, 99);
    wire.ends[1].write(b"to nobody");
    wire.until(|wire| wire.ends[1].state() == State::Ended(CloseReason::Reset));
    let mut wire = Wire::open(115_200, 7);
    wire.ends[1] = Line::new(115_200, 99);
    assert!(wire.ends[1].dial(3));
    wire.until(|wire| wire.ends[0].state() == State::Ended(CloseReason::Reset));
    wire.ends[0].abort();
    assert_eq!(wire.ends[0].state(), State::Offered(3));
}

#[test]
fn of_two_ends_that_dial_at_once_one_goes_on() {
    for seed in 0..50 {
        let mut wire = Wire::new(115_200, seed);
        assert!(wire.ends[0].dial(1) && wire.ends[1].dial(2));
        wire.until(|wire| wire.ends.iter().any(|end| end.state() == State::Ended(CloseReason::DialFailed)));
        let loser = usize::from(wire.ends[0].state() == State::Dialing);
        let now = wire.now;
        wire.ends[loser].close(now);
        wire.until(|wire| matches!(wire.ends[loser].state(), State::Offered(_)));
        assert!(wire.ends[loser].accept());
        wire.until(|wire| wire.ends.iter().all(|end| end.state() == State::Open));
    }
}

#[test]
fn two_ends_that_dial_with_the_same_number_draw_again() {
    let mut wire = Wire::new(115_200, 8);
    wire.ends = [Line::new(115_200, 5), Line::new(115_200, 5)];
    assert!(wire.ends[0].dial(1) && wire.ends[1].dial(1));
    let [mut first, mut second] = [[0; LINE_FRAME_BYTES]; 2];
    let first = wire.ends[0].transmit(wire.now, &mut first).to_vec();
    assert_eq!(wire.ends[1].transmit(wire.now, &mut second), first);
    wire.deliver(1, &first);
    assert_eq!(wire.ends[1].state(), State::Dialing);
    let again = wire.ends[1].transmit(wire.now, &mut second);
    assert!(!again.is_empty() && again != first);
}

#[test]
fn nothing_at_the_other_end_is_a_dial_that_fails() {
    let mut wire = Wire::new(19_200, 9);
    wire.pulled = true;
    assert!(wire.ends[0].dial(7) && !wire.ends[0].dial(7));
    wire.until(|wire| wire.ends[0].state() == State::Ended(CloseReason::DialFailed));
    assert!(wire.now.since(Instant::START) >= LINE_LOST);
}

#[test]
fn a_refused_dial_fails_at_once() {
    let mut wire = Wire::new(115_200, 10);
    assert!(wire.ends[0].dial(7));
    wire.until(|wire| wire.ends[1].state() == State::Offered(7));
    let now = wire.now;
    wire.ends[1].close(now);
    assert_eq!(wire.ends[1].state(), State::Idle);
    wire.until(|wire| wire.ends[0].state() == State::Ended(CloseReason::DialFailed));
    assert!(wire.now.since(Instant::START) < Duration::from_millis(100));
}

#[test]
fn what_was_written_before_the_end_comes_whole() {
    let mut wire = Wire::open(115_200, 11);
    let farewell = bulk(400);
    wire.lost = 500;
    assert_eq!(wire.ends[0].write(&farewell), farewell.len());
    let now = wire.now;
    wire.ends[0].close(now);
    assert_eq!((wire.ends[0].state(), wire.ends[0].write(b"more")), (State::Closing, 0));
    wire.until(|wire| wire.ends[0].state() == State::Idle);
    assert_eq!(wire.streams[1], farewell);
}

#[test]
fn an_end_that_does_not_read_stops_the_other_one_and_loses_nothing() {
    let mut wire = Wire::open(115_200, 12);
    wire.unread[1] = true;
    let there = bulk(2_000);
    let mut written = 0;
    for _ in 0..2_000 {
        written += wire.ends[0].write(&there[written..]);
        wire.step();
    }
    wire.pass(LINE_LOST + LINE_LOST);
    assert!(written < there.len() && wire.ends[0].state() == State::Open);
    // That it reads again is not heard.
    (wire.unread[1], wire.pulled) = (false, true);
    wire.pass(Duration::from_millis(50));
    wire.pulled = false;
    while written < there.len() {
        written += wire.ends[0].write(&there[written..]);
        wire.step();
    }
    wire.until(|wire| wire.streams[1] == there);
}

#[test]
fn datagrams_of_all_lengths_cross_whole_and_longer_ones_are_refused() {
    let mut wire = Wire::new(115_200, 13);
    for length in (0..=LINE_DATAGRAM_BYTES).step_by(7).chain([LINE_DATAGRAM_BYTES]) {
        let datagram = bulk(length);
        assert!(wire.ends[0].send_datagram(0, 9, &datagram));
        let before = wire.datagrams[1].len();
        wire.until(|wire| wire.datagrams[1].len() > before);
        assert_eq!(wire.datagrams[1][before].1, datagram);
    }
    assert!(!wire.ends[0].send_datagram(0, 9, &[0; LINE_DATAGRAM_BYTES + 1]));
    assert_eq!((wire.ends[0].counters().dropped, wire.ends[1].counters().dropped), (1, 0));
}

#[test]
fn a_datagram_with_a_damaged_frame_does_not_come_and_others_do() {
    let mut wire = Wire::new(115_200, 14);
    let mut buffer = [0; LINE_FRAME_BYTES];
    wire.ends[0].send_datagram(5, 6, &bulk(300));
    for frame in 0..3 {
        let mut bytes = wire.ends[0].transmit(wire.now, &mut buffer).to_vec();
        bytes[9] ^= u8::from(frame == 1);
        wire.deliver(1, &bytes);
    }
    assert!(wire.datagrams[1].is_empty());
    assert_eq!(wire.ends[1].counters(), Counters { bad: 1, dropped: 1, ..Counters::default() });
    wire.ends[0].send_datagram(5, 6, b"whole");
    let bytes = wire.ends[0].transmit(wire.now, &mut buffer).to_vec();
    wire.ends[1].receive(&bytes, wire.now);
    assert_eq!(wire.ends[1].next_datagram(), Some(Datagram { to: 5, from: 6, bytes: b"whole" }));
}

#[test]
fn a_datagram_that_is_overtaken_comes_whole_behind_the_newer_one() {
    let mut wire = Wire::new(115_200, 17);
    let long = bulk(300);
    wire.ends[0].send_datagram(1, 1, &long);
    wire.step();
    wire.ends[0].send_datagram(1, 1, b"urgent");
    wire.until(|wire| wire.datagrams[1].len() == 2);
    let came: Vec<_> = wire.datagrams[1].iter().map(|(_, bytes)| bytes.clone()).collect();
    assert_eq!(came, [b"urgent".to_vec(), long]);
}

/// How long an emergency's datagram takes beside a stream and beside keep-alives that wait, at most, over 200 of them.
fn emergency(rate: u32) -> Duration {
    let mut wire = Wire::open(rate, 15);
    let there = bulk(464);
    let mut longest = Duration::ZERO;
    let pause = LINE_FRAME_BYTES as u64 * 10_000_000 / u64::from(rate);
    for turn in 0..200_u8 {
        let end = wire.now + Duration::from_micros(pause * 5 + pause * u64::from(turn) / 200);
        while wire.now < end {
            wire.ends[0].write(&there);
            wire.step();
        }
        wire.ends[0].send_datagram(1, 1, &[0xAA; 300]);
        wire.ends[0].send_datagram(1, 1, &[turn; 40]);
        let sent = wire.now;
        let seen = wire.datagrams[1].len();
        let arrived = |wire: &Wire| wire.datagrams[1][seen..].iter().any(|(_, bytes)| *bytes == [turn; 40]);
        while !arrived(&wire) {
            wire.ends[0].write(&there);
            wire.step();
            assert!(wire.now.since(sent) < Duration::from_secs(1), "it is lost");
        }
        longest = longest.max(wire.now.since(sent));
    }
    longest
}

#[test]
fn an_emergency_waits_for_one_frame_at_most() {
    for rate in [19_200, 115_200, 1_000_000] {
        let longest = emergency(rate).as_micros();
        let frame = |bytes: u64| bytes * 10_000_000 / u64::from(rate) + 1;
        println!("{rate}: {longest} µs");
        assert!(longest <= frame(LINE_FRAME_BYTES as u64) + frame(40 + 4 + 12), "{rate}: {longest} µs");
    }
}

#[test]
fn a_flood_of_datagrams_does_not_stop_the_stream() {
    let mut wire = Wire::open(115_200, 16);
    let there = bulk(2_000);
    let mut written = 0;
    while wire.streams[1].len() < there.len() {
        wire.ends[0].send_datagram(1, 1, b"flood");
        written += wire.ends[0].write(&there[written..]);
        wire.step();
        assert!(wire.now < Instant::START + Duration::from_secs(2));
    }
    assert_eq!(wire.streams[1], there);
}

proptest! {
    /// Whatever comes, and whatever the port does meanwhile, a line goes on, and afterwards two ends find each other.
    #[test]
    fn junk_is_survived(
        junk in prop::collection::vec((prop::collection::vec(prop_oneof![Just(0_u8), any::<u8>()], 0..200), 0..9_u8), 0..40),
        seed: u32,
    ) {
        let mut wire = Wire::open(115_200, seed.into());
        for (bytes, action) in &junk {
            let end = &mut wire.ends[1];
            match action {
                0 => drop(end.dial(3)),
                1 => drop(end.accept()),
                2 => end.close(wire.now),
                3 => end.abort(),
                4 => drop(end.write(bytes)),
                5 => drop(end.send_datagram(1, 2, bytes)),
                6 => end.take(bytes.len()),
                _ => {}
            }
            // As it is, and as a frame whose code is right.
            wire.deliver(1, bytes);
            let mut buffer = [0; LINE_FRAME_BYTES];
            if let Some((&[kind, number, sequence, acknowledged], payload)) = bytes.split_first_chunk() {
                let kind = [Kind::Open, Kind::Accept, Kind::Close, Kind::Data, Kind::Acknowledge, Kind::Repeat, Kind::Datagram]
                    [usize::from(kind % 7)];
                let number = if number < 128 { 3 } else { 4 };
                let frame = frame::Frame { kind, credit: sequence % 16, number, sequence, acknowledged, payload };
                let bytes = frame.encode(&mut buffer).to_vec();
                wire.deliver(1, &bytes);
            }
            wire.step();
        }
        wire.ends[0].abort();
        wire.ends[1].abort();
        wire.pass(Duration::from_secs(1));
        // What was dialled before is refused: junk dials port 1 too.
        wire.ends.iter_mut().for_each(|end| end.close(wire.now));
        wire.pass(Duration::from_secs(1));
        prop_assert_eq!(wire.ends.each_ref().map(Line::state), [State::Idle; 2]);
        wire.streams = Default::default();
        prop_assert!(wire.ends[0].dial(1));
        wire.until(|wire| wire.ends[1].state() == State::Offered(1));
        prop_assert!(wire.ends[1].accept());
        wire.until(|wire| wire.ends[0].state() == State::Open);
        wire.send(0, b"well");
        prop_assert_eq!(&wire.streams[1], &vec![b'w', b'e', b'l', b'l']);
    }
}
