//! What an emergency call, a release and the end of a hold could wait for inside the core, each full, hung or slow (see "What a
//! stop waits for" in `docs/notes/what-a-stop-waits-for.md`). None of them waits.

use std::vec::Vec;

use super::super::{Delivery, RequestOptions};
use super::net::Datagrams;
use super::none;
use super::pair::Pair;
use super::setup::Setup;
use super::side::Table;
use crate::config::{Constraints, EMERGENCY_CALLS, Priority};
use crate::distribution::function::Attributes;
use crate::distribution::function_list::Slot;
use crate::distribution::message::RequestHeader;
use crate::error::{Error, Limit};
use crate::host::connections::LinkCounter;
use crate::services::access::{Functions, Rate, Rule, Verbs, Who};
use crate::services::heart::Renew;
use crate::services::lease::{LeaseEnd, Service as _};
use crate::services::requests::CallId;
use crate::time::Duration;

const LEASE: Duration = Duration::from_millis(500);
const STOP: Attributes =
    Attributes { priority: Priority::Emergency, idempotent: true, stop: true, ..Attributes::NORMAL };

/// A vehicle whose `go()` moves the drive and `lift()` the fork, both moving; `halt()` stops all, `halt_fork()` the fork.
/// `work()` is never answered.
fn vehicle(setup: &Setup) -> (Pair, [Slot; 2]) {
    let mut pair = Pair::with(setup);
    let go = pair.agv.offer_leased("go()", LEASE);
    let lift = pair.agv.offer_leased("lift()", LEASE);
    pair.agv.offer_control("halt()", STOP, None);
    pair.agv.offer_control("halt_fork()", STOP, Some(lift));
    pair.agv.offer_held("work()");
    pair.publish();
    for function in ["go", "lift"] {
        pair.manager.request_with(function, &none(), &RequestOptions::renewing(Renew::Process), true).unwrap();
    }
    pair.settle();
    assert!(pair.agv.is_live(go) && pair.agv.is_live(lift));
    (pair, [go, lift])
}

fn stop(pair: &mut Pair, function: &str) -> Result<CallId, Error> {
    pair.manager.request_with(function, &none(), &RequestOptions::new(), true)
}

/// Makes as many calls as fit.
fn fill(pair: &mut Pair) -> usize {
    let calls = core::iter::from_fn(|| pair.manager.call("work", &none()).ok()).take(1_000).count();
    assert_eq!(pair.manager.call("work", &none()), Err(Error::Full(Limit::Calls)));
    calls
}

fn is_reported(pair: &Pair, why: LeaseEnd) -> usize {
    pair.manager
        .count(|event| matches!(event, super::super::Event::LeaseEnded { why: reported, .. } if *reported == why))
}

#[test]
fn a_stop_leaves_when_the_callers_table_of_calls_is_full() {
    let (mut pair, [go, lift]) = vehicle(&Setup::default());
    assert_eq!(fill(&mut pair), 128);
    let halt = stop(&mut pair, "halt").unwrap();
    pair.settle();
    assert!(!pair.agv.is_live(go) && !pair.agv.is_live(lift));
    pair.agv.held.retain(|call| call.priority == Priority::Emergency);
    pair.agv.answer_held(Ok(&none()));
    pair.settle();
    assert!(pair.manager.outcome(halt).unwrap().is_ok(), "and its answer finds its caller");
}

#[test]
fn several_stops_leave_when_the_callers_table_is_full_and_no_other_call_takes_their_places() {
    let (mut pair, [go, _]) = vehicle(&Setup::default());
    fill(&mut pair);
    let urgent = RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::new() };
    assert_eq!(
        pair.manager.request_with("work", &none(), &urgent, true),
        Err(Error::Full(Limit::Calls)),
        "the class alone makes no emergency"
    );
    let halts: Vec<_> = (0..EMERGENCY_CALLS).map(|_| stop(&mut pair, "halt").unwrap()).collect();
    assert_eq!(stop(&mut pair, "halt"), Err(Error::Full(Limit::Calls)));
    assert!(pair.manager.request_with("halt", &none(), &RequestOptions::new(), false).is_ok(), "one-way needs none");
    pair.settle();
    assert!(!pair.agv.is_live(go));
    // The vehicle runs two calls of one service at a time, and one waits: the others have stopped motion all the same.
    let outcomes: Vec<_> = halts.iter().map(|id| pair.manager.outcome(*id).map(|outcome| outcome.map(drop))).collect();
    assert_eq!(outcomes.iter().filter(|outcome| **outcome == Some(Err(Error::Busy))).count(), EMERGENCY_CALLS - 2);
}

