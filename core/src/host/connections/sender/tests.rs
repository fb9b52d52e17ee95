#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]

use std::vec::Vec;

use proptest::prelude::*;

use super::super::harness::{self, Item, Numbered, Wire, link, pattern, read};
use super::super::{Link, LinkCounter};
use super::URGENT_BYTES;
use crate::config::{EMERGENCY_BYTES, MINIMUM_CHUNK_BYTES, Priority};
use crate::error::{CloseReason, Error, Limit};
use crate::host::frame::{self, Frame};
use crate::host::secure::{Plain, Seal};
use crate::storage::{Boxed, LEFT_BY_SENDING, Pool};

/// As many buffers for messages to be sent, and those that these leave.
fn pool(count: usize, size: usize) -> Pool<Boxed> {
    harness::pool(count + LEFT_BY_SENDING, size)
}

/// Buffers that messages to be sent may still take.
fn spare(pool: &Pool<Boxed>) -> usize {
    pool.free().saturating_sub(LEFT_BY_SENDING)
}

fn send<C: Seal>(
    link: &mut Link<Boxed, C>,
    wire: &mut Wire,
    pool: &mut Pool<Boxed>,
    priority: Priority,
    message: &[u8],
) -> Result<(), Error> {
    link.send_message(wire, pool, priority, message.len(), false, |writer| writer.put(message))
}

fn drain<C: Seal>(link: &mut Link<Boxed, C>, wire: &mut Wire, pool: &mut Pool<Boxed>) {
    wire.budget = usize::MAX;
    link.flush(wire, pool).unwrap();
    assert!(!link.wants_to_write());
}

fn priorities(items: &[Item]) -> Vec<Priority> {
    items.iter().filter_map(|item| if let Item::Message(priority, _) = item { Some(*priority) } else { None }).collect()
}

#[test]
fn a_link_that_keeps_up_keeps_nothing() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire::open(), pool(1, 9000));
    let bytes = pattern(1, 5000);
    send(&mut link, &mut wire, &mut pool, Priority::Normal, &bytes).unwrap();
    assert_eq!((spare(&pool), link.queued(), link.wants_to_write()), (1, 0, false));
    assert_eq!(read(Plain, &wire.bytes), [Item::Message(Priority::Normal, bytes)]);
}

#[test]
fn a_short_message_needs_no_buffer_while_the_network_takes_it() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire::open(), pool(0, 9000));
    let (short, long) = (pattern(1, MINIMUM_CHUNK_BYTES - 8), pattern(2, MINIMUM_CHUNK_BYTES - 7));
    send(&mut link, &mut wire, &mut pool, Priority::Normal, &short).unwrap();
    assert_eq!(send(&mut link, &mut wire, &mut pool, Priority::Normal, &long), Err(Error::Full(Limit::Buffers)));
    assert_eq!((link.queued(), link.wants_to_write()), (0, false));
    assert_eq!(read(Plain, &wire.bytes), [Item::Message(Priority::Normal, short)]);
}

#[test]
fn a_short_message_that_the_network_does_not_take_is_refused_without_a_buffer() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire::default(), pool(0, 9000));
    assert_eq!(send(&mut link, &mut wire, &mut pool, Priority::Low, b"x"), Err(Error::Full(Limit::Buffers)));
    assert_eq!((link.queued(), link.wants_to_write()), (0, false));
    assert_eq!(link.counters.value(LinkCounter::SendRefused), 1);
    drain(&mut link, &mut wire, &mut pool);
    assert_eq!(read(Plain, &wire.bytes), []);
}

#[test]
fn a_short_message_that_was_begun_is_finished_from_the_links_own_bytes() {
    for budget in 1..16 {
        let (mut link, mut wire, mut pool) = (link(Plain), Wire { budget, ..Wire::default() }, pool(1, 9000));
        send(&mut link, &mut wire, &mut pool, Priority::Low, b"12345678").unwrap();
        assert_eq!((spare(&pool), link.queued()), (1, 16 - budget));
        send(&mut link, &mut wire, &mut pool, Priority::Emergency, b"stop").unwrap();
        send(&mut link, &mut wire, &mut pool, Priority::High, b"high").unwrap();
        drain(&mut link, &mut wire, &mut pool);
        let order = [Priority::Low, Priority::Emergency, Priority::High];
        assert_eq!(priorities(&read(Plain, &wire.bytes)), order, "{budget} bytes at first");
    }
}

#[test]
fn what_waits_goes_out_by_class() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire::default(), pool(3, 9000));
    for priority in [Priority::Low, Priority::Normal, Priority::High, Priority::Normal] {
        send(&mut link, &mut wire, &mut pool, priority, b"x").unwrap();
    }
    assert_eq!(spare(&pool), 0);
    drain(&mut link, &mut wire, &mut pool);
    let order = [Priority::High, Priority::Normal, Priority::Normal, Priority::Low];
    assert_eq!(priorities(&read(Plain, &wire.bytes)), order);
    assert_eq!(spare(&pool), 3);
}

