//! The limits that the two ends advertise and enforce.

use std::vec;

use super::super::Event;
use super::pair::Pair;
use super::setup::Setup;
use super::side::context;
use super::{none, text, x};
use crate::config::{Constraints, Priority};
use crate::distribution::function_list::Generation;
use crate::distribution::message::RequestHeader;
use crate::error::Error;
use crate::host::connections::LinkCounter;
use crate::services::Context;
use crate::services::session::RequestOptions;
use crate::storage::LEFT_BY_WAITING;
use crate::time::Duration;

const ECHO: &str = "echo(text: string[20000]) -> (text: string[20000])";

fn emergency() -> RequestOptions {
    RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::default() }
}

#[test]
fn a_request_above_the_peers_limit_is_not_sent() {
    let mut pair = Pair::with(&Setup { agv: Constraints::S_UNIT, ..Setup::default() });
    pair.agv.offer(ECHO, |_| Ok(()));
    pair.publish();
    assert_eq!(pair.manager.call("echo", &text(1_100)), Err(Error::TooLarge { limit: 1_024 }));
    assert!(pair.manager.call("echo", &text(1_000)).is_ok());
}

/// From a peer that ignores limits. The buffer for emergencies could hold a little more.
#[test]
fn an_emergency_above_its_limit_is_refused() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer("stop(text: string[300])", |_| Ok(()));
    pair.publish();
    for (id, length, refused) in [(1, 216, 0), (2, 217, 1)] {
        let header = RequestHeader {
            id,
            slot,
            generation: Generation(0),
            wants_reply: false,
            wants_progress: false,
            takes_over: false,
            operator: false,
            unknown: 0,
            remaining: Duration::from_secs(1),
            stamp: pair.agv.now.as_micros(),
            since: Duration::ZERO,
            number: id,
        };
        let mut block = vec![b'x'; 8 + length];
        block[..8].copy_from_slice(&(length as u64).to_le_bytes());
        block.resize(block.len().next_multiple_of(8), 0);
        pair.agv.hear_request(&header, Priority::Emergency, &block);
        pair.settle();
        assert_eq!(pair.manager.counter(LinkCounter::RepliesLate), refused, "its caller never made them");
        assert_eq!(pair.agv.ran().len(), 1, "the first one only");
    }
}

#[test]
fn an_answer_above_the_callers_limit_is_an_error_there() {
    let manager = Constraints { message_size: 1_024, ..Constraints::M_UNIT };
    let mut pair = Pair::with(&Setup { manager, ..Setup::default() });
    pair.agv.offer(ECHO, |_| Ok(()));
    pair.publish();
    assert_eq!(pair.block_request("echo", &mut *text(1_100)), Err(Error::TooLarge { limit: 1_024 }));
    assert_eq!(pair.block_request("echo", &mut *text(1_000)), Ok(()));
}

#[test]
fn an_answer_above_the_callees_own_buffers_is_an_error_and_waits_for_nothing() {
    let mut pair = Pair::with(&Setup { buffer_size: 3_000, ..Setup::default() });
    pair.agv.offer("read() -> (text: string[20000])", |results| {
        let long = [b'x'; 5_000];
        results.set_value("text", core::str::from_utf8(&long).unwrap())
    });
    pair.publish();
    let refused = pair.block_request("read", &mut *text(0));
    assert!(matches!(refused, Err(Error::TooLarge { limit: 2_900..3_000 })), "{refused:?}");
    assert_eq!(pair.agv.session.calls_held(), 0);
}

#[test]
fn limits_that_change_are_told() {
    let mut pair = Pair::live();
    pair.agv.offer(ECHO, |_| Ok(()));
    pair.publish();
    pair.agv.set_constraints(Constraints { message_size: 2_000, ..*pair.agv.session.constraints() });
    pair.settle();
    assert_eq!(pair.manager.call("echo", &text(3_000)), Err(Error::TooLarge { limit: 2_000 }));
    pair.agv.set_constraints(Constraints { message_size: 4_000, ..*pair.agv.session.constraints() });
    pair.settle();
    assert_eq!(pair.block_request("echo", &mut *text(3_000)), Ok(()));
}

