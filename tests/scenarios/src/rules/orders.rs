//! A lease belongs to one call: what is not waited for stops, and an older call never moves again.

use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::session::RequestOptions;

use super::pair;
use crate::scenario::scenarios;
use crate::{Seen, Service, World, number, secs};

scenarios![
    a_call_that_is_not_answered_in_time_stops_at_once: "lease of a service", Light, [], ["stopped"];
    a_released_call_does_not_move_by_the_next_ones_lease: "lease of a service", Light, [], ["RequestsRun"];
    a_replaced_call_does_not_move_by_the_next_ones_lease: "lease of a service", Light, [], ["RequestsRun"];
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
