//! One-way messages that are written together.

use super::pair::Pair;
use super::setup::Setup;
use super::{none, text, x};
use crate::config::{GATHER, Priority};
use crate::host::connections::LinkCounter;
use crate::services::session::RequestOptions;
use crate::storage::LEFT_BY_SENDING;
use crate::time::Duration;

/// A pair that has been idle, and whose writes are counted from here.
fn quiet() -> Pair {
    let mut pair = Pair::live();
    pair.agv.offer("log(x: int)", |_| Ok(()));
    pair.agv.offer("read(text: string[20000])", |_| Ok(()));
    pair.agv.offer("ask()", |_| Ok(()));
    pair.publish();
    pair.run(Duration::from_millis(10));
    pair.manager.net.writes.clear();
    pair
}

#[test]
fn the_first_message_goes_out_at_once() {
    let mut pair = quiet();
    pair.manager.notify("log", &x(1)).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 1);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log"]);
}

#[test]
fn those_that_follow_closely_go_out_together_when_the_time_is_up() {
    let mut pair = quiet();
    for at in 0..6 {
        pair.manager.notify("log", &x(at)).unwrap();
    }
    assert_eq!(pair.manager.net.writes.len(), 1);
    pair.run(GATHER - Duration::from_micros(1));
    assert_eq!((pair.manager.net.writes.len(), pair.agv.ran().len()), (1, 1));
    pair.run(Duration::from_micros(1));
    assert_eq!((pair.manager.net.writes.len(), pair.agv.ran().len()), (2, 6));
}

#[test]
fn messages_far_apart_go_out_one_by_one() {
    let mut pair = quiet();
    for at in 0..10 {
        pair.manager.notify("log", &x(at)).unwrap();
        assert_eq!(pair.manager.net.writes.len() as i64, at + 1);
        pair.run(GATHER);
    }
}

#[test]
fn what_gathers_goes_out_when_there_is_much_of_it() {
    let mut pair = quiet();
    pair.manager.notify("log", &x(0)).unwrap();
    pair.manager.notify("read", &text(5_000)).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 1);
    pair.manager.notify("read", &text(5_000)).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 2);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log", "read", "read"]);
}

#[test]
fn what_gathers_makes_room_for_what_follows() {
    let mut pair = Pair::with(&Setup { buffer_size: 3_000, ..Setup::default() });
    pair.agv.offer("read(text: string[20000])", |_| Ok(()));
    pair.publish();
    for _ in 0..3 {
        pair.manager.notify("read", &text(1_400)).unwrap();
    }
    pair.run(GATHER);
    assert_eq!(pair.agv.ran(), ["read", "read", "read"]);
}

#[test]
fn what_gathers_goes_out_when_asked() {
    let mut pair = quiet();
    pair.manager.notify("log", &x(1)).unwrap();
    pair.manager.notify("log", &x(2)).unwrap();
    pair.manager.flush_gathered();
    assert_eq!(pair.manager.net.writes.len(), 2);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log", "log"]);
}

#[test]
fn a_call_that_waits_for_its_answer_takes_along_what_has_gathered() {
    let mut pair = quiet();
    pair.manager.notify("log", &x(1)).unwrap();
    pair.manager.notify("log", &x(2)).unwrap();
    pair.manager.call("ask", &none()).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 2);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log", "log", "ask"]);
}

#[test]
fn what_has_gathered_when_the_link_closes_still_arrives() {
    let mut pair = quiet();
    pair.manager.notify("log", &x(1)).unwrap();
    pair.manager.notify("log", &x(2)).unwrap();
    pair.manager.close(crate::error::CloseReason::Stopped);
    pair.settle();
    assert_eq!(pair.agv.counter(LinkCounter::RequestsReceived), 2);
}

/// An AGV with one buffer for sending has begun a call, and gathers a message in that buffer.
fn answering_behind_gathered() -> Pair {
    let mut pair = Pair::with(&Setup { buffers: 1 + LEFT_BY_SENDING, ..Setup::default() });
    pair.agv.offer_held("ask()");
    pair.manager.offer("log(x: int)", |_| Ok(()));
    pair.publish();
    pair.manager.publish();
    pair.run(Duration::from_millis(10));
    pair.manager.call("ask", &none()).unwrap();
    pair.settle();
    let high = RequestOptions { priority: Some(Priority::High), ..RequestOptions::default() };
    pair.agv.notify("log", &x(1)).unwrap();
    pair.agv.request_with("log", &x(2), &high, false).unwrap();
    pair
}

#[test]
fn an_answer_sends_the_gathered_messages_that_hold_the_buffer_it_needs() {
    let mut pair = answering_behind_gathered();
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert_eq!((pair.agv.session.calls_held(), pair.manager.session.calls_in_flight()), (0, 0));
    assert_eq!(pair.manager.counter(LinkCounter::RequestsReceived), 2);
}

#[test]
fn a_refused_message_leaves_no_gathered_one_behind() {
    let mut pair = answering_behind_gathered();
    // Other links hold all buffers of the pool, so the answer is refused even when this link returns its own.
    let taken = pair.agv.take_buffers();
    pair.agv.net.capacity = 0;
    pair.agv.answer_held(Ok(&*none()));
    assert_eq!(pair.agv.session.calls_held(), 1, "the answer waits");
    pair.agv.net.capacity = 1 << 20;
    pair.agv.give_buffers(taken);
    pair.run(GATHER);
    assert_eq!((pair.manager.counter(LinkCounter::RequestsReceived), pair.agv.session.calls_held()), (2, 0));
}
