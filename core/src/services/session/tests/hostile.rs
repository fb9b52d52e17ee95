//! Whatever a peer sends, the link lives or ends; nothing panics or leaks.

use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::super::Event;
use super::net::Datagrams;
use super::pair::Pair;
use super::{none, parameters, x};
use crate::config::Priority;
use crate::distribution::function::Definition;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::items::list;
use crate::distribution::message::{
    Control, Release, Renewal, RequestHeader, SessionBody, encode_failure, encode_reply,
};
use crate::error::{CloseReason, Error};
use crate::host::connections::{LinkCounter, Report};
use crate::host::frame::{self, ChunkWriter, Chunking, Frame};
use crate::time::Duration;

/// Messages made of small numbers, so that many of them are valid for the receiver.
fn message() -> impl Strategy<Value = Vec<u8>> {
    let number = prop_oneof![8 => 0..6_u32, 1 => any::<u32>()];
    let stamp = prop_oneof![4 => 5_000_000_000..5_002_000_000_u64, 4 => 10_000_000..12_000_000_u64, 1 => any::<u64>()];
    let block = prop_oneof![
        4 => prop::collection::vec(any::<u8>(), 0..40),
        2 => Just(vec![0; 8]),
        1 => Just(vec![0; 5_000]),
    ];
    (0..9 + Control::KINDS, number.clone(), number.clone(), number, stamp, block, any::<bool>()).prop_map(
        |(kind, one, two, three, stamp, block, flag)| match kind {
            0..=3 => {
                let header = RequestHeader {
                    id: one,
                    slot: Slot(two as u16),
                    generation: Generation(three as u16 / 3),
                    wants_reply: flag,
                    wants_progress: false,
                    takes_over: false,
                    operator: false,
                    unknown: if two == 5 { 0x10 } else { 0 },
                    remaining: Duration::from_millis(u64::from(one) * 100),
                    stamp,
                    since: Duration::from_micros(two.into()),
                    number: one,
                };
                [&header.encode()[..], &block].concat()
            }
            4 => [&encode_reply(one, Ok(()))[..], &block].concat(),
            5 => encode_reply(one, Err(Error::Busy)).to_vec(),
            6 => encode_failure(one, Error::Expired).to_vec(),
            7 => {
                control(&publish(two, three, if flag { &block } else { KNOWN.get(one as usize).unwrap_or(&KNOWN[0]) }))
            }
            // The last is of a later version, and must be understood.
            8 => any_items(&[(0x8000, &[]), (1, &[])]),
            kind => any_items(&[(0x700, &[one]), (kind - 8, &[one, two, three]), (kind - 8, &[three, two, one])]),
        },
    )
}

/// Encoded signatures: `f()`, `ask(x: int) -> (x: int)`, and one that names a variable twice.
const KNOWN: [&[u8]; 3] = [
    &[1, b'f', 0, 0],
    &[3, b'a', b's', b'k', 1, 0, 1, 1, 0, 0, 0, b'x', 1, 0, 1, 1, 0, 0, 0, b'x'],
    &[1, b'f', 2, 0, 1, 1, 0, 0, 0, b'x', 0, 1, 1, 0, 0, 0, b'x', 0],
];

fn publish(slot: u32, generation: u32, signature: &[u8]) -> Control<'_> {
    Control::Publish {
        slot: slot as u16,
        generation: generation as u16,
        attributes: &[2, 0, 0, 0, 9, 0, 0, 0],
        signature,
    }
}

/// A control message of items of these kinds, with these numbers as their first fields.
fn any_items(items: &[(u16, &[u32])]) -> Vec<u8> {
    [&[3, 0, 0, 0][..], &list(items, |writer, numbers| writer.numbers(numbers))].concat()
}

fn control(control: &Control<'_>) -> Vec<u8> {
    let mut out = [0; 6_000];
    control.encode(&mut out).unwrap().to_vec()
}

