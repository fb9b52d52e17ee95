//! A lease belongs to one call: what is not waited for stops, and an older call never moves again.

use cara_core::config::Priority;
use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::session::{Delivery, RequestOptions};

use super::{best_effort_passes, met, pair};
use crate::scenario::scenarios;
use crate::{Fault, Gate, Seen, Service, Spec, World, millis, number, secs};

scenarios![
    a_call_that_is_not_answered_in_time_stops_at_once: "lease of a service", Light, [], ["stopped"];
    a_released_call_does_not_move_by_the_next_ones_lease: "lease of a service", Light, [], ["RequestsRun"];
    a_call_made_earlier_never_replaces_a_later_one: "order of calls", Own, [Freeze], ["overtaken"];
    a_call_that_waits_keeps_its_place: "order of calls", Light, [], ["waited"];
    a_stop_of_all_outlasts_every_change_of_the_list: "latch", Light, [], ["stopped"];
    a_replaced_call_does_not_move_by_the_next_ones_lease: "lease of a service", Light, [], ["RequestsRun"];
    an_order_that_has_ended_commits_nothing: "lease of a service", Light, [], ["RequestsRun"];
    a_release_ends_the_renewals_of_an_operators_call_too: "lease of a service", Light, [], ["stopped"];
];

const PATIENT: RequestOptions = RequestOptions { timeout: Some(secs(60)), ..RequestOptions::renewing(Renew::Process) };

/// The later one goes as a datagram beside a stream that is held up.
fn a_call_made_earlier_never_replaces_a_later_one(world: &mut dyn World) {
    let (service, note) = (mover(), Service::numbered("note"));
    let log = service.log();
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&service).service(&note));
    met(world, &manager, "agv", "drive");
    met(world, &manager, "agv", "note");
    best_effort_passes(world, &manager, "agv", "note");
    world.fault(Fault::FreezeStreams(&manager, &agv, secs(4)));
    let first = manager.request_with("agv", "drive", &number("n", 1), PATIENT).expect("it is accepted");
    let best_effort = RequestOptions { delivery: Delivery::BestEffort, ..PATIENT };
    manager.request_with("agv", "drive", &number("n", 2), best_effort).expect("it is accepted");
    world.wait("the second moves", || log.values().contains(&2), secs(20));
    let refused = Seen::Failed(first, Error::Replaced);
    world.wait("the first is refused", || manager.count(|event| *event == refused) == 1, secs(30));
    assert!(agv.lease_is_live("drive") && !log.values().contains(&1) && log.stops().is_empty(), "{}", world.story());
    world.reached("overtaken");
    manager.release("agv", "drive").expect("it is connected");
    world.wait("the safe hook runs", || log.stops().len() == 1, secs(20));
}

/// The first is made before the minimum interval lets it go, and the second, in between, is an asynchronous one.
fn a_call_that_waits_keeps_its_place(world: &mut dyn World) {
    let (service, other) = (mover(), Service::numbered("note"));
    let log = service.log();
    let manager = world.add(Spec::manager("manager", 1).limits(|limits| limits.minimum_interval = secs(2)));
    let agv = world.add(Spec::agv("agv", 7).service(&service).service(&other));
    met(world, &manager, "agv", "drive");
    met(world, &manager, "agv", "note");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
    let first = manager.begin("agv", "drive", &number("n", 1), PATIENT);
    world.run_for(millis(500));
    if first.is_over() || !log.values().is_empty() {
        return;
    }
    manager.change(|limits| limits.minimum_interval = millis(0));
    manager.request_with("agv", "drive", &number("n", 2), PATIENT).expect("it is accepted");
    manager.change(|limits| limits.minimum_interval = secs(2));
    let asked = world.finish(&first).map(drop);
    if asked == Err(Error::Replaced) {
        world.reached("waited");
    }
    assert!(agv.lease_is_live("drive") && log.values().last() != Some(&1), "{asked:?}{}", world.story());
    manager.release("agv", "drive").expect("it is connected");
    world.wait("the safe hook runs", || !log.stops().is_empty(), secs(20));
}