#[test]
fn a_message_that_was_begun_is_finished_before_a_higher_one() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire { budget: 10, ..Wire::default() }, pool(2, 9000));
    send(&mut link, &mut wire, &mut pool, Priority::Low, &pattern(1, 3000)).unwrap();
    send(&mut link, &mut wire, &mut pool, Priority::High, b"high").unwrap();
    drain(&mut link, &mut wire, &mut pool);
    assert_eq!(priorities(&read(Plain, &wire.bytes)), [Priority::Low, Priority::High]);
}

#[test]
fn a_message_that_was_not_begun_is_overtaken() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire { budget: 1030, ..Wire::default() }, pool(2, 9000));
    send(&mut link, &mut wire, &mut pool, Priority::Low, &pattern(1, 1000)).unwrap();
    send(&mut link, &mut wire, &mut pool, Priority::Low, &pattern(2, 1000)).unwrap();
    send(&mut link, &mut wire, &mut pool, Priority::Low, &pattern(3, 1000)).unwrap();
    send(&mut link, &mut wire, &mut pool, Priority::High, b"high").unwrap();
    drain(&mut link, &mut wire, &mut pool);
    let order = [Priority::Low, Priority::Low, Priority::High, Priority::Low];
    assert_eq!(priorities(&read(Plain, &wire.bytes)), order);
}

/// Bytes between an emergency's acceptance and its last byte on a network that takes `step` bytes at a time, where so much
/// may be sealed `ahead`.
fn emergency_behind_a_long_message<C: Seal + Default>(step: usize, ahead: usize) -> usize {
    let wire = Wire { budget: step, ahead, ..Wire::default() };
    let (mut link, mut wire, mut pool) = (link(C::default()), wire, pool(1, 9000));
    let (long, stop) = (pattern(1, 8000), pattern(2, EMERGENCY_BYTES));
    send(&mut link, &mut wire, &mut pool, Priority::Normal, &long).unwrap();
    let before = wire.bytes.len();
    send(&mut link, &mut wire, &mut pool, Priority::Emergency, &stop).unwrap();
    while link.wants_to_write() {
        wire.budget += step;
        link.flush(&mut wire, &mut pool).unwrap();
    }
    let stop = Item::Message(Priority::Emergency, stop);
    let mut items = [stop.clone(), Item::Message(Priority::Normal, long)];
    if link.cipher.overhead() > 0 && ahead > 9_000 {
        // All of the message was sealed before the emergency came.
        items.reverse();
    }
    assert!(read(C::default(), &wire.bytes) == items, "{step} bytes a step, {ahead} ahead");
    assert_eq!(spare(&pool), 1);
    let ends = (before..=wire.bytes.len()).find(|&end| read(C::default(), &wire.bytes[..end]).contains(&stop));
    ends.unwrap() - before
}

#[test]
fn an_emergency_waits_for_one_chunk_at_most() {
    for step in [1, 7, 100, 1026, 3000] {
        let bytes = emergency_behind_a_long_message::<Plain>(step, 0);
        assert!(bytes <= 1026 + EMERGENCY_BYTES + 8, "{bytes} bytes at {step} a step");
        let bytes = emergency_behind_a_long_message::<Numbered>(step, 0);
        assert!(bytes <= 1026 + EMERGENCY_BYTES + 8 + 16, "{bytes} sealed bytes at {step} a step");
    }
}

#[test]
fn an_emergency_waits_for_what_the_port_lets_be_sealed_ahead_and_in_plain_mode_for_one_chunk() {
    for step in [1, 7, 100, 1026, 3000] {
        for ahead in [1, 2_000, 4_000, 64_000] {
            let bytes = emergency_behind_a_long_message::<Plain>(step, ahead);
            assert!(bytes <= 1026 + EMERGENCY_BYTES + 8, "{bytes} bytes at {step} a step");
            let bytes = emergency_behind_a_long_message::<Numbered>(step, ahead);
            assert!(
                bytes <= ahead.max(1026) + EMERGENCY_BYTES + 8 + 16,
                "{bytes} bytes at {step} a step, {ahead} ahead"
            );
        }
    }
}

#[test]
fn a_message_that_may_be_sealed_ahead_is_one_write() {
    for (ahead, largest) in [(0, 1026), (3000, 2 * 1026), (8000, 5104)] {
        let (mut link, mut wire, mut pool) = (link(Numbered::default()), Wire::open(), pool(1, 9000));
        wire.ahead = ahead;
        send(&mut link, &mut wire, &mut pool, Priority::Normal, &pattern(1, 5000)).unwrap();
        assert_eq!(wire.offered, largest, "{ahead} bytes ahead");
    }
}

