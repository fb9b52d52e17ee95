//! One-way messages that go out together.

use super::pair::Pair;
use super::setup::Setup;
use super::{none, text, x};
use crate::config::GATHER;
use crate::time::Duration;

/// A pair that has been quiet, and whose writes are counted from here.
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
    pair.manager.tell("log", &x(1)).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 1);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log"]);
}

#[test]
fn those_that_follow_closely_go_out_together_when_the_time_is_up() {
    let mut pair = quiet();
    for at in 0..6 {
        pair.manager.tell("log", &x(at)).unwrap();
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
        pair.manager.tell("log", &x(at)).unwrap();
        assert_eq!(pair.manager.net.writes.len() as i64, at + 1);
        pair.run(GATHER);
    }
}

#[test]
fn what_gathers_goes_out_when_there_is_much_of_it() {
    let mut pair = quiet();
    pair.manager.tell("log", &x(0)).unwrap();
    pair.manager.tell("read", &text(5_000)).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 1);
    pair.manager.tell("read", &text(5_000)).unwrap();
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
        pair.manager.tell("read", &text(1_400)).unwrap();
    }
    pair.run(GATHER);
    assert_eq!(pair.agv.ran(), ["read", "read", "read"]);
}

#[test]
fn what_gathers_goes_out_when_asked() {
    let mut pair = quiet();
    pair.manager.tell("log", &x(1)).unwrap();
    pair.manager.tell("log", &x(2)).unwrap();
    pair.manager.flush_gathered();
    assert_eq!(pair.manager.net.writes.len(), 2);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log", "log"]);
}

#[test]
fn a_call_that_waits_for_its_answer_takes_along_what_has_gathered() {
    let mut pair = quiet();
    pair.manager.tell("log", &x(1)).unwrap();
    pair.manager.tell("log", &x(2)).unwrap();
    pair.manager.call("ask", &none()).unwrap();
    assert_eq!(pair.manager.net.writes.len(), 2);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["log", "log", "ask"]);
}

#[test]
fn what_has_gathered_when_the_link_closes_still_arrives() {
    let mut pair = quiet();
    pair.manager.tell("log", &x(1)).unwrap();
    pair.manager.tell("log", &x(2)).unwrap();
    pair.manager.close(crate::error::CloseReason::Stopped);
    pair.settle();
    assert_eq!(pair.agv.counter(crate::host::connections::LinkCounter::RequestsReceived), 2);
}
