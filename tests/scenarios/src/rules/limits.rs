//! What is full says so: everything sent is executed or reported.

use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::RequestOptions;

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Seen, Service, Spec, World, millis, number, secs, text};

scenarios![
    asynchronous_requests_are_executed_or_reported: "full queues", Rough, [], ["RequestsBusy", "reported"];
    blocking_requests_beyond_the_limit_are_busy: "full queues", Rough, [], ["RequestsBusy"];
    calls_in_flight_beyond_the_table_end_all_the_same: "full queues", Rough, [], ["CallsTimedOut"];
    few_buffers_delay_and_lose_nothing: "full queues", Rough, [ThirdUnit], ["executed"];
    a_slow_reader_does_not_delay_the_others: "slow reader", Own, [Path, ThirdUnit], ["SendRefused", "bandwidth"];
];

fn asynchronous_requests_are_executed_or_reported(world: &mut dyn World) {
    let service = Service::numbered("note").takes(millis(5));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.calls_per_peer = 4));
    met(world, &manager, "agv", "note");
    let options = RequestOptions { timeout: Some(secs(60)), ..RequestOptions::default() };
    let mut accepted = 0;
    for n in 0..200 {
        accepted += usize::from(manager.request_with("agv", "note", &number("n", n), options).is_ok());
    }
    assert!(accepted >= 8, "{accepted}");
    let failed = || manager.count(|event| matches!(event, Seen::Failed(_, Error::Busy)));
    let runs = || service.log().runs();
    world.wait("each is executed or reported", || runs() + failed() == accepted, secs(30));
    world.run_for(millis(500));
    assert_eq!(runs() + failed(), accepted);
    if failed() > 0 {
        world.reached("reported");
    }
}

fn blocking_requests_beyond_the_limit_are_busy(world: &mut dyn World) {
    let service = Service::numbered("note").takes(millis(100));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.calls_per_peer = 4));
    met(world, &manager, "agv", "note");
    let options = RequestOptions { timeout: Some(secs(20)), ..RequestOptions::default() };
    let calls: Vec<_> = (0..12).map(|n| manager.begin("agv", "note", &number("n", n), options)).collect();
    let outcomes: Vec<_> = calls.iter().map(|call| world.finish(call).map(drop)).collect();
    let count = |wanted: Result<(), Error>| outcomes.iter().filter(|outcome| **outcome == wanted).count();
    assert_eq!(count(Ok(())) + count(Err(Error::Busy)), 12, "{outcomes:?}");
    assert!(count(Ok(())) >= 4 && count(Err(Error::Busy)) >= 1, "{outcomes:?}");
    assert_eq!(service.log().runs(), count(Ok(())), "what was busy did not run");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 99)), Ok(()), "every place is free again");
}

fn calls_in_flight_beyond_the_table_end_all_the_same(world: &mut dyn World) {
    let service = Service::numbered("note").takes(millis(600));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.calls_per_peer = 64));
    met(world, &manager, "agv", "note");
    let options = RequestOptions { timeout: Some(millis(300)), ..RequestOptions::default() };
    let calls: Vec<_> = (0..80).map(|n| manager.begin("agv", "note", &number("n", n), options)).collect();
    for call in &calls {
        let error = world.finish(call).map(drop).expect_err("the service takes longer than the caller waits");
        assert!(matches!(error, Error::TimedOut | Error::Full(_) | Error::Busy | Error::Expired), "{error:?}");
    }
    world.run_for(millis(700));
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 99)), Ok(()), "every slot is free again");
}

fn few_buffers_delay_and_lose_nothing(world: &mut dyn World) {
    let service = Service::new("store(text: string[4000])");
    let manager = world.add(Spec::manager("manager", 9).service(&service).message_buffers(2));
    let mut callers = Vec::new();
    for id in 0..4 {
        let caller = world.add(Spec::manager(&format!("caller-{id}"), id));
        met(world, &caller, "manager", "store");
        callers.push(caller);
    }
    let options = RequestOptions { timeout: Some(secs(6)), ..RequestOptions::default() };
    let mut calls = Vec::new();
    for _ in 0..5 {
        calls.extend(callers.iter().map(|caller| caller.begin("manager", "store", &text(4_000), options)));
    }
    let (mut executed, mut unanswered) = (0, 0);
    for call in &calls {
        match world.finish(call).map(drop) {
            Ok(()) => executed += 1,
            Err(Error::Busy | Error::Full(_)) => world.reached("reported"),
            Err(Error::TimedOut) => unanswered += 1,
            Err(other) => panic!("{other:?}{}", world.story()),
        }
    }
    assert_eq!(service.log().runs(), executed, "{}", world.story());
    // A refusal that finds room nowhere is counted on both sides.
    assert_eq!(manager.counted(LinkCounter::RepliesDropped), unanswered, "{}", world.story());
    if executed > 0 {
        world.reached("executed");
    }
}

fn a_slow_reader_does_not_delay_the_others(world: &mut dyn World) {
    let service = Service::new("store(text: string[900])");
    let (manager, slow) = pair(world, &service);
    let quick = Service::numbered("note");
    world.add(Spec::agv("quick", 8).service(&quick));
    met(world, &manager, "quick", "note");
    world.fault(crate::Fault::Path(&manager, &slow, cara_sim::Path::LAN.bits_per_second(8_000)));
    let (mut accepted, mut refused) = (0_usize, 0_usize);
    for _ in 0..200 {
        match manager.request("agv", "store", &text(900)) {
            Ok(_) => accepted += 1,
            Err(Error::Full(_)) => refused += 1,
            Err(other) => panic!("{other:?}"),
        }
    }
    assert!(refused > 0 && manager.counted(LinkCounter::SendRefused) > 0, "the queue is bounded");
    for n in 0..20 {
        let start = world.now();
        assert_eq!(world.ask(&manager, "quick", "note", &mut number("n", n)), Ok(()));
        assert!(world.now().since(start) < millis(2), "the slow one delays the quick one");
    }
    assert!(accepted > 0);
}