/// One frame, or several of one message.
fn frames() -> impl Strategy<Value = Vec<u8>> {
    let chunk = prop_oneof![Just(1_024_usize), 320..1_024_usize];
    let chunked = (message(), 1..4_u8, chunk).prop_map(|(message, priority, chunk)| {
        let chunking = Chunking { chunk, overhead: 0 };
        let mut out = vec![0; chunking.framed_length(message.len())];
        let priority = Priority::from_wire(priority).unwrap();
        ChunkWriter::new(&mut out, chunking, priority, message.len()).unwrap().put(&message);
        out
    });
    let body = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..20),
        (any::<u64>(), any::<u32>(), any::<[bool; 3]>()).prop_map(|(stamp, received, [hears, holds, misses])| {
            SessionBody::keep_alive(stamp, Report { received, hears, holds, misses }).to_vec()
        }),
        (0..6_u32, 0..4_u8, any::<u64>()).prop_map(|(call, class, stamp)| renewal(call, class, stamp)),
        (0..6_u32, 0..4_u8).prop_map(|(call, class)| release(call, class)),
        (0..4_u16, 0..6_u32).prop_map(|(slot, id)| SessionBody::release_all(Slot(slot), id).to_vec()),
        message()
            .prop_map(|message| [&SessionBody::message_prefix(2)[..], &message[..message.len().min(400)]].concat()),
    ];
    let other = (0..20_u8, body).prop_map(|(kind, body)| {
        let mut out = [0; 512];
        let frame = match kind {
            0..=13 => Frame::Session(&body),
            14..=16 => Frame::Ping,
            17 => Frame::Pong,
            18 => Frame::Hello(&body),
            _ => Frame::Close(1),
        };
        let length = frame::encode(&frame, 0, &mut out);
        out[..length].to_vec()
    });
    prop_oneof![4 => chunked, 1 => other]
}

fn renewal(call: u32, class: u8, stamp: u64) -> Vec<u8> {
    let since = Duration::from_micros(stamp & 0xFFFF);
    let class = Priority::from_wire(class).unwrap();
    SessionBody::renewal(&Renewal { call, class, stamp, since, age: Duration::ZERO }).to_vec()
}

fn release(call: u32, class: u8) -> Vec<u8> {
    SessionBody::release(&Release { call, class: Priority::from_wire(class).unwrap() }).to_vec()
}

/// A pair in which each end has published one thing of each kind and calls the other.
fn busy_pair() -> Pair {
    let mut pair = Pair::live();
    for side in [&mut pair.manager, &mut pair.agv] {
        side.offer("now(x: int) -> (x: int)", |_| Ok(()));
        side.offer_held("held()");
        side.offer_leased("go()", Duration::from_millis(200));
        side.publish();
    }
    pair.settle();
    for side in [&mut pair.manager, &mut pair.agv] {
        side.call("now", &x(1)).unwrap();
        side.call("held", &none()).unwrap();
        side.call("go", &none()).unwrap();
    }
    pair
}

proptest! {
    #[test]
    fn a_peer_that_says_anything_does_no_harm(
        frames in prop::collection::vec((frames(), any::<bool>(), 0..400_u64), 1..30),
        damage in prop::option::of((any::<prop::sample::Index>(), any::<prop::sample::Index>(), any::<u8>())),
    ) {
        let mut pair = busy_pair();
        let mut frames = frames;
        if let Some((frame, at, byte)) = damage {
            let frame = frame.index(frames.len());
            let at = at.index(frames[frame].0.len());
            frames[frame].0[at] = byte;
        }
        for (bytes, manager, millis) in frames {
            let side = if manager { &mut pair.manager } else { &mut pair.agv };
            side.hear(&bytes);
            pair.run(Duration::from_millis(millis));
        }
    }

    #[test]
    fn a_datagram_that_says_anything_does_no_harm(
        bodies in prop::collection::vec((message(), 0..6_u8, any::<bool>()), 1..30),
    ) {
        let mut pair = busy_pair();
        for (message, priority, whole) in bodies {
            let body = [&SessionBody::message_prefix(priority)[..], &message].concat();
            let nonce = pair.agv.session.nonce();
            pair.agv.hear_datagram(nonce, if whole { &body } else { &message });
            pair.run(Duration::from_millis(50));
        }
        prop_assert!(pair.agv.session.is_live(), "a datagram can be anybody's: it ends nothing");
    }
}

