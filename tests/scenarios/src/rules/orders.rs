//! A lease belongs to one call: what is not waited for stops, and an older call never moves again.

use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::session::RequestOptions;

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Gate, Seen, Service, Spec, World, millis, number, secs};

scenarios![
    a_call_that_is_not_answered_in_time_stops_at_once: "lease of a service", Light, [], ["stopped"];
    a_released_call_does_not_move_by_the_next_ones_lease: "lease of a service", Light, [], ["RequestsRun"];
    a_replaced_call_does_not_move_by_the_next_ones_lease: "lease of a service", Light, [], ["RequestsRun"];
    an_order_that_has_ended_commits_nothing: "lease of a service", Light, [], ["RequestsRun"];
    a_release_ends_the_renewals_of_an_operators_call_too: "lease of a service", Light, [], ["stopped"];
];

const PATIENT: RequestOptions = RequestOptions { timeout: Some(secs(60)), ..RequestOptions::renewing(Renew::Process) };

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
    let (stops, told) = if released { (1, 0) } else { (0, 1) };
    assert_eq!((log.stops().len(), manager.count(|event| *event == replaced)), (stops, told));
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
    let told = |event: &Seen| matches!(event, Seen::LeaseEnded(..));
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
        let before = manager.count(told);
        world.run_for(lease);
        assert!(!agv.lease_is_live("drive"));
        // A renewal of a call that has ended is answered, and what is still renewed is told.
        assert_eq!(manager.count(told), before, "it was renewed behind its release, operator: {operator}");
    }
    world.reached("stopped");
}
