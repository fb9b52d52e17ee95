#![allow(clippy::indexing_slicing, clippy::unwrap_used, clippy::panic, clippy::arithmetic_side_effects)]
use super::*;
use crate::storage::{Boxed, LEFT_BY_WAITING, Pool};
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::collections::VecDeque;
use std::vec;
use std::vec::Vec;

fn calls(slots: usize) -> Calls<Boxed> {
    Calls::new(vec![None; slots].into_boxed_slice())
}

fn pool(count: usize, size: usize) -> Pool<Boxed> {
    Pool::new((0..count).map(|_| Some(vec![0; size].into_boxed_slice())).collect())
}

fn head(id: u32, priority: Priority) -> CallHead {
    CallHead {
        id,
        slot: Slot(id as u16 ^ 0x1234),
        generation: Generation(id as u16),
        priority,
        wants_reply: id.is_multiple_of(2),
        wants_progress: id.is_multiple_of(7),
        cancelled: Cancelled::No,
        takes_over: id.is_multiple_of(3),
        operator: id.is_multiple_of(5),
        resets: false,
        deadline: Instant::from_micros(u64::from(id) << 20),
        sent_at: Instant::from_micros(u64::from(id) << 10),
        number: id ^ 0x8000_0001,
    }
}

proptest! {
    #[test]
    fn the_window_agrees_with_a_set(ids in prop::collection::vec(1..400_u32, 0..300)) {
        let (mut window, mut seen) = (Window::default(), BTreeSet::new());
        for id in ids {
            let newest = seen.last().copied().unwrap_or(0);
            let expected = match id {
                id if id + WINDOW <= newest => Seen::TooOld,
                id if !seen.insert(id) => Seen::Before,
                _ => Seen::Never,
            };
            prop_assert_eq!(window.note(id), expected);
        }
    }

    #[test]
    fn what_waits_comes_out_as_it_went_in(steps in prop::collection::vec((0..3_u8, 0..200_usize), 1..200)) {
        let (mut calls, mut pool) = (calls(4), pool(3, 600));
        let mut model: VecDeque<(CallHead, Vec<u8>)> = VecDeque::new();
        for (id, (step, length)) in (1..).zip(steps) {
            if step > 0 {
                let (head, block) = (head(id, Priority::Low), vec![id as u8; length]);
                let used: usize = model.iter().map(|(_, block)| block.len() + HEAD_BYTES).sum();
                let fits = used + block.len() + HEAD_BYTES <= 600;
                prop_assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head, &block).is_ok(), fits);
                if fits {
                    model.push_back((head, block));
                }
            } else {
                let taken = calls.take_next(&mut pool, |_, block| block.to_vec());
                prop_assert_eq!(taken, model.pop_front());
            }
            prop_assert_eq!(usize::from(calls.held()), model.len());
            prop_assert_eq!(pool.free(), LEFT_BY_WAITING + usize::from(model.is_empty()));
        }
    }
}

#[test]
fn a_window_knows_what_it_has_noted_and_what_is_too_old() {
    let mut window = Window::default();
    window.note(70);
    window.note(72);
    assert_eq!([70, 71, 72, 73].map(|id| window.knows(id)), [true, false, true, false]);
    assert!(window.knows(72 - WINDOW), "it may have been noted");
}

#[test]
fn a_call_that_is_released_while_it_waits_has_run_out_and_no_other() {
    let (mut calls, mut pool) = (calls(3), pool(4, 200));
    for id in 1..=3 {
        calls.wait(&mut pool, LEFT_BY_WAITING, head(id, Priority::Low), &[0; 8]).unwrap();
    }
    calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Emergency), b"").unwrap();
    assert!(calls.is_waiting(Priority::Low, 2) && !calls.is_waiting(Priority::High, 2));
    for id in 1..=3 {
        calls.note(Priority::Low, id);
    }
    calls.note(Priority::Emergency, 4);
    calls.give_up(Priority::Low, 2);
    calls.give_up(Priority::Emergency, 4);
    let mut left = || calls.take_next(&mut pool, |head, _| head).unwrap().0;
    assert_eq!(
        [left(), left(), left(), left()].map(|head| (head.id, head.deadline == Instant::START)),
        [(4, true), (1, false), (2, true), (3, false),]
    );
}

