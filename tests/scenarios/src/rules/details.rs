//! What is told of calls beside their results: why they fail, how far they are, and that they are given up.

use cara_core::distribution::failure::Failure;
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;

use super::pair;
use crate::scenario::scenarios;
use crate::{Pending, Service, Unit, Watched, World, number, secs};

scenarios![
    a_failure_brings_its_text_and_its_values: "details", Rough, [Details], ["RequestsRun"];
    progress_that_waited_is_the_newest: "details", Rough, [Details], ["ProgressSent", "ProgressReceived"];
    what_a_call_moves_ends_when_it_is_given_up: "details", Rough, [Details], ["RunningCancelled"];
    a_call_that_is_given_up_leaves_a_newer_order_alone: "details", Rough, [Details], ["RunningCancelled"];
];

/// More than any service tells.
const ALL: i64 = i64::MAX;

fn go() -> Service {
    Service::new("go() progress (left: int) fails (at: int[2])")
}

fn watch(unit: &Unit, enough: i64) -> Pending<Watched> {
    let options = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::renewing(Renew::Process) };
    unit.watch("agv", "go", &number("n", 0), options, enough)
}

fn finish(world: &mut dyn World, call: &Pending<Watched>) -> Watched {
    world.finish(call).expect("it was sent")
}

fn a_failure_brings_its_text_and_its_values(world: &mut dyn World) {
    let mut blocked = Failure::new(7, "the way is blocked");
    blocked.values_mut().add_int("at", 2).expect("there is room");
    blocked.values_mut().set_value("at", [3, 4]).expect("it was added so");
    let (manager, _) = pair(world, &go().fails(blocked));
    let call = watch(&manager, ALL);
    let failed = finish(world, &call).outcome.expect_err("it fails");
    let failure = failed.failure().expect("its service says why");
    assert_eq!(failed.error, Error::Service(ServiceError::Failed(7)));
    assert_eq!((failure.code(), failure.text()), (7, "the way is blocked"));
    assert_eq!(failure.values().variable("at"), Ok([3_i64, 4]));
    // A caller that does not ask learns the code.
    let asked = world.ask(&manager, "agv", "go", &mut number("n", 0));
    assert_eq!(asked, Err(Error::Service(ServiceError::Failed(7))));
}

fn progress_that_waited_is_the_newest(world: &mut dyn World) {
    let service = go().reports(200).takes(secs(4));
    let (manager, _) = pair(world, &service);
    let call = watch(&manager, ALL);
    let Watched { reported, outcome } = finish(world, &call);
    assert!(outcome.is_ok(), "{outcome:?}");
    assert_eq!(service.log().values(), [200], "its handler waits for nothing");
    assert!(reported.is_sorted_by(|a, b| a < b) && reported.last() == Some(&200), "{reported:?}");
    assert!(reported.len() < 100, "the others need not come: {reported:?}");
}

fn what_a_call_moves_ends_when_it_is_given_up(world: &mut dyn World) {
    let service = go().reports(20_000).lease(secs(60));
    let (manager, agv) = pair(world, &service);
    let call = watch(&manager, 50);
    let Watched { reported, outcome } = finish(world, &call);
    assert_eq!(outcome.map_err(|failed| failed.error), Err(Error::Cancelled));
    assert!(reported.iter().rev().skip(1).all(|left| *left < 50), "it was given up at once: {reported:?}");
    world.wait("what it moves is safe", || service.log().stops().len() == 1, secs(10));
    world.wait("its handler has seen it", || service.log().values().len() == 1, secs(10));
    assert!(service.log().values()[0] < 20_000);
    assert_eq!(agv.counted(LinkCounter::RunningCancelled), 1);
    assert!(!agv.lease_is_live("go"));
}

fn a_call_that_is_given_up_leaves_a_newer_order_alone(world: &mut dyn World) {
    let service = go().reports(20_000).lease(secs(60));
    let (manager, agv) = pair(world, &service);
    // Seconds, so that the newer one runs before the older one is given up, also where its request is lost and sent again.
    let older = watch(&manager, 5_000);
    world.wait("it runs", || service.log().runs() == 1, secs(10));
    let newer = watch(&manager, 10_000);
    world.wait("the other one runs", || service.log().runs() == 2, secs(4));
    assert!(!older.is_over() && !newer.is_over());
    finish(world, &older).outcome.expect_err("it was given up");
    world.wait("its handler has seen it", || service.log().values().len() == 1, secs(10));
    assert!(!newer.is_over());
    assert!(service.log().stops().is_empty());
    assert!(agv.lease_is_live("go"));
    finish(world, &newer).outcome.expect_err("it was given up");
    world.wait("what it moves is safe", || service.log().stops().len() == 1, secs(10));
    world.run_for(secs(1));
    assert_eq!(service.log().stops().len(), 1);
}
