#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]

use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::super::harness::{Item, Numbered, Wire, link, message, offer, pattern, plain_frame, pool};
use super::super::{Link, LinkCounter};
use crate::config::{EMERGENCY_BYTES, MINIMUM_CHUNK_BYTES, Priority};
use crate::error::CloseReason;
use crate::host::frame::{ChunkWriter, Frame};
use crate::host::mailman::LinkId;
use crate::host::secure::Plain;
use crate::storage::{Boxed, Buffers};

/// A stream of frames and what it says: messages of any length, an emergency between the chunks of some.
fn stream() -> impl Strategy<Value = (Vec<u8>, Vec<Item>)> {
    let length = prop_oneof![0..20_usize, 300..340_usize, 500..520_usize, 1000..1040_usize, 2000..5000_usize];
    let part = (0..5_u8, length, any::<u8>(), MINIMUM_CHUNK_BYTES..=1024_usize, any::<prop::sample::Index>());
    prop::collection::vec(part, 1..6).prop_map(|parts| {
        let (mut bytes, mut items) = (Vec::new(), Vec::new());
        for (kind, length, seed, chunk, at) in parts {
            let payload = pattern(seed, length);
            match kind {
                0 => {
                    let payload = &payload[..length.min(500)];
                    bytes.extend(plain_frame(&Frame::Session(payload)));
                    items.push(Item::Session(payload.to_vec()));
                }
                1 => {
                    bytes.extend(plain_frame(&Frame::Ping));
                    items.push(Item::Ping);
                }
                2 => interrupted(&payload, chunk, at, &mut bytes, &mut items),
                _ => {
                    bytes.extend(message(Priority::Normal, &payload, chunk));
                    items.push(Item::Message(Priority::Normal, payload));
                }
            }
        }
        (bytes, items)
    })
}

/// A message with an emergency between two of its chunks.
fn interrupted(payload: &[u8], chunk: usize, at: prop::sample::Index, bytes: &mut Vec<u8>, items: &mut Vec<Item>) {
    let emergency = pattern(0xEE, EMERGENCY_BYTES);
    let mut frames: Vec<Vec<u8>> = Vec::new();
    let mut rest = message(Priority::Low, payload, chunk);
    while let Some(length) = crate::host::frame::first_frame_length(&rest) {
        let behind = rest.split_off(length);
        frames.push(rest);
        rest = behind;
    }
    let at = at.index(frames.len());
    frames.insert(at, message(Priority::Emergency, &emergency, 1024));
    bytes.extend(frames.concat());
    items.push(Item::Message(Priority::Emergency, emergency));
    items.push(Item::Message(Priority::Low, payload.to_vec()));
}

/// Reads `bytes` cut at `cuts`; all buffers have come back at the end.
fn read_in_pieces(bytes: &[u8], cuts: &[usize]) -> Vec<Item> {
    let (mut link, mut pool, mut items) = (link(Plain), pool(1, 8300), Vec::new());
    let mut from = 0;
    for to in cuts.iter().copied().chain([bytes.len()]) {
        assert!(offer(&mut link, &mut pool, &mut bytes[from..to].to_vec(), &mut items).unwrap());
        from = to;
    }
    assert_eq!(pool.free(), 1);
    items
}

proptest! {
    #[test]
    fn any_two_pieces_say_the_same(stream in stream()) {
        let (bytes, items) = stream;
        for at in 0..=bytes.len() {
            prop_assert_eq!(&read_in_pieces(&bytes, &[at]), &items, "cut at {}", at);
        }
    }

    #[test]
    fn pieces_of_one_length_say_the_same(stream in stream(), piece in 1..700_usize) {
        let (bytes, items) = stream;
        let cuts: Vec<usize> = (1..bytes.len()).filter(|at| at % piece == 0).collect();
        prop_assert_eq!(read_in_pieces(&bytes, &cuts), items);
    }

    #[test]
    fn random_bytes_end_the_link_or_wait_and_never_leak(
        bytes in prop::collection::vec(any::<u8>(), 0..3000),
        piece in 1..600_usize,
    ) {
        hostile(&bytes, piece);
    }

    #[test]
    fn a_changed_byte_ends_the_link_or_is_data_and_never_leaks(
        stream in stream(), at in any::<prop::sample::Index>(), change in 1..=255_u8, piece in 1..600_usize,
    ) {
        let (mut bytes, _) = stream;
        let at = at.index(bytes.len());
        bytes[at] ^= change;
        hostile(&bytes, piece);
    }

    #[test]
    fn an_empty_pool_pauses_and_loses_no_byte(stream in stream(), piece in 1..2000_usize) {
        let (bytes, items) = stream;
        let (mut link, mut pool, mut read) = (link(Plain), pool(1, 8300), Vec::new());
        for piece in bytes.chunks(piece) {
            let mut rest = piece.to_vec();
            let others = pool.take();
            let paused = !offer(&mut link, &mut pool, &mut rest, &mut read).unwrap();
            prop_assert!(!paused || others.is_some(), "a link with a buffer goes on");
            others.into_iter().for_each(|buffer| pool.give(buffer));
            prop_assert!(offer(&mut link, &mut pool, &mut rest, &mut read).unwrap());
            prop_assert!(rest.is_empty());
        }
        prop_assert_eq!(read, items);
        prop_assert_eq!(pool.free(), 1);
    }
}

