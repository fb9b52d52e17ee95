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
        takes_over: id.is_multiple_of(3),
        operator: id.is_multiple_of(5),
        keeps_order: id.is_multiple_of(11),
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

/// All of them over twice the width of a window, at both ends of the range of ids.
#[test]
#[cfg_attr(miri, ignore = "so many cases take the interpreter hours")]
fn any_three_ids_are_new_or_known_or_too_old_as_a_set_says() {
    let wide = 2 * WINDOW + 2;
    for base in [0, u32::MAX - wide] {
        for (a, b) in (1..=wide).flat_map(|a| (1..=wide).map(move |b| (a, b))) {
            let mut two = Window::default();
            assert_eq!(two.note(base + a), Seen::Never);
            let second = two.note(base + b);
            let newest = a.max(b);
            let expected = |id: u32, is_known: bool| match id {
                id if id + WINDOW <= newest => Seen::TooOld,
                _ if is_known => Seen::Before,
                _ => Seen::Never,
            };
            assert_eq!(second, expected(b, a == b), "{base}: {a}, {b}");
            for id in 1..=wide {
                let expected = expected(id, id == a || id == b);
                assert_eq!(two.knows(base + id), expected != Seen::Never, "{base}: {a}, {b}, {id}");
                assert_eq!({ two }.note(base + id), expected, "{base}: {a}, {b}, {id}");
            }
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
    // Ids that never arrive are forgotten for newer ones, but stay excluded.
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
    let first = calls.begin(&head(1, Priority::Normal), false, false).unwrap();
    assert!(calls.end(first) && !calls.end(first));
    let second = calls.begin(&head(2, Priority::Normal), false, false).unwrap();
    assert_eq!((calls.call(first), calls.held()), (None, 1));
    assert!(!calls.end(first));
    assert_eq!(calls.call(second).unwrap().id, 2);
}

#[test]
fn an_emergency_finds_a_slot_when_all_others_are_taken() {
    let mut calls = calls(3);
    for id in 1..=2 {
        calls.begin(&head(id, Priority::Normal), false, false).unwrap();
    }
    assert_eq!(calls.begin(&head(3, Priority::High), false, false), Err(Error::Busy));
    assert_eq!(
        calls.begin(&head(4, Priority::Emergency), false, false),
        Err(Error::Busy),
        "its class alone is not enough"
    );
    assert!(calls.begin(&head(4, Priority::Emergency), false, true).is_ok());
    assert_eq!(calls.admit(Slot(9), false, 3), Err(Error::Busy));
    assert_eq!(calls.admit(Slot(9), true, 3), Ok(()));
}

#[test]
fn of_one_emergency_service_two_calls_run_and_leave_slots_for_those_of_others() {
    let mut calls = calls(slots_for(16));
    let same = |id| CallHead { slot: Slot(7), ..head(id, Priority::Emergency) };
    for id in 1..=16 {
        calls.begin(&head(id, Priority::Normal), false, false).unwrap();
    }
    for id in 17..=18 {
        assert_eq!(calls.admit(Slot(7), true, 1), Ok(()));
        calls.begin(&same(id), false, true).unwrap();
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
    let first = calls.begin(&head(1, Priority::Normal), false, false).unwrap();
    assert!(!calls.is_idle(Priority::Normal));
    assert_eq!(calls.grow(vec![None; 1].into()).len(), 1, "fewer are given back");
    assert_eq!(calls.grow(vec![calls.call(first); slots_for(3)].into()).len(), slots_for(1));
    assert_eq!((calls.slots(), calls.running.iter().flatten().count()), (slots_for(3), 1));
    let second = calls.begin(&head(2, Priority::Normal), false, false).unwrap();
    assert!(calls.end(first) && calls.end(second) && !calls.end(first));
}

#[test]
fn a_call_begins_while_others_of_its_class_run_and_never_before_one_that_waits() {
    let (mut calls, mut pool) = (calls(slots_for(2)), pool(3, 100));
    assert!(calls.is_idle(Priority::Normal));
    let first = calls.begin(&head(1, Priority::Normal), false, false).unwrap();
    assert!(calls.is_idle(Priority::Normal), "one runs, and there is room for another");
    calls.begin(&head(2, Priority::Normal), false, false).unwrap();
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
        calls.begin(&head(id, Priority::Emergency), false, true).unwrap();
    }
    calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Emergency), &[1; EMERGENCY_BYTES]).unwrap();
    assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::Emergency), b""), Err(Error::Busy));
    assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Normal), b"go"), Err(Error::Busy));
    assert!(!calls.can_begin());
}