#[test]
fn a_request_that_is_given_up_before_it_arrives_is_passed_over_and_those_before_it_are_not() {
    let mut calls = calls(1);
    calls.give_up(Priority::Low, 500);
    calls.give_up(Priority::Low, 500);
    let mut note = |id| calls.note(Priority::Low, id);
    assert_eq!(
        [note(3), note(499), note(500), note(500), note(501)],
        [Seen::Never, Seen::Never, Seen::Before, Seen::Before, Seen::Never,]
    );
    // Those that never come give way to others, which are kept out all the same.
    (600..620).for_each(|id| calls.give_up(Priority::Low, id));
    for id in 600..620 {
        assert_eq!(calls.note(Priority::Low, id), Seen::Before, "{id}");
    }
    assert_eq!(calls.note(Priority::Low, 620), Seen::Never);
}

#[test]
fn ids_far_ahead_forget_what_was_before() {
    let mut window = Window::default();
    assert_eq!([window.note(1), window.note(u32::MAX), window.note(1)], [Seen::Never, Seen::Never, Seen::TooOld]);
    assert_eq!(window.note(u32::MAX - (WINDOW - 1)), Seen::Never);
    assert_eq!(window.note(u32::MAX), Seen::Before);
}

#[test]
fn a_ticket_is_good_once_and_for_its_call_only() {
    let mut calls = calls(2);
    let first = calls.begin(head(1, Priority::Normal), false).unwrap();
    assert!(calls.end(first) && !calls.end(first));
    let second = calls.begin(head(2, Priority::Normal), false).unwrap();
    assert_eq!((calls.call(first), calls.held()), (None, 1));
    assert!(!calls.end(first));
    assert_eq!(calls.call(second).unwrap().id, 2);
}

#[test]
fn an_emergency_finds_a_slot_when_all_others_are_taken() {
    let mut calls = calls(3);
    for id in 1..=2 {
        calls.begin(head(id, Priority::Normal), false).unwrap();
    }
    assert_eq!(calls.begin(head(3, Priority::High), false), Err(Error::Busy));
    assert_eq!(calls.begin(head(4, Priority::Emergency), false), Err(Error::Busy), "its class alone is not enough");
    assert!(calls.begin(head(4, Priority::Emergency), true).is_ok());
    assert_eq!(calls.admit(Slot(9), false, 3), Err(Error::Busy));
    assert_eq!(calls.admit(Slot(9), true, 3), Ok(()));
}

#[test]
fn of_one_emergency_service_two_calls_run_and_leave_slots_for_those_of_others() {
    let mut calls = calls(slots_for(16));
    let same = |id| CallHead { slot: Slot(7), ..head(id, Priority::Emergency) };
    for id in 1..=16 {
        calls.begin(head(id, Priority::Normal), false).unwrap();
    }
    for id in 17..=18 {
        assert_eq!(calls.admit(Slot(7), true, 1), Ok(()));
        calls.begin(same(id), true).unwrap();
    }
    assert_eq!(calls.admit(Slot(7), true, 1), Err(Error::Busy));
    assert_eq!(calls.admit(Slot(8), true, 1), Ok(()));
    assert!(calls.is_idle(Priority::Emergency) && !calls.is_idle(Priority::High));
}

#[test]
fn the_slots_that_are_asked_for_are_those_that_other_calls_may_have() {
    for running in 1..100 {
        let slots = slots_for(running);
        assert_eq!(slots - kept(slots), running, "{running} of {slots}");
    }
}

#[test]
fn a_running_call_keeps_its_ticket_when_there_are_more_slots() {
    let mut calls = calls(slots_for(1));
    let first = calls.begin(head(1, Priority::Normal), false).unwrap();
    assert!(!calls.is_idle(Priority::Normal));
    assert_eq!(calls.grow(vec![None; 1].into()).len(), 1, "fewer are given back");
    assert_eq!(calls.grow(vec![Some(head(9, Priority::Normal)); slots_for(3)].into()).len(), slots_for(1));
    assert_eq!((calls.slots(), calls.running.iter().flatten().count()), (slots_for(3), 1));
    let second = calls.begin(head(2, Priority::Normal), false).unwrap();
    assert!(calls.end(first) && calls.end(second) && !calls.end(first));
}