/// A service that is replaced, one that is added, and one that is removed and added again.
fn a_stop_of_all_outlasts_every_change_of_the_list(world: &mut dyn World) {
    let leased = |name: &str| Service::numbered(name).lease(secs(60));
    let (drive, halt) = (leased("drive"), Service::numbered("halt").priority(Priority::Emergency).stops_all());
    let manager = world.add(Spec::manager("manager", 1));
    let free = Service::numbered("free").resets_all();
    let agv = world.add(Spec::agv("agv", 7).service(&drive).service(&halt).service(&free));
    met(world, &manager, "agv", "free");
    met(world, &manager, "agv", "drive");
    assert_eq!(world.ask(&manager, "agv", "drive", &mut number("n", 1)), Ok(()));
    assert_eq!(world.ask(&manager, "agv", "halt", &mut number("n", 1)), Ok(()));
    let stopped = Err(Error::Inhibited { by: 1, reason: 0 });
    assert_eq!(world.ask(&manager, "agv", "drive", &mut number("n", 2)), stopped);
    let (drive, lift, tilt) = (leased("drive"), leased("lift"), leased("tilt"));
    agv.add_service(&tilt).expect("there is room");
    agv.remove_service("tilt").expect("it is there");
    agv.replace_service(&drive).expect("it is there");
    agv.add_service(&lift).expect("there is room");
    agv.add_service(&tilt).expect("there is room");
    agv.publish().expect("it can be published");
    met(world, &manager, "agv", "lift");
    met(world, &manager, "agv", "tilt");
    world.run_for(secs(1));
    for function in ["drive", "lift", "tilt"] {
        assert_eq!(world.ask(&manager, "agv", function, &mut number("n", 3)), stopped, "{function}");
    }
    world.reached("stopped");
    assert_eq!(world.ask(&manager, "agv", "free", &mut number("n", 1)), Ok(()));
    for function in ["drive", "lift", "tilt"] {
        assert_eq!(world.ask(&manager, "agv", function, &mut number("n", 4)), Ok(()), "{function}");
    }
    assert_eq!([&drive, &lift, &tilt].map(|service| service.log().runs()), [1; 3]);
}

/// Moves once a second while it is wanted. Its lease is longer than any wait here, so that time alone ends nothing.
fn mover() -> Service {
    Service::new("drive(n: int[1])").lease(secs(60)).moves_every(secs(1))
}

fn a_call_that_is_not_answered_in_time_stops_at_once(world: &mut dyn World) {
    let service = mover();
    let (manager, agv) = pair(world, &service);
    for (renew, times) in [(Renew::Process, 1), (Renew::Never, 2)] {
        let options = RequestOptions { timeout: Some(secs(3)), renew, ..PATIENT };
        assert_eq!(world.ask_with(&manager, "agv", "drive", &mut number("n", 1), options), Err(Error::TimedOut));
        let log = service.log();
        let start = world.now();
        world.wait("the safe hook runs", || log.stops().len() == times, secs(20));
        world.measured("time-out of a call to safe hook", log.stops()[times - 1].since(start));
        assert!(!agv.lease_is_live("drive"));
        world.wait("its handler ends", || log.ended().len() == times, secs(20));
    }
    assert!(manager.is_connected("agv"));
    world.reached("stopped");
}

fn a_released_call_does_not_move_by_the_next_ones_lease(world: &mut dyn World) {
    only_the_newest_moves(world, true);
}

fn a_replaced_call_does_not_move_by_the_next_ones_lease(world: &mut dyn World) {
    only_the_newest_moves(world, false);
}