#[test]
fn sealed_frames_are_opened_in_whatever_pieces_they_come() {
    let (mut sender, mut wire, mut buffers) = (link(Numbered::default()), Wire::open(), pool(2, 9000));
    let payload = pattern(1, 2500);
    for _ in 0..2 {
        let write = |writer: &mut ChunkWriter<'_>| writer.put(&payload);
        sender.send_message(&mut wire, &mut buffers, Priority::Normal, payload.len(), false, write).unwrap();
    }
    for at in 0..=wire.bytes.len() {
        let (mut link, mut items) = (link(Numbered::default()), Vec::new());
        let (mut first, mut rest) = (wire.bytes[..at].to_vec(), wire.bytes[at..].to_vec());
        assert!(offer(&mut link, &mut buffers, &mut first, &mut items).unwrap());
        assert!(offer(&mut link, &mut buffers, &mut rest, &mut items).unwrap());
        assert_eq!(items, vec![Item::Message(Priority::Normal, payload.clone()); 2], "cut at {at}");
    }
}

/// What a sender that seals ahead writes for a message of `length` bytes, with an emergency behind it.
fn sealed_stream(length: usize) -> (Vec<u8>, Vec<Item>) {
    let (mut sender, mut buffers) = (link(Numbered::default()), pool(2, 9000));
    let mut wire = Wire { ahead: 64 * 1024, ..Wire::open() };
    let (bulk, stop) = (pattern(1, length), pattern(2, 100));
    for (priority, payload) in [(Priority::Normal, &bulk), (Priority::Emergency, &stop), (Priority::Normal, &bulk)] {
        let write = |writer: &mut ChunkWriter<'_>| writer.put(payload);
        sender.send_message(&mut wire, &mut buffers, priority, payload.len(), false, write).unwrap();
    }
    let items = [(Priority::Normal, &bulk), (Priority::Emergency, &stop), (Priority::Normal, &bulk)];
    (wire.bytes, items.map(|(priority, payload)| Item::Message(priority, payload.clone())).to_vec())
}

proptest! {
    /// One read brings several frames, the end of one and the beginning of another.
    #[test]
    fn all_frames_of_a_read_are_opened_wherever_it_ends(
        length in 0..8000_usize, cuts in prop::collection::vec(any::<prop::sample::Index>(), 0..8),
    ) {
        let (bytes, expected) = sealed_stream(length);
        let mut cuts: Vec<usize> = cuts.iter().map(|at| at.index(bytes.len())).chain([0, bytes.len()]).collect();
        cuts.sort_unstable();
        let (mut link, mut pool, mut items) = (link(Numbered::default()), pool(1, 9000), Vec::new());
        for piece in cuts.windows(2) {
            let mut read = bytes[piece[0]..piece[1]].to_vec();
            prop_assert!(offer(&mut link, &mut pool, &mut read, &mut items).unwrap());
            prop_assert!(read.is_empty());
        }
        prop_assert_eq!(items, expected);
        prop_assert_eq!(pool.free(), 1);
    }

    /// What came before the changed frame counts, nothing behind it does, and the link ends.
    #[test]
    fn a_changed_frame_in_the_middle_of_a_read_ends_the_link(
        length in 1..8000_usize, at in any::<prop::sample::Index>(), change in 1..=255_u8,
    ) {
        let (mut bytes, expected) = sealed_stream(length);
        let frames = frame_ends(&bytes);
        let at = at.index(frames.len());
        // The last byte of the frame, which is its tag's.
        bytes[frames[at] - 1] ^= change;
        let (mut link, mut pool, mut items) = (link(Numbered::default()), pool(1, 9000), Vec::new());
        prop_assert_eq!(offer(&mut link, &mut pool, &mut bytes, &mut items), Err(CloseReason::Protocol));
        prop_assert!(items.len() < expected.len());
        prop_assert_eq!(&items[..], &expected[..items.len()]);
        link.release(&mut pool);
        prop_assert_eq!(pool.free(), 1);
    }
}

