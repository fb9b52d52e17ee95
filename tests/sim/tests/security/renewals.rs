//! Keys that are made anew on a live link: what was recorded under the old ones, and proofs that fail.

use cara_core::config::{PREVIOUS_KEY_LIFE, Priority, RENEWAL_TIMEOUT};
use cara_core::error::{CloseReason, Refusal};
use cara_core::host::connections::LinkCounter;
use cara_core::time::Duration;
use cara_secure::keys::PairKey;

use super::Tally;
use super::ends::{Carried, End, Ends};

const RUN: u8 = 3;
/// Where the renewal begins: all before it is the conversation without one.
const STEP: Duration = Duration::from_secs(1);

fn renewed(end: &End) -> u64 {
    end.counted(LinkCounter::KeysRenewed)
}

/// Two ends that have talked, and whose keys are made anew when a second has passed.
fn before() -> Ends {
    let mut ends = Ends::renewing(RUN);
    ends.carry();
    for end in [true, false] {
        ends.end(end).wait(STEP);
    }
    ends.carry();
    assert_eq!((renewed(&ends.manager), renewed(&ends.agv)), (0, 0));
    ends
}

/// The same, with the renewal begun: its first message is on its way.
fn started() -> Ends {
    let mut ends = before();
    ends.agv.wait(STEP);
    ends
}

#[test]
fn a_conversation_goes_on_under_new_keys() {
    let mut ends = Ends::renewing(RUN);
    let mut generations = [false; 2];
    ends.converse(|ends, _, carried| {
        if carried.datagram {
            generations[usize::from(carried.bytes[24])] = true;
        }
        ends.deliver(&carried);
    });
    assert_eq!((renewed(&ends.manager), renewed(&ends.agv)), (1, 1));
    assert_eq!(generations, [true; 2], "datagrams went under both keys");
    assert_eq!(ends.agv.ran, 4);
    for end in [&ends.manager, &ends.agv] {
        assert_eq!(end.counted(LinkCounter::DatagramsForged), 0);
        assert!(end.closed.is_none());
    }
}

#[test]
fn every_flipped_bit_of_a_renewal_ends_the_link() {
    let mut tally = Tally::new("bits of a renewal flipped");
    let (first, record) = (Ends::recorded(RUN).len(), Ends::renewing(RUN).record());
    for (at, original) in record.iter().enumerate().skip(first).filter(|(_, carried)| !carried.datagram) {
        for bit in 16..original.bytes.len() * 8 {
            let mut ends = Ends::renewing(RUN);
            ends.converse(|ends, number, mut carried| {
                if number == at {
                    carried.bytes[bit / 8] ^= 1 << (bit % 8);
                }
                ends.deliver(&carried);
            });
            let ran = ends.agv.ran;
            tally.note(ends.end(original.to_manager).closed.is_none() || ran > 4);
        }
    }
    tally.close();
}

#[test]
fn frames_of_a_renewal_that_are_left_out_or_come_twice_end_the_link() {
    let mut tally = Tally::new("frames of a renewal left out or repeated");
    let (first, record) = (Ends::recorded(RUN).len(), Ends::renewing(RUN).record());
    for (at, original) in record.iter().enumerate().skip(first).filter(|(_, carried)| !carried.datagram) {
        for times in [0, 2] {
            let (mut ends, mut followed) = (Ends::renewing(RUN), false);
            ends.converse(|ends, number, carried| {
                followed |= number > at && !carried.datagram && carried.to_manager == original.to_manager;
                for _ in 0..if number == at { times } else { 1 } {
                    ends.deliver(&carried);
                }
            });
            let ran = ends.agv.ran;
            let noticed = ends.end(original.to_manager).closed.is_some() || (times == 0 && !followed);
            tally.note(!noticed || ran > 4);
        }
    }
    tally.close();
}

/// Whatever was said under the old keys, and in the handshake that made the new ones, at every later state.
#[test]
fn whatever_was_said_before_is_of_no_use_under_new_keys() {
    let mut tally = Tally::new("frames and datagrams of earlier keys, at every later state");
    let (first, record) = (Ends::recorded(RUN).len(), Ends::renewing(RUN).record());
    for state in first..record.len() {
        for old in record.iter().take(state + 1) {
            for reflected in [false, true] {
                let (mut ends, mut taken) = (Ends::renewing(RUN), false);
                let to_manager = old.to_manager != reflected;
                ends.converse(|ends, number, carried| {
                    ends.deliver(&carried);
                    if number == state {
                        let before = ends.end(to_manager).counted(LinkCounter::DatagramsReceived);
                        ends.deliver(&Carried { to_manager, ..old.clone() });
                        let end = ends.end(to_manager);
                        taken = end.counted(LinkCounter::DatagramsReceived) > before;
                        taken |= !old.datagram && end.closed.is_none();
                    }
                });
                tally.note(taken || ends.agv.ran > 4 || ends.manager.ran > 0);
            }
        }
    }
    tally.close();
}