#[test]
fn a_message_that_crosses_a_lower_limit_is_refused_and_the_link_lives() {
    let mut pair = Pair::live();
    pair.agv.offer(ECHO, |_| Ok(()));
    pair.publish();
    let id = pair.manager.call("echo", &text(3_000)).unwrap();
    pair.agv.set_constraints(Constraints { message_size: 2_000, ..*pair.agv.session.constraints() });
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::TooLarge { limit: 2_000 });
    assert!(pair.agv.session.is_live() && pair.agv.ran().is_empty());
}

#[test]
fn the_minimum_interval_is_kept_by_the_caller() {
    let reported = Constraints { minimum_interval: Duration::from_millis(10), ..Constraints::S_UNIT };
    let mut pair = Pair::with(&Setup { agv: reported, ..Setup::default() });
    pair.agv.offer("go(x: int)", |_| Ok(()));
    pair.publish();
    pair.manager.call("go", &x(1)).unwrap();
    pair.run(Duration::from_millis(4));
    let wait = Duration::from_millis(6);
    assert_eq!(pair.manager.call("go", &x(2)), Err(Error::TooSoon { wait }));
    assert!(pair.manager.request_with("go", &x(0), &emergency(), false).is_ok(), "an emergency ignores it");
    pair.run(Duration::from_millis(10));
    assert!(pair.manager.call("go", &x(2)).is_ok());
    assert!(pair.manager.counter(LinkCounter::RequestsWithheld) == 1);
}

#[test]
fn the_minimum_interval_is_kept_by_the_callee() {
    let mut pair = Pair::live();
    pair.agv.offer("go(x: int)", |_| Ok(()));
    pair.publish();
    let ids: std::vec::Vec<_> = (0..4).map(|at| pair.manager.call("go", &x(at)).unwrap()).collect();
    // The notification of the interval comes too late for these.
    let interval = Duration::from_millis(10);
    pair.agv.set_constraints(Constraints { minimum_interval: interval, ..*pair.agv.session.constraints() });
    pair.settle();
    let too_soon = |id| matches!(pair.manager.outcome(id), Some(Err(Error::TooSoon { .. })));
    assert_eq!(ids.iter().map(|&id| too_soon(id)).collect::<std::vec::Vec<_>>(), [false, false, true, true]);
    assert_eq!(pair.agv.counter(LinkCounter::RequestsTooSoon), 2);
    assert_eq!(pair.agv.ran(), ["go", "go"]);
}

#[test]
fn a_callee_with_its_hands_full_is_busy_except_for_an_emergency() {
    let agv = Constraints { calls_per_peer: 3, ..Constraints::S_UNIT };
    let mut pair = Pair::with(&Setup { agv, running: 1, ..Setup::default() });
    pair.agv.offer_held("work()");
    pair.agv.offer("stop()", |_| Ok(()));
    pair.publish();
    let ids: std::vec::Vec<_> = (0..4).map(|_| pair.manager.call("work", &none()).unwrap()).collect();
    let stop = pair.manager.request_with("stop", &none(), &emergency(), true).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(ids[3]).unwrap().unwrap_err(), Error::Busy);
    assert!(pair.manager.outcome(stop).unwrap().is_ok());
    assert_eq!((pair.agv.ran(), pair.agv.session.calls_held()), (std::vec!["stop", "work"], 3));
    assert_eq!(pair.agv.counter(LinkCounter::RequestsBusy), 1);
}

#[test]
fn a_call_that_finds_no_buffer_to_wait_in_is_refused_without_one() {
    let mut pair = Pair::live();
    pair.agv.offer_held("work()");
    pair.publish();
    let others = pair.agv.take_buffers();
    // Of three calls in one read, the last could run directly from the read buffer.
    let reported = pair.manager.notify("work", &none()).unwrap();
    let second = pair.manager.call("work", &none()).unwrap();
    let last = pair.manager.call("work", &none()).unwrap();
    pair.run(Duration::from_millis(1));
    pair.agv.give_buffers(others);
    assert_eq!(pair.agv.ran(), ["work"]);
    assert_eq!(pair.agv.counter(LinkCounter::RequestsBusy), 2);
    assert_eq!(pair.manager.outcome(last), None);
    assert_eq!(pair.manager.outcome(second).unwrap().unwrap_err(), Error::Busy);
    assert!(pair.manager.has(&Event::Failed(reported, Error::Busy)));
    assert_eq!(pair.agv.counter(LinkCounter::RepliesDropped), 0);
}

