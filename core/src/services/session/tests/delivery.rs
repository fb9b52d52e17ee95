//! Delivery: at most once, in time, in order, emergencies first.

use std::vec;
use std::vec::Vec;

use super::super::Event;
use super::net::Datagrams;
use super::pair::Pair;
use super::setup::Setup;
use super::{none, text, x};
use crate::config::{EMERGENCY_BYTES, Priority, WINDOW};
use crate::error::Error;
use crate::host::connections::LinkCounter;
use crate::services::session::{Delivery, RequestOptions};
use crate::time::Duration;

fn urgent(priority: Priority) -> RequestOptions {
    RequestOptions { priority: Some(priority), ..RequestOptions::default() }
}

fn best_effort() -> RequestOptions {
    RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::default() }
}

#[test]
fn an_emergency_that_arrives_three_times_runs_once() {
    let mut pair = Pair::live();
    pair.agv.offer("stop()", |_| Ok(()));
    pair.publish();
    pair.manager.net.datagrams = Datagrams::Twice;
    let id = pair.manager.request_with("stop", &none(), &urgent(Priority::Emergency), true).unwrap();
    pair.settle();
    assert_eq!(pair.agv.ran(), ["stop"]);
    assert_eq!(pair.agv.counter(LinkCounter::RequestsRepeated), 2);
    assert!(pair.manager.outcome(id).unwrap().is_ok());
    assert_eq!(pair.manager.counter(LinkCounter::RepliesLate), 0);
}

#[test]
fn a_datagram_that_arrives_twice_runs_once() {
    let mut pair = Pair::live();
    pair.agv.offer("log(x: int)", |_| Ok(()));
    pair.publish();
    pair.manager.net.datagrams = Datagrams::Twice;
    for at in 0..100 {
        pair.manager.request_with("log", &x(at), &best_effort(), false).unwrap();
    }
    pair.settle();
    assert_eq!((pair.agv.ran().len(), pair.agv.counter(LinkCounter::RequestsRepeated)), (100, 100));
}

#[test]
fn an_emergency_comes_through_a_frozen_stream() {
    let mut pair = Pair::live();
    pair.agv.offer("stop()", |_| Ok(()));
    pair.publish();
    pair.manager.net.frozen = true;
    let id = pair.manager.request_with("stop", &none(), &urgent(Priority::Emergency), true).unwrap();
    pair.settle();
    assert!(pair.manager.outcome(id).unwrap().is_ok());
    pair.manager.net.frozen = false;
    pair.settle();
    assert_eq!(pair.agv.ran(), ["stop"]);
}

#[test]
fn what_a_frozen_link_held_back_is_not_run() {
    let mut pair = Pair::live();
    pair.agv.offer("go()", |_| Ok(()));
    pair.publish();
    pair.manager.net.frozen = true;
    let call = pair.manager.call("go", &none()).unwrap();
    let reported = pair.manager.notify("go", &none()).unwrap();
    pair.run(Duration::from_secs(8));
    assert!(pair.agv.session.is_live(), "datagrams keep it alive");
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(pair.agv.ran().is_empty());
    assert_eq!(pair.manager.outcome(call).unwrap().unwrap_err(), Error::TimedOut);
    assert!(pair.manager.has(&Event::Failed(reported, Error::Expired)));
    assert_eq!(pair.agv.counter(LinkCounter::RequestsExpired), 2);
}

#[test]
fn a_call_is_in_time_until_its_deadline() {
    for (late, ran) in [(1_999_999, 1), (2_000_000, 0)] {
        let mut pair = Pair::live();
        pair.agv.offer("go()", |_| Ok(()));
        pair.publish();
        pair.manager.net.frozen = true;
        pair.manager.notify("go", &none()).unwrap();
        pair.run(Duration::from_micros(late));
        pair.manager.net.frozen = false;
        pair.settle();
        assert_eq!(pair.agv.ran().len(), ran, "after {late} us");
    }
}