/// Renews the keys while the vehicle's datagrams are held up on their way; the last one of them, under the old key, when
/// the first one under the new key has come.
fn late_datagram(ends: &mut Ends) -> Carried {
    let mut late = None;
    ends.agv.wait(STEP);
    while let Some(carried) = ends.next() {
        match carried.datagram && carried.to_manager {
            true => late = Some(carried),
            false => ends.deliver(&carried),
        }
    }
    assert_eq!(renewed(&ends.manager), 1);
    ends.agv.wait(STEP);
    ends.carry();
    late.filter(|late| late.bytes[24] == 0).expect("a keep-alive under the old key")
}

#[test]
fn datagrams_under_the_old_key_are_taken_for_five_seconds_more() {
    let millis = PREVIOUS_KEY_LIFE.as_millis();
    for (later, taken) in [(millis - 10, 1), (millis, 0)] {
        let mut ends = before();
        let late = late_datagram(&mut ends);
        let heard = ends.manager.counted(LinkCounter::DatagramsReceived);
        ends.manager.wait(Duration::from_millis(later));
        ends.deliver(&late);
        assert_eq!(ends.manager.counted(LinkCounter::DatagramsReceived), heard + taken, "after {later} ms");
    }
}

#[test]
fn a_key_that_was_revoked_ends_the_link_at_its_next_renewal() {
    for manager in [true, false] {
        let mut ends = before();
        ends.end(manager).ring.keys = None;
        ends.agv.wait(STEP);
        ends.carry();
        assert_eq!(ends.end(manager).closed, Some(CloseReason::Refused(Refusal::NoKey)));
        assert_eq!(ends.end(!manager).closed, Some(CloseReason::BadProof));
    }
}

#[test]
fn another_key_ends_the_link_at_its_next_renewal() {
    let mut ends = before();
    ends.agv.ring.keys = Some((PairKey::new([7; 32]), None));
    ends.agv.wait(STEP);
    ends.carry();
    assert_eq!((ends.manager.closed, ends.agv.closed), (Some(CloseReason::BadProof), Some(CloseReason::BadProof)));
    assert_eq!(ends.manager.counted(LinkCounter::ProofsFailed), 1);
}

/// As when a fleet's keys are changed: first those that are dialled have both.
#[test]
fn keys_may_change_while_a_link_lives() {
    let mut ends = before();
    let (old, _) = ends.manager.ring.keys.clone().expect("it has one");
    ends.manager.ring.keys = Some((PairKey::new([7; 32]), Some(old)));
    ends.agv.wait(STEP);
    ends.carry();
    assert_eq!((renewed(&ends.manager), renewed(&ends.agv)), (1, 1));
    ends.agv.ring.keys = Some((PairKey::new([7; 32]), None));
    for _ in 0..3 {
        [true, false].into_iter().for_each(|end| ends.end(end).wait(STEP));
        ends.carry();
    }
    assert_eq!((renewed(&ends.manager), renewed(&ends.agv)), (2, 2));
    assert!(ends.manager.session.is_live() && ends.agv.session.is_live());
}

/// One end cannot say what it has to: the link goes on by datagrams until the time for it is over.
#[test]
fn a_peer_that_does_not_go_on_loses_its_link() {
    let mut ends = before();
    ends.manager.clog();
    for _ in 0..RENEWAL_TIMEOUT.as_millis() / 1_000 {
        assert!(ends.agv.session.is_live() && ends.manager.session.is_live());
        [true, false].into_iter().for_each(|end| ends.end(end).wait(STEP));
        ends.carry();
    }
    ends.manager.call(Priority::Normal);
    [true, false].into_iter().for_each(|end| ends.end(end).wait(STEP));
    assert_eq!(ends.agv.closed, Some(CloseReason::HelloTimeout));
    assert_eq!(renewed(&ends.agv), 0);
}

/// A frame of a renewal that does not fit the send queue is sent later.
#[test]
fn a_renewal_waits_for_room_in_the_stream() {
    for clogged in [true, false] {
        let mut ends = before();
        for step in 0..12 {
            // Before, between and behind each of its frames.
            if let Some(carried) = ends.next() {
                ends.deliver(&carried);
            }
            ends.end(clogged).clog();
            if step == 0 {
                ends.agv.wait(STEP);
            }
            ends.carry();
            ends.end(clogged).unclog();
        }
        ends.carry();
        assert_eq!((renewed(&ends.manager), renewed(&ends.agv)), (1, 1), "manager: {clogged}");
        assert!(ends.manager.session.is_live() && ends.agv.session.is_live());
    }
}

/// Calls that are asked while each single frame of the renewal is on its way, in either direction, run once.
#[test]
fn calls_go_on_at_every_step_of_a_renewal() {
    for at in 0..8 {
        let mut ends = started();
        let mut number = 0;
        while let Some(carried) = ends.next() {
            if number == at {
                ends.manager.call(Priority::Normal);
                ends.manager.call(Priority::Emergency);
                ends.agv.call(Priority::High);
            }
            ends.deliver(&carried);
            number += 1;
        }
        assert!(number > 8, "a renewal has more frames than are looked at");
        assert_eq!((ends.agv.ran, ends.manager.ran), (2, 1), "asked before frame {at}");
        assert_eq!((renewed(&ends.manager), renewed(&ends.agv)), (1, 1));
    }
}
