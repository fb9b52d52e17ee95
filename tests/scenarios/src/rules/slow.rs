//! A slow handler delays no other call.

use cara_core::error::{Error, ServiceError};
use cara_core::services::session::RequestOptions;

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Gate, Seen, Service, Spec, World, number, secs};

scenarios![
    a_slow_handler_delays_no_other_peer: "handlers run outside", Light, [ThirdUnit], ["RequestsRun"];
    a_slow_handler_delays_no_keep_alive: "handlers run outside", Light, [LongTime], ["DatagramsReceived"];
    a_quick_call_overtakes_slow_ones_that_began_before_it: "handlers run outside", Light, [], ["overtook"];
    a_service_calls_its_caller_back: "handlers run outside", Rough, [], ["RequestsRun"];
    two_peers_call_each_other_at_the_same_time: "handlers run outside, 6", Rough, [], ["RequestsRun"];
    many_callers_share_one_link: "6", Rough, [], ["RequestsRun"];
    a_handler_that_panics_is_answered: "handler panics", Rough, [Panics], ["panicked"];
];

const PATIENT: RequestOptions = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::new() };

fn a_slow_handler_delays_no_other_peer(world: &mut dyn World) {
    let gate = Gate::default();
    let slow = Service::numbered("slow").waits_at(&gate);
    let quick = Service::numbered("quick");
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("one", 1).service(&slow));
    world.add(Spec::agv("two", 2).service(&quick));
    met(world, &manager, "one", "slow");
    met(world, &manager, "two", "quick");
    let long = manager.begin("one", "slow", &number("n", 1), PATIENT);
    world.wait("it runs", || slow.log().runs() == 1, secs(10));
    assert_eq!(world.ask(&manager, "two", "quick", &mut number("n", 1)), Ok(()));
    assert!(!long.is_over());
    gate.open();
    assert!(world.finish(&long).is_ok());
}

fn a_slow_handler_delays_no_keep_alive(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("slow").takes(secs(20)));
    assert_eq!(world.ask_with(&manager, "agv", "slow", &mut number("n", 1), PATIENT), Ok(()));
    let left = |event: &Seen| matches!(event, Seen::Left(..));
    assert_eq!((manager.count(left), agv.count(left)), (0, 0));
}

/// Three slow calls and a quick one of the same class: they begin in their order, and the quick one waits for none.
fn a_quick_call_overtakes_slow_ones_that_began_before_it(world: &mut dyn World) {
    let gate = Gate::default();
    let (slow, quick) = (Service::numbered("slow").waits_at(&gate), Service::numbered("quick"));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&slow).service(&quick));
    met(world, &manager, "agv", "slow");
    met(world, &manager, "agv", "quick");
    let long: Vec<_> = (0..3).map(|n| manager.begin("agv", "slow", &number("n", n), PATIENT)).collect();
    world.wait("they run side by side", || slow.log().runs() == 3, secs(10));
    assert_eq!(world.ask(&manager, "agv", "quick", &mut number("n", 1)), Ok(()));
    assert!(long.iter().all(|call| !call.is_over()), "it waited for none of them");
    gate.open();
    assert!(long.iter().all(|call| world.finish(call).is_ok()));
    world.reached("overtook");
}

fn a_service_calls_its_caller_back(world: &mut dyn World) {
    let order = Service::numbered("order");
    let fetch = Service::numbered("fetch").calls_back("order");
    let manager = world.add(Spec::manager("manager", 1).service(&order));
    let agv = world.add(Spec::agv("agv", 7).service(&fetch));
    met(world, &manager, "agv", "fetch");
    met(world, &agv, "manager", "order");
    for n in 0..5 {
        assert_eq!(world.ask(&manager, "agv", "fetch", &mut number("n", n)), Ok(()));
    }
    assert_eq!((order.log().runs(), fetch.log().runs()), (5, 5));
}

fn two_peers_call_each_other_at_the_same_time(world: &mut dyn World) {
    let (one, two) = (Service::numbered("one"), Service::numbered("two"));
    let manager = world.add(Spec::manager("manager", 1).service(&one));
    let agv = world.add(Spec::agv("agv", 7).service(&two));
    met(world, &manager, "agv", "two");
    met(world, &agv, "manager", "one");
    for n in 0..20 {
        let calls = [
            manager.begin("agv", "two", &number("n", n), PATIENT),
            agv.begin("manager", "one", &number("n", n), PATIENT),
        ];
        for call in &calls {
            assert!(world.finish(call).is_ok());
        }
    }
    assert_eq!((one.log().runs(), two.log().runs()), (20, 20));
}

fn many_callers_share_one_link(world: &mut dyn World) {
    let service = Service::numbered("note");
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.calls_per_peer = 32));
    met(world, &manager, "agv", "note");
    for round in 0..40 {
        let calls: Vec<_> =
            (0..8).map(|n| manager.begin("agv", "note", &number("n", 8 * round + n), PATIENT)).collect();
        for call in &calls {
            assert_eq!(world.finish(call).map(drop), Ok(()));
        }
    }
    let mut values = service.log().values();
    values.sort_unstable();
    assert_eq!(values, (0..320).collect::<Vec<_>>());
}

fn a_handler_that_panics_is_answered(world: &mut dyn World) {
    let broken = Service::numbered("broken").does(|_, _| std::panic::panic_any(crate::run::ON_PURPOSE));
    let sound = Service::numbered("sound");
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&broken).service(&sound));
    met(world, &manager, "agv", "broken");
    met(world, &manager, "agv", "sound");
    for n in 0..3 {
        let asked = world.ask(&manager, "agv", "broken", &mut number("n", n));
        assert_eq!(asked, Err(Error::Service(ServiceError::Panicked)));
        assert_eq!(world.ask(&manager, "agv", "sound", &mut number("n", n)), Ok(()), "the rest goes on");
    }
    world.reached("panicked");
}