#[test]
fn a_reply_that_does_not_fit_its_signature_is_an_error_of_the_call_only() {
    let mut pair = Pair::with_position();
    let mut pos = parameters(|parameters| parameters.add_int("position", 2).unwrap());
    pos.set_value("position", [7, 7]).unwrap();
    let id = pair.manager.call("pos_info", &pos).unwrap();
    let reply = [&encode_reply(id.0, Ok(()))[..], &[1, 2, 3]].concat();
    pair.manager.hear_message(&reply, Priority::Normal);
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::ResultLost);
    assert!(pair.manager.session.is_live());
}

#[test]
fn a_signature_of_a_later_version_is_passed_over_and_told() {
    let mut pair = Pair::live();
    pair.manager.hear_message(&control(&publish(0, 0, KNOWN[2])), Priority::High);
    pair.manager.hear_message(&control(&Control::ListEnd { serial: 9 }), Priority::High);
    pair.settle();
    assert!(pair.manager.session.is_live() && pair.manager.session.their_function_list().is_empty());
    assert_eq!(pair.manager.session.counters().value(LinkCounter::FunctionsSkipped), 1);
    assert!(pair.agv.has(&Event::Acknowledged { serial: 9, skipped: 1 }));
}

#[test]
fn what_must_be_understood_and_is_not_ends_the_link() {
    let mut pair = Pair::live();
    pair.manager.hear_message(&any_items(&[(0x8700, &[])]), Priority::High);
    pair.settle();
    assert!(pair.manager.has(&Event::Closed(CloseReason::Protocol)));
}

#[test]
fn what_a_later_version_says_beside_it_is_counted_and_passed_over() {
    let mut pair = Pair::live();
    let skipped = |pair: &Pair| pair.manager.session.counters().value(LinkCounter::ItemsSkipped);
    let withdrawn = |slot| (2, slot);
    let (one, two) = (withdrawn(&[1][..]), withdrawn(&[2][..]));
    pair.manager.hear_message(&any_items(&[(0x700, &[7]), one, (0x701, &[]), two]), Priority::High);
    pair.settle();
    assert_eq!(skipped(&pair), 2);
    // A frame of kind 0x40, and a session body of kind 200.
    pair.manager.hear(&[3, 0, 0x40, 1, 2, 2, 0, 6, 200]);
    pair.settle();
    assert_eq!(skipped(&pair), 3);
    assert_eq!(pair.manager.session.counters().value(LinkCounter::DatagramsDropped), 1);
    assert!(pair.manager.session.is_live());
}

#[test]
fn nothing_follows_what_a_program_is_told() {
    let mut pair = Pair::live();
    pair.manager.hear_message(&any_items(&[(3, &[9]), (2, &[1])]), Priority::High);
    pair.settle();
    assert!(pair.manager.has(&Event::ListChanged));
    assert!(pair.manager.has(&Event::Closed(CloseReason::Protocol)));
}

#[test]
fn frames_of_a_later_version_are_no_sign_of_life() {
    let mut pair = Pair::live();
    pair.agv.net.frozen = true;
    pair.agv.net.datagrams = Datagrams::Lost;
    for _ in 0..20 {
        pair.manager.hear(&[2, 0, 0x7F, 1]);
        pair.run(Duration::from_millis(500));
    }
    assert!(pair.manager.has(&Event::Closed(CloseReason::Silent)));
}

#[test]
fn the_known_signatures_are_what_they_seem() {
    assert_eq!(Definition::parse("f()").unwrap().as_bytes(), KNOWN[0]);
    assert_eq!(Definition::parse("ask(x: int) -> (x: int)").unwrap().as_bytes(), KNOWN[1]);
}