#[test]
fn a_call_that_waited_too_long_for_its_turn_is_not_run() {
    let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
    pair.agv.offer_held("work()");
    pair.agv.offer("go()", |_| Ok(()));
    pair.publish();
    pair.manager.call("work", &none()).unwrap();
    let reported = pair.manager.notify("go", &none()).unwrap();
    pair.run(Duration::from_secs(3));
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert_eq!(pair.agv.ran(), ["work"]);
    assert!(pair.manager.has(&Event::Failed(reported, Error::Expired)));
}

#[test]
fn what_falls_behind_the_window_is_stale() {
    for (overtaking, stale) in [(WINDOW - 1, false), (WINDOW, true)] {
        let mut pair = Pair::live();
        pair.agv.offer("go(x: int)", |_| Ok(()));
        pair.publish();
        pair.manager.net.frozen = true;
        let overtaken = pair.manager.notify("go", &x(-1)).unwrap();
        for at in 0..overtaking {
            pair.manager.request_with("go", &x(at.into()), &best_effort(), false).unwrap();
        }
        pair.run(Duration::from_millis(1));
        pair.manager.net.frozen = false;
        pair.settle();
        assert_eq!(pair.manager.has(&Event::Failed(overtaken, Error::Stale)), stale);
        assert_eq!(pair.agv.ran().len() as u32, overtaking + u32::from(!stale));
    }
}

#[test]
fn calls_begin_in_their_order_and_run_side_by_side() {
    let mut pair = Pair::live();
    for function in ["first()", "second()", "third()"] {
        pair.agv.offer_held(function);
    }
    pair.agv.offer("quick()", |_| Ok(()));
    pair.publish();
    for function in ["first", "second", "third"] {
        pair.manager.notify(function, &none()).unwrap();
    }
    let quick = pair.manager.call("quick", &none()).unwrap();
    pair.run(Duration::from_millis(1));
    assert_eq!(pair.agv.ran(), ["first", "second", "third", "quick"]);
    assert!(pair.manager.outcome(quick).unwrap().is_ok(), "while the other three run");
}

#[test]
fn when_no_slot_is_free_a_class_keeps_its_order_and_higher_ones_go_first() {
    let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
    for function in ["first()", "second()", "third()", "high()", "low()"] {
        pair.agv.offer_held(function);
    }
    pair.publish();
    for (function, priority) in
        [("first", Priority::Normal), ("second", Priority::Normal), ("low", Priority::Low), ("third", Priority::Normal)]
    {
        pair.manager.request_with(function, &none(), &urgent(priority), false).unwrap();
    }
    pair.run(Duration::from_millis(1));
    assert_eq!(pair.agv.ran(), ["first"]);
    pair.manager.request_with("high", &none(), &urgent(Priority::High), false).unwrap();
    pair.settle();
    while !pair.agv.held.is_empty() {
        pair.agv.answer_held(Ok(&*none()));
        pair.settle();
    }
    assert_eq!(pair.agv.ran(), ["first", "high", "second", "third", "low"]);
}

/// The hello advertises how many calls may be here at a time; none of those is refused, however slow they are.
#[test]
fn as_many_calls_as_were_told_find_a_place_however_slow_they_are() {
    let mut pair = Pair::with(&Setup { running: 2, ..Setup::default() });
    pair.agv.offer_held("slow()");
    pair.publish();
    let reported = usize::from(pair.manager.session.hello().unwrap().limits.calls);
    let ids: Vec<_> = (0..=reported).map(|_| pair.manager.call("slow", &none()).unwrap()).collect();
    pair.run(Duration::from_millis(1));
    assert_eq!(pair.agv.ran().len(), 2);
    assert_eq!(pair.manager.outcome(ids[reported]).unwrap().unwrap_err(), Error::Busy, "one more than was told");
    while !pair.agv.held.is_empty() {
        pair.agv.answer_held(Ok(&*none()));
        pair.settle();
    }
    assert!(ids[..reported].iter().all(|id| pair.manager.outcome(*id).unwrap().is_ok()));
}