fn frame_ends(bytes: &[u8]) -> Vec<usize> {
    let (mut ends, mut end) = (Vec::new(), 0);
    while let Some(length) = crate::host::frame::first_frame_length(&bytes[end..]) {
        end += length;
        ends.push(end);
    }
    ends
}

fn hostile(bytes: &[u8], piece: usize) {
    let (mut link, mut pool, mut items) = (link(Plain), pool(1, 8300), Vec::new());
    for piece in bytes.chunks(piece) {
        if offer(&mut link, &mut pool, &mut piece.to_vec(), &mut items).is_err() {
            break;
        }
    }
    link.release(&mut pool);
    assert_eq!(pool.free(), 1);
}

fn outcome(link: &mut Link<Boxed, Plain>, bytes: &[u8]) -> Result<Vec<Item>, CloseReason> {
    let mut items = Vec::new();
    offer(link, &mut pool(1, 8300), &mut bytes.to_vec(), &mut items).map(|_| items)
}

#[test]
fn a_frame_or_message_above_the_limit_ends_the_link() {
    let longest = message(Priority::Normal, &pattern(1, 8192), 1024);
    assert_eq!(outcome(&mut link(Plain), &longest).unwrap().len(), 1);
    let message_too_long = message(Priority::Normal, &pattern(1, 8193), 1024);
    assert_eq!(outcome(&mut link(Plain), &message_too_long), Err(CloseReason::Oversize));
    let frame_too_long = message(Priority::Normal, &pattern(1, 2000), 1025);
    assert_eq!(outcome(&mut link(Plain), &frame_too_long), Err(CloseReason::Oversize));
    // The header alone tells: nothing is collected.
    assert_eq!(outcome(&mut link(Plain), &1025_u16.to_le_bytes()), Err(CloseReason::Oversize));
}

#[test]
fn a_frame_that_no_buffer_holds_ends_the_link() {
    let mut small = Link::<Boxed, _>::new(LinkId(0), Plain, vec![0; 512].into_boxed_slice(), 4096, 100);
    let mut items = Vec::new();
    let mut bytes = message(Priority::Normal, &pattern(1, 3000), 4096);
    bytes.truncate(700);
    assert_eq!(offer(&mut small, &mut pool(1, 640), &mut bytes, &mut items), Err(CloseReason::Oversize));
}

#[test]
fn a_limit_that_is_lowered_still_takes_what_is_on_its_way() {
    let mut link = link(Plain);
    link.set_message_limit(10);
    assert_eq!(outcome(&mut link, &message(Priority::Normal, &pattern(1, 100), 1024)).unwrap().len(), 1);
    link.set_message_limit(8200);
    assert_eq!(outcome(&mut link, &message(Priority::Normal, &pattern(1, 8200), 1024)).unwrap().len(), 1);
}

#[test]
fn chunks_out_of_their_order_end_the_link() {
    let whole = message(Priority::Normal, &pattern(1, 1500), 1024);
    let length = crate::host::frame::first_frame_length(&whole).unwrap();
    let (first, second) = whole.split_at(length);
    let other = message(Priority::High, &pattern(2, 1500), 1024);
    let wrong: [&[&[u8]]; 4] = [&[second], &[first, first], &[first, &other[..length]], &[first, &other[length..]]];
    for frames in wrong {
        assert_eq!(outcome(&mut link(Plain), &frames.concat()), Err(CloseReason::Protocol));
    }
}

#[test]
fn a_total_that_the_chunks_do_not_have_ends_the_link() {
    let mut whole = message(Priority::Normal, b"four", 1024);
    whole[4] = 5;
    assert_eq!(outcome(&mut link(Plain), &whole), Err(CloseReason::Protocol));
    let mut short = message(Priority::Normal, &pattern(1, 1500), 1024);
    short[4] = short[4].wrapping_sub(1);
    assert_eq!(outcome(&mut link(Plain), &short), Err(CloseReason::Protocol));
}