/// The buffer that the call arrived in is returned to the pool, so as many are left as without the call.
#[test]
fn a_long_call_finds_one_buffer_more_to_wait_in() {
    for (more, outcome) in [(0, Err(Error::Busy)), (1, Ok(()))] {
        let mut pair = Pair::with(&Setup { buffers: LEFT_BY_WAITING + more, running: 1, ..Setup::default() });
        pair.agv.offer_held("work(text: string[20000])");
        pair.publish();
        pair.manager.notify("work", &text(20_000)).unwrap();
        pair.settle();
        let second = pair.manager.call("work", &text(20_000)).unwrap();
        pair.settle();
        while !pair.agv.held.is_empty() {
            pair.agv.answer_held(Ok(&*none()));
            pair.settle();
        }
        assert_eq!(pair.manager.outcome(second).unwrap().map(drop), outcome);
    }
}

/// Refusals may use only a few bytes, none of which are reserved for emergencies, and wait for capacity up to a number.
#[test]
fn refusals_without_a_buffer_are_bounded_and_leave_room_for_an_emergency() {
    let mut pair = Pair::live();
    pair.agv.offer_held("work()");
    pair.manager.offer("stop()", |_| Ok(()));
    pair.manager.publish();
    pair.publish();
    let others = pair.agv.take_buffers();
    pair.agv.net.capacity = 0;
    for _ in 0..100 {
        pair.manager.notify("work", &none()).unwrap();
    }
    pair.run(Duration::from_millis(1));
    let dropped = pair.agv.counter(LinkCounter::RepliesDropped);
    assert!(dropped > 0 && dropped < 99 - 64, "{dropped}");
    let stop = pair.agv.request_with("stop", &none(), &emergency(), true).unwrap();
    pair.agv.net.capacity = 1 << 20;
    pair.run(Duration::from_millis(5));
    pair.agv.give_buffers(others);
    assert!(pair.agv.outcome(stop).unwrap().is_ok());
    assert_eq!(pair.manager.count(|event| matches!(event, Event::Failed(_, Error::Busy))) as u64, 99 - dropped);
}

#[test]
fn ids_of_refusals_are_taken_out_in_their_order_whatever_order_they_came_in() {
    use crate::services::calls::Refused;
    let ids = |came: &[u32]| {
        let mut refused = Refused::default();
        let kept: std::vec::Vec<bool> = came.iter().map(|id| refused.insert(*id, id % 2 == 0)).collect();
        let mut out = std::vec![];
        while let Some((id, wants_reply)) = refused.first() {
            assert_eq!(wants_reply, id % 2 == 0);
            out.push(id);
            refused.remove_first();
        }
        (kept, out)
    };
    assert_eq!(ids(&[5, 3, 68]), (std::vec![true, true, false], std::vec![3, 5]));
    assert_eq!(ids(&[70, 7, 6, 8]), (std::vec![true, true, false, true], std::vec![7, 8, 70]));
    assert_eq!(ids(&[u32::MAX, u32::MAX - 63, 0]), (std::vec![true, true, false], std::vec![u32::MAX - 63, u32::MAX]));
    assert_eq!(ids(&[0, 0, 63, 64]), (std::vec![true, true, true, false], std::vec![0, 63]));
}

#[test]
fn a_refusal_that_waited_for_capacity_ends_a_call_that_waits() {
    for is_drained_by_another in [false, true] {
        let mut pair = Pair::live();
        pair.agv.offer_held("work()");
        pair.publish();
        let others = pair.agv.take_buffers();
        pair.agv.net.capacity = 0;
        let calls: std::vec::Vec<_> = (0..60).map(|_| pair.manager.call("work", &none()).unwrap()).collect();
        pair.run(Duration::from_millis(1));
        pair.agv.net.capacity = 1 << 20;
        pair.agv.give_buffers(others);
        if is_drained_by_another {
            // The port sees a stream that is not blocked any more, and does not report that it is writable.
            let agv = &mut pair.agv;
            agv.session.ping(context!(agv)).unwrap();
            assert!(!agv.session.wants_to_write());
        }
        pair.settle();
        let is_busy = |id| matches!(pair.manager.outcome(id), Some(Err(Error::Busy)));
        assert_eq!(calls.iter().filter(|&&id| is_busy(id)).count(), 59);
        assert_eq!(pair.agv.counter(LinkCounter::RepliesDropped), 0);
    }
}