#[test]
fn several_short_emergencies_wait_in_their_order() {
    let (mut calls, mut pool) = (calls(1), pool(0, 0));
    let running = calls.begin(&head(11, Priority::Emergency), false, true).unwrap();
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
    let running = calls.begin(&head(1, Priority::Normal), false, false).unwrap();
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

/// A call that was made at `sent` with this deadline, both in milliseconds.
fn timed(id: u32, sent: u64, deadline: u64) -> CallHead {
    let at = |millis: u64| Instant::from_micros(millis * 1_000);
    CallHead { sent_at: at(sent), deadline: at(deadline), keeps_order: false, ..head(id, Priority::Normal) }
}

/// The ids of calls in the order in which they begin; `now` in milliseconds.
fn begun(waiting: &[CallHead], now: u64) -> Vec<u32> {
    let (mut calls, mut pool) = (calls(4), pool(3, 4_000));
    for head in waiting {
        calls.wait(&mut pool, LEFT_BY_WAITING, *head, &vec![head.id as u8; head.id as usize]).unwrap();
    }
    let mut ids = Vec::new();
    loop {
        calls.put_next_first(Instant::from_micros(now * 1_000));
        let Some((head, block)) = calls.take_next(&mut pool, |_, block| block.to_vec()) else { return ids };
        assert_eq!(block, vec![head.id as u8; head.id as usize]);
        ids.push(head.id);
    }
}

#[test]
fn the_earliest_deadline_begins_and_of_equal_time_outs_the_first() {
    let waiting = [timed(1, 10, 1_000), timed(2, 11, 500), timed(3, 12, 2_000), timed(4, 13, 502), timed(5, 14, 1_004)];
    assert_eq!(begun(&waiting, 20), [2, 4, 1, 5, 3]);
    // The estimate of when calls were made changes a little with each keep-alive.
    assert_eq!(begun(&[timed(1, 12, 112), timed(2, 10, 110), timed(3, 11, 111)], 20), [1, 2, 3]);
}

#[test]
fn what_has_waited_half_its_time_out_is_next() {
    let waiting = [timed(1, 0, 10_000), timed(2, 4_999, 5_009), timed(3, 4_999, 5_019)];
    assert_eq!(begun(&waiting, 4_999), [2, 3, 1]);
    assert_eq!(begun(&waiting, 5_000), [1, 2, 3]);
    // A call that was given up is removed first.
    assert_eq!(begun(&[timed(1, 4_998, 10_000), timed(2, 4_999, 0)], 4_999), [2, 1]);
}

#[test]
fn what_moves_overtakes_nothing_and_is_overtaken_by_nothing() {
    let moving = |id, deadline| CallHead { keeps_order: true, ..timed(id, 0, deadline) };
    let waiting =
        [timed(1, 0, 900), timed(2, 0, 800), moving(3, 100), timed(4, 0, 700), timed(5, 0, 600), moving(6, 50)];
    assert_eq!(begun(&waiting, 1), [2, 1, 3, 5, 4, 6]);
    assert_eq!(begun(&waiting[2..], 1), [3, 5, 4, 6]);
}

#[test]
fn no_more_calls_are_looked_at_than_the_limit() {
    let last = LOOKED_AT as u32 + 1;
    let mut waiting: Vec<_> = (1..last).map(|id| timed(id, 0, 1_000)).collect();
    waiting.push(timed(last, 0, 10));
    assert_eq!(begun(&waiting, 1)[..2], [1, last]);
}

#[test]
fn the_latest_deadline_makes_room_and_what_moves_or_is_next_does_not() {
    let (mut calls, mut pool) = (calls(4), pool(3, 3 * HEAD_BYTES + 24));
    let moving = CallHead { keeps_order: true, ..timed(1, 0, 9_000) };
    for head in [moving, timed(2, 0, 900), timed(3, 0, 800)] {
        calls.wait(&mut pool, LEFT_BY_WAITING, head, &[head.id as u8; 8]).unwrap();
    }
    let at = |millis: u64| Instant::from_micros(millis * 1_000);
    let mut displaced = |now, deadline, length| {
        let displaced = calls.displace(at(now), Priority::Normal, at(deadline), length);
        (displaced.map(|head| head.id), calls.held())
    };
    assert_eq!(displaced(1, 900, 8), (None, 3), "it is not later than the newcomer's");
    assert_eq!(displaced(1, 100, 9), (None, 3), "the newcomer would not fit");
    assert_eq!(displaced(450, 700, 8), (None, 3), "both have waited half their time-outs");
    assert_eq!(displaced(1, 850, 8), (Some(2), 2));
    assert_eq!(displaced(1, 100, 8), (Some(3), 1));
    assert_eq!(displaced(1, 100, 8), (None, 1), "it moves");
}
