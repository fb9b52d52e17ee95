//! The minimum time between requests to one node.

use cara_core::error::Error;
use cara_core::services::session::RequestOptions;

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Service, Spec, Unit, World, millis, number, secs};

scenarios![
    a_blocking_request_waits_for_the_interval: "49–50", Rough, [], ["RequestsWithheld", "interval removed"];
    an_asynchronous_request_too_soon_is_refused: "49–50", Rough, [], ["RequestsWithheld", "interval removed"];
    each_node_has_an_interval_of_its_own: "49", Rough, [ThirdUnit], ["RequestsRun"];
    the_callee_tells_its_interval: "49", Rough, [], ["RequestsWithheld"];
    a_wait_beyond_the_deadline_is_refused: "49", Rough, [], ["RequestsWithheld"];
];

/// The interval in this file: above what a network delays.
const INTERVAL_MILLIS: u64 = 100;

/// Five blocking requests; how long they took together.
fn five(world: &mut dyn World, manager: &Unit) -> cara_core::time::Duration {
    let start = world.now();
    for n in 0..5 {
        assert_eq!(world.ask(manager, "agv", "note", &mut number("n", n)), Ok(()));
    }
    world.now().since(start)
}

fn a_blocking_request_waits_for_the_interval(world: &mut dyn World) {
    let service = Service::numbered("note");
    let (manager, _agv) = pair(world, &service);
    manager.change(|limits| limits.minimum_interval = millis(INTERVAL_MILLIS));
    assert!(five(world, &manager) >= millis(4 * INTERVAL_MILLIS));
    manager.change(|limits| limits.minimum_interval = millis(0));
    let (before, options) = (world.now(), RequestOptions::default());
    let calls: Vec<_> = (0..5).map(|n| manager.begin("agv", "note", &number("n", n), options)).collect();
    for call in &calls {
        world.finish(call).expect("it is answered");
    }
    if world.now().since(before) < millis(4 * INTERVAL_MILLIS) {
        world.reached("interval removed");
    }
    assert_eq!(service.log().runs(), 10);
}

fn an_asynchronous_request_too_soon_is_refused(world: &mut dyn World) {
    let service = Service::numbered("note").in_turns();
    let (manager, _agv) = pair(world, &service);
    manager.change(|limits| limits.minimum_interval = secs(60));
    let began = world.now();
    manager.request("agv", "note", &number("n", 1)).expect("the first is accepted");
    let second = manager.request("agv", "note", &number("n", 2));
    let left = secs(60) - world.now().since(began);
    assert!(matches!(second, Err(Error::TooSoon { wait }) if wait <= secs(60) && wait >= left), "{second:?} {left:?}");
    manager.change(|limits| limits.minimum_interval = millis(0));
    manager.request("agv", "note", &number("n", 3)).expect("zero switches it off");
    world.reached("interval removed");
    world.wait("both ran", || service.log().values() == [1, 3], secs(10));
}

fn each_node_has_an_interval_of_its_own(world: &mut dyn World) {
    let service = Service::numbered("note");
    let manager = world.add(Spec::manager("manager", 1).limits(|limits| limits.minimum_interval = secs(60)));
    world.add(Spec::agv("one", 1).service(&service));
    world.add(Spec::agv("two", 2).service(&service));
    met(world, &manager, "one", "note");
    met(world, &manager, "two", "note");
    manager.request("one", "note", &number("n", 1)).expect("one was not asked yet");
    manager.request("two", "note", &number("n", 2)).expect("two was not asked yet");
    assert!(matches!(manager.request("one", "note", &number("n", 3)), Err(Error::TooSoon { .. })));
    world.wait("both ran", || service.log().runs() == 2, secs(10));
}

fn the_callee_tells_its_interval(world: &mut dyn World) {
    let service = Service::numbered("note");
    let manager = world.add(Spec::manager("manager", 1));
    let spec = Spec::agv("agv", 7).service(&service).limits(|limits| limits.minimum_interval = millis(INTERVAL_MILLIS));
    let agv = world.add(spec);
    met(world, &manager, "agv", "note");
    assert!(five(world, &manager) >= millis(4 * INTERVAL_MILLIS));
    agv.change(|limits| limits.minimum_interval = secs(5));
    let reported =
        || matches!(manager.request("agv", "note", &number("n", 9)), Err(Error::TooSoon { wait }) if wait > secs(1));
    world.wait("the change is told", reported, secs(10));
}

fn a_wait_beyond_the_deadline_is_refused(world: &mut dyn World) {
    let (manager, _agv) = pair(world, &Service::numbered("note"));
    manager.change(|limits| limits.minimum_interval = secs(60));
    manager.request("agv", "note", &number("n", 1)).expect("the first is accepted");
    let start = world.now();
    let second = world.ask(&manager, "agv", "note", &mut number("n", 2));
    assert!(matches!(second, Err(Error::TooSoon { .. })), "{second:?}");
    assert!(world.now().since(start) < secs(2), "it does not wait for what cannot be");
}