#[test]
fn a_stop_leaves_beside_a_stream_that_takes_nothing_and_so_do_those_behind_it() {
    let (mut pair, [go, lift]) = vehicle(&Setup::default());
    pair.manager.net.capacity = 0;
    let others = pair.manager.take_buffers();
    // Far more than fit the link's own buffer.
    for at in 0..40 {
        let asked = pair.manager.request_with("halt_fork", &none(), &RequestOptions::new(), false);
        assert!(asked.is_ok(), "stop {at}: {asked:?}");
    }
    pair.settle();
    assert!(pair.agv.is_live(go) && !pair.agv.is_live(lift));
    assert!(stop(&mut pair, "halt").is_ok());
    pair.settle();
    assert!(!pair.agv.is_live(go));
    pair.manager.give_buffers(others);
}

#[test]
fn a_stop_that_can_leave_on_neither_way_says_so() {
    let (mut pair, _) = vehicle(&Setup { datagrams: false, ..Setup::default() });
    pair.manager.net.capacity = 0;
    let asked: Vec<_> = (0..40).map(|_| stop(&mut pair, "halt").map(drop)).collect();
    assert!(asked[..4].iter().all(Result::is_ok), "the stream keeps some: {asked:?}");
    assert!(asked[EMERGENCY_CALLS..].contains(&Err(Error::Full(Limit::SendQueue))), "{asked:?}");
}

#[test]
fn a_stop_is_done_where_its_callees_places_are_full() {
    let agv = Constraints { calls_per_peer: 3, ..Constraints::S_UNIT };
    for function in ["halt", "halt_fork"] {
        let (mut pair, [_, lift]) = vehicle(&Setup { agv, running: 1, ..Setup::default() });
        let others = pair.agv.take_buffers();
        (0..10).for_each(|_| _ = pair.manager.call("work", &none()));
        stop(&mut pair, function).unwrap();
        pair.settle();
        pair.agv.give_buffers(others);
        assert!(!pair.agv.is_live(lift));
        assert!(pair.agv.ran().contains(&function), "{:?}", pair.agv.ran());
    }
}

/// Both wait for the hooks of the orders that they end.
#[test]
fn stops_of_several_services_that_arrive_at_once_all_run() {
    let (mut pair, _) = vehicle(&Setup::default());
    pair.manager.net.datagrams = Datagrams::Lost;
    let stops = [stop(&mut pair, "halt_fork").unwrap(), stop(&mut pair, "halt").unwrap()];
    pair.settle();
    while !pair.agv.held.is_empty() {
        pair.agv.answer_held(Ok(&none()));
        pair.settle();
    }
    for stop in stops {
        assert_eq!(pair.manager.outcome(stop).map(|outcome| outcome.map(drop)), Some(Ok(())));
    }
}

#[test]
fn no_interval_and_no_rate_holds_a_stop_back() {
    let interval = Duration::from_secs(3_600);
    let manager = Constraints { minimum_interval: interval, ..Constraints::M_UNIT };
    let (mut pair, [go, lift]) = vehicle(&Setup::default());
    pair.agv.set_constraints(Constraints { minimum_interval: interval, ..*pair.agv.session.constraints() });
    let rate = Some(Rate::new(1, interval));
    let functions = Functions::Named(std::vec!["halt", "halt_fork"]);
    let stops = Rule { who: Who::ANYBODY, functions, verbs: Verbs::CALL, rate };
    let others = Rule { functions: Functions::Named(std::vec!["go", "lift"]), rate: None, ..stops.clone() };
    pair.agv.set_table(Some(Table(std::vec![stops, others])));
    pair.settle();
    pair.manager.set_constraints(manager);
    for (function, live) in [("halt_fork", [true, false]), ("halt", [false, false]), ("halt", [false, false])] {
        let asked = stop(&mut pair, function).unwrap();
        pair.settle();
        assert_eq!([go, lift].map(|slot| pair.agv.is_live(slot)), live);
        pair.agv.answer_held(Ok(&none()));
        pair.settle();
        assert_eq!(pair.manager.outcome(asked).map(|outcome| outcome.map(drop)), Some(Ok(())), "{function}");
    }
}