#[test]
fn each_length_of_a_frame_waits_or_ends_the_link() {
    for length in 0..=u16::MAX {
        let outcome = outcome(&mut link(Plain), &length.to_le_bytes());
        match length {
            0 => assert_eq!(outcome, Err(CloseReason::Protocol)),
            1..=1024 => assert_eq!(outcome, Ok(Vec::new()), "{length}"),
            _ => assert_eq!(outcome, Err(CloseReason::Oversize), "{length}"),
        }
    }
}

#[test]
fn each_total_waits_or_ends_the_link() {
    let whole = message(Priority::Normal, b"four", 1024);
    let mut first = message(Priority::Normal, &pattern(1, 1500), 1024);
    first.truncate(crate::host::frame::first_frame_length(&first).unwrap());
    let held = first.len() as u32 - 8;
    let totals = (0..10_000).chain([15, 16, 31].map(|bits| (1 << bits) - 1)).chain([1 << 16, 1 << 31, u32::MAX]);
    for total in totals {
        let with = |frame: &[u8]| {
            let mut frame = frame.to_vec();
            frame[4..8].copy_from_slice(&total.to_le_bytes());
            outcome(&mut link(Plain), &frame)
        };
        match total {
            4 => assert_eq!(with(&whole).unwrap().len(), 1),
            0..=8192 => assert_eq!(with(&whole), Err(CloseReason::Protocol), "{total}"),
            _ => assert_eq!(with(&whole), Err(CloseReason::Oversize), "{total}"),
        }
        match total {
            0..=8192 if total <= held => assert_eq!(with(&first), Err(CloseReason::Protocol), "{total}"),
            0..=8192 => assert_eq!(with(&first), Ok(Vec::new()), "{total}"),
            _ => assert_eq!(with(&first), Err(CloseReason::Oversize), "{total}"),
        }
    }
}

/// Each byte of a stream of all kinds of frames, changed to each other byte.
#[test]
fn each_changed_byte_ends_the_link_or_is_data_and_never_leaks() {
    let frames = [
        plain_frame(&Frame::Ping),
        plain_frame(&Frame::Session(b"alive")),
        message(Priority::High, b"list", 1024),
        message(Priority::Low, &pattern(1, MINIMUM_CHUNK_BYTES), MINIMUM_CHUNK_BYTES),
        message(Priority::Emergency, b"stop", 1024),
    ];
    let bytes = frames.concat();
    for at in 0..bytes.len() {
        for change in 1..=255 {
            let mut changed = bytes.clone();
            changed[at] ^= change;
            hostile(&changed, 100);
        }
    }
}

#[test]
fn half_a_frame_waits_for_the_rest() {
    let (mut link, mut pool, mut items) = (link(Plain), pool(1, 8300), Vec::new());
    let mut half = message(Priority::Normal, &pattern(1, 900), 1024);
    half.truncate(800);
    assert!(offer(&mut link, &mut pool, &mut half, &mut items).unwrap());
    assert!(half.is_empty() && items.is_empty());
    assert_eq!(pool.free(), 0);
    link.release(&mut pool);
    assert_eq!(pool.free(), 1);
}

#[test]
fn a_pause_is_counted_and_two_links_share_one_buffer() {
    let mut pool = pool(1, 8300);
    let (mut one, mut other) = (link(Plain), link(Plain));
    let (mut read, mut waiting) = (Vec::new(), Vec::new());
    let bytes = message(Priority::Normal, &pattern(1, 3000), 1024);
    let (mut first, mut rest) = (bytes[..700].to_vec(), bytes[700..].to_vec());
    let mut second = bytes.clone();
    assert!(offer(&mut one, &mut pool, &mut first, &mut read).unwrap());
    assert!(!offer(&mut other, &mut pool, &mut second, &mut waiting).unwrap());
    assert_eq!(other.counters.value(LinkCounter::ReadPaused), 1);
    assert!(offer(&mut one, &mut pool, &mut rest, &mut read).unwrap());
    assert!(offer(&mut other, &mut pool, &mut second, &mut waiting).unwrap());
    assert_eq!(read, waiting);
    assert_eq!(pool.free(), 1);
}