/// Between two looks of the first call's handler at its lease, the second call begins.
fn only_the_newest_moves(world: &mut dyn World, released: bool) {
    let service = mover();
    let log = service.log();
    let (manager, agv) = pair(world, &service);
    let first = manager.begin("agv", "drive", &number("n", 1), PATIENT);
    world.wait("the first moves", || log.values().contains(&1), secs(20));
    if released {
        manager.release("agv", "drive").expect("it is connected");
        world.wait("the safe hook runs", || log.stops().len() == 1, secs(20));
    }
    let second = manager.begin("agv", "drive", &number("n", 2), PATIENT);
    world.wait("the second moves", || log.values().contains(&2), secs(20));
    let moved = log.values().len();
    world.wait("the first has ended", || first.is_over(), secs(20));
    world.run_for(secs(3));
    assert!(log.values()[moved..].iter().all(|n| *n == 2), "the first has moved again: {:?}", log.values());
    assert!(agv.lease_is_live("drive") && !second.is_over());
    let replaced = Seen::LeaseEnded("drive".to_owned(), LeaseEnd::Replaced);
    let (stops, reported) = if released { (1, 0) } else { (0, 1) };
    assert_eq!((log.stops().len(), manager.count(|event| *event == replaced)), (stops, reported));
    manager.release("agv", "drive").expect("it is connected");
    world.wait("the safe hook runs", || log.stops().len() == stops + 1, secs(20));
    assert_eq!(world.finish(&second).map(drop), Ok(()));
}

/// Its handler is held up until the order has ended, and changes something only then.
fn an_order_that_has_ended_commits_nothing(world: &mut dyn World) {
    let gate = Gate::default();
    let service = Service::new("drive(n: int[1])").lease(secs(60)).waits_at(&gate).commits();
    let stop = Service::new("stop()").stops_all();
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&service).service(&stop));
    met(world, &manager, "agv", "drive");
    met(world, &manager, "agv", "stop");
    let log = service.log();
    gate.open();
    assert_eq!(world.ask_with(&manager, "agv", "drive", &mut number("n", 1), PATIENT), Ok(()));
    assert_eq!(log.values(), [1], "it is live");
    for (n, end) in [(2, "release"), (3, "replace"), (5, "release"), (6, "stop")] {
        gate.close();
        let (runs, changed, stops) = (log.runs(), log.values(), log.stops().len());
        let begin = |n| manager.begin("agv", "drive", &number("n", n), PATIENT);
        let ended = begin(n);
        world.wait("its handler runs", || log.runs() == runs + 1, secs(20));
        let newer = (end == "replace").then(|| begin(4));
        match end {
            "release" => manager.release("agv", "drive").expect("it is connected"),
            "stop" => assert_eq!(world.ask(&manager, "agv", "stop", &mut number("n", 1)), Ok(())),
            _ => world.wait("the newer one runs", || log.runs() == runs + 2, secs(20)),
        }
        if newer.is_none() {
            world.wait("the safe hook runs", || log.stops().len() == stops + 1, secs(20));
        }
        gate.open();
        assert!(world.finish(&ended).is_err(), "{end}");
        let expected = if newer.is_some() { [changed, vec![4]].concat() } else { changed };
        newer.iter().for_each(|newer| assert_eq!(world.finish(newer).map(drop), Ok(())));
        assert_eq!(log.values(), expected, "it has changed something although its order has ended: {end}");
        assert_eq!(agv.lease_is_live("drive"), newer.is_some());
    }
}

fn a_release_ends_the_renewals_of_an_operators_call_too(world: &mut dyn World) {
    let lease = millis(if world.is_virtual() { 400 } else { 1_600 });
    let service = Service::new("drive(n: int[1])").lease(lease);
    let (manager, agv) = pair(world, &service);
    let reported = |event: &Seen| matches!(event, Seen::LeaseEnded(..));
    for operator in [false, true] {
        let options = RequestOptions { operator, ..PATIENT };
        let mut asked = Err(Error::Expired);
        for _ in 0..200 {
            asked = world.ask_with(&manager, "agv", "drive", &mut number("n", 1), options);
            // On a busy machine the lease may be over before it began.
            if asked != Err(Error::Expired) {
                break;
            }
        }
        assert_eq!(asked, Ok(()));
        manager.release("agv", "drive").expect("it is connected");
        let before = manager.count(reported);
        world.run_for(lease);
        assert!(!agv.lease_is_live("drive"));
        // A renewal of a call that has ended is answered, and what is still renewed is told.
        assert_eq!(manager.count(reported), before, "it was renewed behind its release, operator: {operator}");
    }
    world.reached("stopped");
}