#[test]
fn of_the_calls_that_arrive_together_the_urgent_run_first() {
    let mut pair = Pair::live();
    for function in ["low()", "normal()", "high()", "emergency()"] {
        pair.agv.offer(function, |_| Ok(()));
    }
    pair.publish();
    pair.manager.net.datagrams = Datagrams::Lost;
    let classes = [Priority::Low, Priority::Normal, Priority::High, Priority::Emergency];
    for (function, priority) in ["low", "normal", "high", "emergency"].into_iter().zip(classes) {
        pair.manager.request_with(function, &none(), &urgent(priority), true).unwrap();
    }
    pair.settle();
    assert_eq!(pair.agv.ran(), ["emergency", "high", "normal", "low"]);
}

/// One emergency can wait. Emergencies that arrive in one read begin at once, so need no place to wait.
#[test]
fn emergencies_that_arrive_together_all_run() {
    let mut pair = Pair::live();
    for function in ["stop()", "emergency()", "normal()"] {
        pair.agv.offer(function, |_| Ok(()));
    }
    pair.publish();
    pair.manager.net.datagrams = Datagrams::Lost;
    let functions = ["stop", "emergency", "stop", "normal"];
    for function in functions {
        let class = if function == "normal" { Priority::Normal } else { Priority::Emergency };
        pair.manager.request_with(function, &none(), &urgent(class), true).unwrap();
    }
    pair.settle();
    assert_eq!(pair.agv.ran(), functions);
    assert_eq!(pair.agv.counter(LinkCounter::RequestsBusy), 0);
}

#[test]
fn an_emergency_overtakes_a_long_message_between_its_chunks() {
    let mut pair = Pair::live();
    pair.agv.offer("read(text: string[20000])", |_| Ok(()));
    pair.agv.offer("stop()", |_| Ok(()));
    pair.publish();
    pair.manager.net.datagrams = Datagrams::Lost;
    pair.manager.net.capacity = 100;
    pair.manager.notify("read", &text(20_000)).unwrap();
    while pair.agv.counter(LinkCounter::BytesReceived) < 5_000 {
        pair.step();
    }
    let before = pair.agv.counter(LinkCounter::BytesReceived) as usize;
    pair.manager.request_with("stop", &none(), &urgent(Priority::Emergency), true).unwrap();
    pair.settle();
    let began: Vec<usize> = pair.agv.started().map(|started| started.received).collect();
    assert_eq!(pair.agv.ran(), ["stop", "read"]);
    // The rest of one chunk, the emergency itself, and the capacity of the pipe.
    assert!(began[0] - before <= 1_024 + EMERGENCY_BYTES + 200, "{} bytes", began[0] - before);
}

#[test]
fn a_best_effort_request_goes_in_one_datagram_or_not_at_all() {
    let mut pair = Pair::live();
    pair.agv.offer("log(x: int)", |_| Ok(()));
    pair.publish();
    let writes = pair.manager.net.writes.len();
    pair.manager.request_with("log", &x(1), &best_effort(), false).unwrap();
    pair.settle();
    pair.manager.net.datagrams = Datagrams::Lost;
    pair.manager.request_with("log", &x(2), &best_effort(), false).unwrap();
    pair.settle();
    assert_eq!((pair.agv.ran(), pair.manager.net.writes.len()), (vec!["log"], writes));
}

/// In plain mode only the address distinguishes the peer's datagram from one of a host that knows the link's nonce.
#[test]
fn a_session_datagram_from_another_address_than_the_peers_is_dropped() {
    let mut pair = Pair::live();
    pair.agv.offer("log(x: int)", |_| Ok(()));
    pair.publish();
    pair.manager.request_with("log", &x(1), &best_effort(), false).unwrap();
    let (_, mut datagrams) = pair.manager.net.deliver();
    let (nonce, body) = datagrams.pop().unwrap();
    let peer = pair.agv.session.address();
    let dropped = |pair: &Pair| pair.agv.counter(LinkCounter::DatagramsDropped);
    for other in ["10.0.0.77:7001", "[::1]:7001"] {
        let before = dropped(&pair);
        pair.agv.hear_datagram_from(other.parse().unwrap(), nonce, body.clone());
        assert_eq!((pair.agv.ran().len(), dropped(&pair)), (0, before + 1), "{other}");
    }
    pair.agv.hear_datagram_from(peer, nonce, body);
    assert_eq!(pair.agv.ran(), ["log"], "it was a good one");
}
