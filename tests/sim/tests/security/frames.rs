//! Changed, cut, moved, left out and repeated frames and datagrams.

use cara_core::error::CloseReason;
use cara_core::host::connections::LinkCounter;
use cara_core::time::Duration;
use cara_secure::keys::PairKey;

use super::Tally;
use super::ends::{Carried, End, Ends};

/// Hellos, proofs, and the confirmation of the vehicle, which dials.
const OPENING: usize = 5;
/// Random numbers of the run that is recorded, and of the one that is attacked.
const RECORDED: u8 = 1;
const ATTACKED: u8 = 2;

/// Places of hellos, proofs and confirmations. That of the manager comes behind what the vehicle has published.
fn handshake(record: &[Carried]) -> Vec<usize> {
    let confirmed = record.iter().enumerate().skip(OPENING).find(|(_, carried)| !carried.to_manager);
    (0..OPENING).chain(confirmed.map(|(at, _)| at)).collect()
}

/// Runs a conversation in which frame `at` is passed through `change` before it is delivered.
fn with_changed(at: usize, change: impl Fn(&mut Carried)) -> Ends {
    let mut ends = Ends::new(ATTACKED);
    ends.converse(|ends, number, mut carried| {
        if number == at {
            change(&mut carried);
        }
        ends.deliver(&carried);
    });
    ends
}

#[test]
fn a_conversation_is_as_it_should_be() {
    let record = Ends::recorded(RECORDED);
    let handshake = handshake(&record);
    assert!(handshake.len() == 6 && handshake.iter().all(|at| !record[*at].datagram));
    assert_eq!(record[handshake[5]].bytes.len(), 2 + 1 + 33 + 16, "the manager's confirmation");
    assert!(handshake[5] > OPENING, "the vehicle's list comes before it");
    assert!(record.iter().any(|carried| carried.datagram), "keep-alives and an emergency");
    assert!(record.len() > handshake.len() + 8);
}

#[test]
fn every_flipped_bit_of_a_handshake_fails_it() {
    let mut tally = Tally::new("bits of a handshake flipped");
    let record = Ends::recorded(ATTACKED);
    for at in handshake(&record) {
        let original = &record[at];
        for bit in 0..original.bytes.len() * 8 {
            let mut ends = with_changed(at, |carried| carried.bytes[bit / 8] ^= 1 << (bit % 8));
            let victim = ends.end(original.to_manager);
            victim.wait(Duration::from_secs(3));
            tally.note(victim.greeted() || ends.agv.ran + ends.manager.ran > 0);
        }
    }
    tally.close();
}

/// Datagrams whose seal or number was wrong.
fn refused(end: &End) -> u64 {
    end.counted(LinkCounter::DatagramsForged) + end.counted(LinkCounter::DatagramsRepeated)
}

#[test]
fn every_flipped_bit_of_a_sealed_frame_ends_the_link_and_of_a_datagram_changes_nothing() {
    let mut tally = Tally::new("bits of sealed frames and datagrams flipped");
    let record = Ends::recorded(ATTACKED);
    let handshake = handshake(&record);
    for (at, original) in record.iter().enumerate().filter(|(at, _)| !handshake.contains(at)) {
        // The length in front of a frame is not sealed; changing it only moves the frame's end.
        let first = if original.datagram { 24 } else { 2 };
        for bit in first * 8..original.bytes.len() * 8 {
            let mut ends = with_changed(at, |carried| carried.bytes[bit / 8] ^= 1 << (bit % 8));
            let ran = ends.agv.ran;
            let victim = ends.end(original.to_manager);
            let noticed = match original.datagram {
                true => refused(victim) > 0 && victim.session.is_live(),
                false => victim.closed.is_some(),
            };
            tally.note(!noticed || ran > 2);
        }
    }
    tally.close();
}

#[test]
fn whatever_was_recorded_is_of_no_use_in_another_link() {
    let mut tally = Tally::new("frames and datagrams of another link, at every state");
    let record = Ends::recorded(RECORDED);
    let states = Ends::recorded(ATTACKED).len();
    for state in 0..states {
        for old in &record {
            for to_manager in [true, false] {
                let mut ends = Ends::new(ATTACKED);
                let mut proven = false;
                ends.converse(|ends, number, carried| {
                    if number == state {
                        let before = (ends.manager.greeted(), ends.agv.greeted());
                        ends.deliver(&Carried { to_manager, ..old.clone() });
                        proven = before != (ends.manager.greeted(), ends.agv.greeted());
                    }
                    ends.deliver(&carried);
                });
                tally.note(proven || ends.agv.ran > 2 || ends.manager.ran > 0);
            }
        }
    }
    tally.close();
}

#[test]
fn whatever_was_said_is_of_no_use_later_in_the_same_link() {
    let mut tally = Tally::new("frames and datagrams of this link once more, at every later state");
    let states = Ends::recorded(ATTACKED).len();
    for state in 0..states {
        for again in 0..=state {
            for reflected in [false, true] {
                let (mut ends, mut record) = (Ends::new(ATTACKED), Vec::new());
                let mut proven = false;
                ends.converse(|ends, number, carried| {
                    ends.deliver(&carried);
                    record.push(carried);
                    if number == state {
                        let old = &record[again];
                        let before = (ends.manager.greeted(), ends.agv.greeted());
                        ends.deliver(&Carried { to_manager: old.to_manager != reflected, ..old.clone() });
                        proven = before != (ends.manager.greeted(), ends.agv.greeted());
                    }
                });
                tally.note(proven || ends.agv.ran > 2 || ends.manager.ran > 0);
            }
        }
    }
    tally.close();
}