#[test]
fn a_message_is_refused_whole_when_it_does_not_fit_now() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire::default(), pool(1, 2000));
    send(&mut link, &mut wire, &mut pool, Priority::Normal, &pattern(1, 900)).unwrap();
    let queued = link.queued();
    let refused = send(&mut link, &mut wire, &mut pool, Priority::Normal, &pattern(2, 1100));
    assert_eq!(refused, Err(Error::Full(Limit::SendQueue)));
    assert_eq!(send(&mut link, &mut wire, &mut pool, Priority::High, b"x"), Err(Error::Full(Limit::Buffers)));
    assert_eq!((link.queued(), link.counters.value(LinkCounter::SendRefused)), (queued, 2));
    drain(&mut link, &mut wire, &mut pool);
    assert_eq!(read(Plain, &wire.bytes), [Item::Message(Priority::Normal, pattern(1, 900))]);
    send(&mut link, &mut wire, &mut pool, Priority::Normal, &pattern(2, 1100)).unwrap();
}

#[test]
fn a_message_that_no_buffer_holds_is_too_large() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire::open(), pool(1, 2000));
    let refused = send(&mut link, &mut wire, &mut pool, Priority::Normal, &pattern(1, 2000));
    assert_eq!(refused, Err(Error::TooLarge { limit: 2000 - 12 }));
    assert_eq!((spare(&pool), wire.bytes.len()), (1, 0));
}

#[test]
fn an_emergency_has_room_when_everything_else_is_full() {
    let (mut link, mut wire, mut pool) = (link(Numbered::default()), Wire::default(), pool(0, 0));
    while link.send_frame(&Frame::Session(&[7; 20])) {}
    assert_eq!(link.counters.value(LinkCounter::FramesWithheld), 1);
    let stop = pattern(2, EMERGENCY_BYTES);
    send(&mut link, &mut wire, &mut pool, Priority::Emergency, &stop).unwrap();
    drain(&mut link, &mut wire, &mut pool);
    assert_eq!(read(Numbered::default(), &wire.bytes).last(), Some(&Item::Message(Priority::Emergency, stop)));
    let longer = pattern(2, EMERGENCY_BYTES + 1);
    let refused = send(&mut link, &mut wire, &mut pool, Priority::Emergency, &longer);
    assert_eq!(refused, Err(Error::TooLarge { limit: EMERGENCY_BYTES as u32 }));
}

#[test]
fn a_link_that_ends_gives_every_buffer_back() {
    let (mut link, mut wire, mut pool) = (link(Plain), Wire { budget: 100, ..Wire::default() }, pool(3, 9000));
    for priority in [Priority::Low, Priority::Normal, Priority::High] {
        send(&mut link, &mut wire, &mut pool, priority, &pattern(1, 500)).unwrap();
    }
    assert_eq!(spare(&pool), 0);
    link.release(&mut pool);
    assert_eq!((spare(&pool), link.queued()), (3, 0));
}

/// Bytes of the queues that are sealed and not written.
fn sealed_ahead<C: Seal>(link: &Link<Boxed, C>) -> usize {
    link.sender.queues.iter().flatten().map(|queue| queue.sealed - queue.start).sum()
}

/// Sends, flushes and stalls in any order; returns what was accepted.
fn exercise<C: Seal>(link: &mut Link<Boxed, C>, wire: &mut Wire, steps: &[(u8, usize)]) -> Vec<Item> {
    let (mut pool, mut accepted) = (pool(2, 4000), Vec::new());
    for &(kind, amount) in steps {
        match Priority::from_wire(kind) {
            Some(priority) => {
                let limit = if priority == Priority::Emergency { EMERGENCY_BYTES } else { 3000 };
                let message = pattern(accepted.len() as u8, amount.min(limit));
                if send(link, wire, &mut pool, priority, &message).is_ok() {
                    accepted.push(Item::Message(priority, message));
                }
            }
            None => {
                wire.budget = amount;
                link.flush(wire, &mut pool).unwrap();
            }
        }
        let most = if link.sender.chunking.overhead == 0 { 0 } else { wire.ahead.max(1026) };
        let ahead = sealed_ahead(link);
        assert!(ahead <= most.max(1026), "{ahead} bytes are sealed ahead of {most}");
    }
    drain(link, wire, &mut pool);
    assert_eq!(spare(&pool), 2);
    accepted
}

fn of_class(items: &[Item], class: Priority) -> Vec<&Item> {
    items.iter().filter(|item| matches!(item, Item::Message(priority, _) if *priority == class)).collect()
}