#[test]
fn a_call_begins_while_others_of_its_class_run_and_never_before_one_that_waits() {
    let (mut calls, mut pool) = (calls(slots_for(2)), pool(3, 100));
    assert!(calls.is_idle(Priority::Normal));
    let first = calls.begin(head(1, Priority::Normal), false).unwrap();
    assert!(calls.is_idle(Priority::Normal), "one runs, and there is room for another");
    calls.begin(head(2, Priority::Normal), false).unwrap();
    assert!(!calls.is_idle(Priority::Normal));
    calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::Normal), b"").unwrap();
    assert!(!calls.can_begin());
    calls.end(first);
    assert!(calls.can_begin() && !calls.is_idle(Priority::Normal), "the third comes before a fourth");
    assert!(!calls.is_idle(Priority::High), "and before one of another class that came later");
    assert_eq!(calls.take_next(&mut pool, |head, _| head.id).map(|(_, id)| id), Some(3));
    assert!(calls.is_idle(Priority::Normal));
}

#[test]
fn room_ends_with_the_calls_that_may_wait_or_with_the_bytes() {
    let (mut calls, mut pool) = (calls(3), pool(4, 100));
    assert!(calls.has_room(1, 64) && !calls.has_room(0, 0));
    calls.wait(&mut pool, LEFT_BY_WAITING, head(1, Priority::Normal), b"12345678").unwrap();
    assert_eq!([(1, 0), (2, 20), (2, 21)].map(|(limit, bytes)| calls.has_room(limit, bytes)), [false, true, false]);
    assert!(calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Normal), &[0; 20]).is_ok());
}

#[test]
fn one_emergency_waits_without_a_buffer() {
    let (mut calls, mut pool) = (calls(3), pool(0, 0));
    for id in 11..=13 {
        calls.begin(head(id, Priority::Emergency), true).unwrap();
    }
    calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Emergency), &[1; EMERGENCY_BYTES]).unwrap();
    assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::Emergency), b""), Err(Error::Busy));
    assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Normal), b"go"), Err(Error::Busy));
    assert!(!calls.can_begin());
}

#[test]
fn several_short_emergencies_wait_in_their_order() {
    let (mut calls, mut pool) = (calls(1), pool(0, 0));
    let running = calls.begin(head(11, Priority::Emergency), true).unwrap();
    let same = |id| CallHead { slot: Slot(7), ..head(id, Priority::Emergency) };
    for id in 2..=7 {
        calls.note(Priority::Emergency, id);
        calls.wait(&mut pool, LEFT_BY_WAITING, same(id), b"stop").unwrap();
    }
    assert_eq!((calls.admit(Slot(7), true, 1), calls.admit(Slot(8), true, 1)), (Err(Error::Busy), Ok(())));
    calls.give_up(Priority::Emergency, 3);
    assert!(calls.end(running));
    let mut next = || calls.take_next(&mut pool, |head, block| (head, block.to_vec())).map(|(_, taken)| taken);
    for id in 2..=7 {
        let (head, block) = next().unwrap();
        assert_eq!((head.id, head.deadline == Instant::START, &block[..]), (id, id == 3, &b"stop"[..]));
    }
    assert!(next().is_none() && !calls.any_waiting() && calls.held() == 0);
}

#[test]
fn one_request_may_come_early_by_an_interval() {
    let (mut calls, interval) = (calls(1), Duration::from_millis(10));
    let at = |millis: u64| Instant::from_micros(1_000_000 + millis * 1_000);
    assert_eq!(calls.interval(at(0), interval), Ok(()));
    assert_eq!(calls.interval(at(0), interval), Ok(()));
    assert_eq!(calls.interval(at(4), interval), Err(Error::TooSoon { wait: Duration::from_millis(6) }));
    assert_eq!(calls.interval(at(10), interval), Ok(()));
    assert_eq!(calls.interval(at(10), Duration::ZERO), Ok(()));
}

#[test]
fn the_end_of_a_link_forgets_what_waits_and_keeps_what_runs() {
    let (mut calls, mut pool) = (calls(3), pool(4, 100));
    let running = calls.begin(head(1, Priority::Normal), false).unwrap();
    calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Normal), b"").unwrap();
    calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::High), b"").unwrap();
    calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Emergency), b"").unwrap();
    assert_eq!((calls.held(), pool.free()), (4, LEFT_BY_WAITING));
    calls.release(&mut pool);
    assert_eq!((calls.held(), pool.free()), (1, 4));
    assert!(calls.end(running));
    assert_eq!(calls.held(), 0);
}

#[test]
fn the_last_buffers_are_left_to_answers_and_to_what_is_received() {
    let (mut calls, mut pool) = (calls(3), pool(LEFT_BY_WAITING, 100));
    assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(1, Priority::Normal), b""), Err(Error::Busy));
    assert_eq!((calls.held(), pool.free()), (0, LEFT_BY_WAITING));
}