/// A peer that replays a whole recorded conversation proves nothing.
#[test]
fn a_recorded_peer_proves_nothing() {
    let mut tally = Tally::new("whole recorded conversations");
    let record = Ends::recorded(RECORDED);
    for manager in [true, false] {
        for length in 1..=record.len() {
            let mut ends = Ends::new(ATTACKED);
            for old in record.iter().take(length).filter(|old| old.to_manager == manager) {
                ends.deliver(old);
            }
            let victim = ends.end(manager);
            victim.wait(Duration::from_secs(3));
            tally.note(victim.greeted() || victim.ran > 0 || victim.closed.is_none());
        }
    }
    tally.close();
}

#[test]
fn frames_that_are_left_out_or_change_places_end_the_link() {
    let mut tally = Tally::new("frames left out or moved");
    let record = Ends::recorded(ATTACKED);
    let handshake = handshake(&record);
    let sealed = record.iter().enumerate().filter(|(at, carried)| !handshake.contains(at) && !carried.datagram);
    for (at, original) in sealed {
        for moved in [false, true] {
            let (mut ends, mut held) = (Ends::new(ATTACKED), None);
            let mut followed = false;
            ends.converse(|ends, number, carried| {
                if number == at {
                    held = Some(carried);
                    return;
                }
                let next = !carried.datagram && carried.to_manager == original.to_manager && number > at;
                followed |= next;
                ends.deliver(&carried);
                if let (true, true, Some(held)) = (moved, next, held.take()) {
                    ends.deliver(&held);
                }
            });
            let victim = ends.end(original.to_manager);
            // The emergency also travels as a datagram, so it may run although its frame is missing.
            tally.note((followed && victim.closed.is_none()) || victim.ran > 2);
        }
    }
    tally.close();
}

#[test]
fn what_is_cut_or_too_long_before_the_proof_costs_no_buffer() {
    let mut tally = Tally::new("cut and oversize frames before the proof");
    let record = Ends::recorded(ATTACKED);
    for at in handshake(&record) {
        let original = &record[at];
        let cuts = (0..original.bytes.len() - 2).map(|length| (length, original.bytes[2..2 + length].to_vec()));
        let long = [318, 319, 320, 1_024, 4_096, 65_535].map(|length| (length, vec![0x13; length]));
        for (length, body) in cuts.chain(long) {
            let bytes = [&(length as u16).to_le_bytes()[..], &body].concat();
            let mut ends = with_changed(at, |carried| carried.bytes = bytes.clone());
            let victim = ends.end(original.to_manager);
            let kept = victim.has_all_buffers();
            victim.wait(Duration::from_secs(3));
            tally.note(victim.greeted() || victim.closed.is_none() || !kept);
        }
    }
    tally.close();
}

/// The length alone ends the link: no buffer is held for the rest of a frame that is too long.
#[test]
fn the_beginning_of_an_oversize_frame_before_the_proof_ends_the_link() {
    let mut tally = Tally::new("beginnings of oversize frames before the proof");
    for at in 0..OPENING {
        for length in [318_u16, 600, 1_024, 4_096, 65_535] {
            let mut ends = Ends::new(ATTACKED);
            ends.converse(|ends, number, carried| {
                if number < at {
                    ends.deliver(&carried);
                } else if number == at {
                    let victim = ends.end(carried.to_manager);
                    victim.hear(&[&length.to_le_bytes()[..], &[0x13; 40]].concat());
                    tally.note(victim.closed.is_none());
                    assert!(victim.closed.is_some(), "{at} {length}");
                    tally.note(!victim.has_all_buffers());
                }
            });
        }
    }
    tally.close();
}

#[test]
fn two_keys_are_told_by_both_ends() {
    let mut ends = Ends::with_keys(ATTACKED, PairKey::new([1; 32]), PairKey::new([2; 32]));
    ends.converse(|ends, _, carried| ends.deliver(&carried));
    assert_eq!(ends.manager.closed, Some(CloseReason::BadProof));
    assert_eq!(ends.agv.closed, Some(CloseReason::BadProof));
    assert!(!ends.manager.greeted() && !ends.agv.greeted());
    assert_eq!([&ends.manager, &ends.agv].map(|end| end.counted(LinkCounter::ProofsFailed)), [1, 1]);
    assert_eq!(ends.manager.counted(LinkCounter::FarewellsInClear), 1);
}

/// No frame and no datagram of two links is sealed alike, even where both ends draw the same numbers each time.
#[test]
fn a_generator_that_repeats_itself_repeats_no_key() {
    let record = |run| {
        let (mut ends, mut record) = (Ends::repeating(run), Vec::new());
        ends.converse(|ends, _, carried| {
            ends.deliver(&carried);
            record.push(carried);
        });
        assert_eq!(ends.agv.ran, 4);
        record.into_iter().skip(OPENING - 1).map(|carried| carried.bytes).collect::<Vec<_>>()
    };
    let (one, other) = (record(RECORDED), record(ATTACKED));
    for (number, bytes) in one.iter().enumerate() {
        assert!(!other.contains(bytes), "number {number}: {bytes:02x?}");
    }
    let mut alone = one.clone();
    alone.sort();
    alone.dedup();
    assert_eq!(alone.len(), one.len(), "nor are two of one link");
}