#[test]
fn a_stop_that_comes_late_is_done_and_runs() {
    let (mut pair, [go, _]) = vehicle(&Setup { datagrams: false, ..Setup::default() });
    let options = RequestOptions { timeout: Some(Duration::from_millis(100)), ..RequestOptions::new() };
    let latched = |pair: &Pair| pair.agv.functions.function(go).unwrap().handler.lease().unwrap().latch().is_some();
    pair.manager.net.frozen = true;
    pair.manager.request_with("halt", &none(), &options, true).unwrap();
    pair.run(Duration::from_millis(400));
    assert!(!latched(&pair));
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(latched(&pair) && pair.agv.ran().contains(&"halt"));
    assert_eq!(pair.agv.counter(LinkCounter::RequestsExpired), 0);
}

#[test]
fn a_stop_below_the_window_of_its_class_is_done_and_does_not_run() {
    let (mut pair, [go, _]) = vehicle(&Setup { datagrams: false, ..Setup::default() });
    for _ in 0..100 {
        pair.manager.request_with("work", &none(), &RequestOptions::new(), false).unwrap();
    }
    let newest = stop(&mut pair, "halt_fork").unwrap();
    pair.settle();
    assert!(pair.agv.is_live(go));
    let (slot, generation) = {
        let halt = pair.manager.session.their_function_list().named("halt").unwrap();
        (halt.slot, halt.generation)
    };
    let header = RequestHeader {
        id: newest.0 - 90,
        slot,
        generation,
        wants_reply: false,
        wants_progress: false,
        takes_over: false,
        operator: false,
        unknown: 0,
        remaining: Duration::from_secs(1),
        stamp: pair.agv.now.as_micros(),
        since: Duration::ZERO,
        number: 0,
    };
    pair.agv.hear_request(&header, Priority::Emergency, &[]);
    pair.settle();
    assert!(!pair.agv.is_live(go) && !pair.agv.ran().contains(&"halt"));
    assert!(pair.agv.counter(LinkCounter::RequestsRepeated) >= 1);
}

#[test]
fn a_release_arrives_with_every_table_full_and_a_stream_that_takes_nothing() {
    let (mut pair, [go, lift]) = vehicle(&Setup::default());
    let best_effort = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::new() };
    fill(&mut pair);
    pair.manager.net.capacity = 0;
    let others = pair.manager.take_buffers();
    for _ in 0..20 {
        let _ = pair.manager.request_with("halt_fork", &none(), &best_effort, false);
        let _ = pair.manager.release(lift);
    }
    pair.manager.release(go).unwrap();
    pair.settle();
    assert!(!pair.agv.is_live(go));
    pair.manager.give_buffers(others);
}

/// All of their datagrams are lost, and for a while the stream accepts nothing.
#[test]
fn releases_that_wait_for_the_stream_are_all_sent() {
    let (mut pair, slots) = vehicle(&Setup { datagrams: false, ..Setup::default() });
    let held: Vec<_> = pair.manager.session.calling.held.iter().map(|held| held.call).collect();
    pair.manager.net.capacity = 0;
    for _ in 0..40 {
        let _ = stop(&mut pair, "work");
        slots.iter().for_each(|slot| _ = pair.manager.release(*slot));
        held.iter().for_each(|call| pair.manager.cancel(*call));
    }
    pair.manager.net.capacity = 1 << 20;
    pair.run(Duration::from_millis(100));
    assert!(slots.iter().all(|slot| !pair.agv.is_live(*slot)));
    assert_eq!(is_reported(&pair, LeaseEnd::Expired), 0);
}