proptest! {
    #[test]
    fn what_is_accepted_arrives_whole_and_in_order_of_its_class(
        steps in prop::collection::vec((0..7_u8, prop_oneof![0..300_usize, 0..3000_usize]), 1..40),
        ahead in prop_oneof![Just(0), 0..6000_usize, Just(64 * 1024)],
    ) {
        let (mut plain, mut wire) = (link(Plain), Wire::default());
        let accepted = exercise(&mut plain, &mut wire, &steps);
        let arrived = read(Plain, &wire.bytes);
        let (mut sealed, mut wire) = (link(Numbered::default()), Wire { ahead, ..Wire::default() });
        let accepted_sealed = exercise(&mut sealed, &mut wire, &steps);
        let arrived_sealed = read(Numbered::default(), &wire.bytes);
        for class in Priority::ALL {
            prop_assert_eq!(of_class(&arrived, class), of_class(&accepted, class));
            prop_assert_eq!(of_class(&arrived_sealed, class), of_class(&accepted_sealed, class));
        }
        prop_assert_eq!(arrived.len(), accepted.len());
        prop_assert_eq!(arrived_sealed.len(), accepted_sealed.len());
        prop_assert!(wire.offered <= ahead.max(URGENT_BYTES).max(1026));
    }
}

#[test]
fn framing_is_the_same_however_little_the_network_takes() {
    let bytes = pattern(1, 5000);
    let streams: Vec<Vec<u8>> = [1, 3, 1026, usize::MAX]
        .into_iter()
        .map(|step| {
            let (mut link, mut wire, mut pool) = (link(Plain), Wire { budget: step, ..Wire::default() }, pool(1, 9000));
            send(&mut link, &mut wire, &mut pool, Priority::Normal, &bytes).unwrap();
            while link.wants_to_write() {
                wire.budget = step;
                link.flush(&mut wire, &mut pool).unwrap();
            }
            wire.bytes
        })
        .collect();
    assert!(streams.iter().all(|stream| *stream == streams[0]));
}

/// A cipher whose tags tell the key, which a turn changes.
#[derive(Default)]
struct Turning {
    key: u8,
}

impl Seal for Turning {
    fn overhead(&self) -> usize {
        16
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        let tag = frame.len() - 16;
        frame[tag..].fill(self.key);
        Ok(())
    }

    fn turn(&mut self) -> Result<(), CloseReason> {
        self.key += 1;
        Ok(())
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        Ok(frame)
    }
}

/// (kind, key) of each frame.
fn kinds_and_keys(mut bytes: &[u8]) -> Vec<(u8, u8)> {
    let mut seen = Vec::new();
    while let Some(length) = frame::first_frame_length(bytes) {
        seen.push((bytes[frame::HEADER_BYTES], bytes[length - 1]));
        bytes = &bytes[length..];
    }
    seen
}

#[test]
fn keys_change_right_behind_the_turn_whatever_waits() {
    for (step, ahead) in [1, 7, 100, 1_100, 20_000].into_iter().flat_map(|step| [(step, 0), (step, 2_500)]) {
        let wire = Wire { ahead, ..Wire::default() };
        let (mut link, mut wire, mut pool) = (link(Turning::default()), wire, pool(1, 9000));
        send(&mut link, &mut wire, &mut pool, Priority::Normal, &pattern(1, 5000)).unwrap();
        wire.budget = 1_500;
        link.flush(&mut wire, &mut pool).unwrap();
        assert!(link.send_frames(&[Frame::Proof(&[1; 48]), Frame::TURN, Frame::Confirm(&[2; 33])]));
        while link.queued() > 0 {
            wire.budget = step;
            link.flush(&mut wire, &mut pool).unwrap();
        }
        let seen = kinds_and_keys(&wire.bytes);
        let turn = seen.windows(2).position(|pair| pair == [(7, 0), (7, 0)]).unwrap() + 1;
        assert!(turn > 1 && turn + 2 < seen.len(), "in the middle of the message: {seen:?}");
        assert!(seen[..=turn].iter().all(|(_, key)| *key == 0) && seen[turn + 1..].iter().all(|(_, key)| *key == 1));
        assert_eq!(seen[turn + 1].0, 8, "{seen:?}");
    }
}

#[test]
fn frames_that_belong_together_are_accepted_together_or_not_at_all() {
    let (mut link, mut wire, mut pool) = (link(Turning::default()), Wire::default(), pool(1, 9000));
    let together = [Frame::Proof(&[1; 48]), Frame::TURN, Frame::Confirm(&[2; 33])];
    while link.send_frames(&together) {}
    let queued = link.queued();
    assert!(link.send_frame(&Frame::Ping), "there is room for less");
    assert!(!link.send_frames(&together));
    assert_eq!(link.queued(), queued + 19);
    drain(&mut link, &mut wire, &mut pool);
    assert!(link.send_frames(&together));
}
