//! A vehicle does only what its manager still wants.

use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Fault, Heart, Seen, Service, Spec, Unit, World, millis, number, secs};

scenarios![
    a_lease_lives_while_it_is_renewed: "lease of a service", Light, [], ["RequestsRun"];
    motion_ends_when_the_manager_loses_power: "lease of a service, 29", Light, [Crash, ExactTime],
        ["power-cut", "LeasesExpired"];
    motion_ends_when_the_path_is_cut: "lease of a service", Light, [Partition, ExactTime],
        ["partition", "LeasesExpired"];
    motion_ends_when_the_link_freezes: "lease of a service", Light, [FreezeLink, ExactTime], ["freeze", "LeasesExpired"];
    motion_ends_when_the_manager_stops: "lease of a service", Light, [], ["stopped"];
    without_a_lease_motion_goes_on: "lease of a service (lease removed)", Rough, [], ["went on"];
    a_lease_that_is_not_renewed_ends: "lease of a service", Light, [], ["LeasesExpired"];
    a_loop_that_hangs_ends_what_it_wanted_and_nothing_else: "heart of a loop", Light, [], ["hung"];
    a_heart_that_is_dropped_releases_all_that_it_renewed: "heart of a loop", Light, [DroppedHearts], ["released"];
    a_renewal_that_comes_after_the_end_revives_nothing: "lease of a service", Light, [Suspend], ["LeasesExpired"];
    a_manager_that_takes_over_has_the_vehicle_alone: "terms of managers", Light, [ThirdUnit], ["fenced"];
    an_operator_and_the_program_of_a_manager_hold_for_themselves: "lease of a service", Light, [], ["taken over"];
    a_released_lease_stops_at_once: "lease of a service", Light, [], ["stopped"];
    what_a_service_that_goes_has_started_stops_at_once: "lease of a service", Light, [], ["gone"];
    what_is_finished_needs_no_safe_hook: "lease of a service", Light, [], ["finished"];
    what_is_finished_is_one_order_and_not_the_newer_one: "lease of a service", Light, [], ["went on"];
];

/// The lease in this file. In real time a busy machine may delay renewals.
fn lease(world: &dyn World) -> Duration {
    millis(if world.is_virtual() { 400 } else { 1_200 })
}

/// The lease where time is to end nothing: in real time so long that it ends nothing.
fn long(world: &dyn World) -> Duration {
    if world.is_virtual() { lease(world) } else { secs(60) }
}

/// How often a lease is begun that a busy machine does not renew in time.
const TRIES: u32 = 5;
/// What may come on top of the lease: one poll, in virtual time nothing.
const SLACK: Duration = Duration::from_millis(1);

/// Asks to drive, again where the network was so slow that the lease would have been over before it began, or that the
/// manager has not heard of the function yet.
fn drive(world: &mut dyn World, manager: &Unit) {
    let mut asked = Err(Error::Expired);
    for _ in 0..200 {
        asked = world.ask(manager, "agv", "drive", &mut number("n", 1));
        if !matches!(asked, Err(Error::Expired | Error::StaleFunction)) {
            break;
        }
        world.run_for(millis(20));
    }
    assert_eq!(asked, Ok(()));
}

/// An AGV that drives because its manager wants it, with a lease that time is not to end.
fn driving(world: &mut dyn World) -> (Service, Unit, Unit) {
    let service = Service::new("drive(n: int[1])").lease(long(world));
    let (manager, agv) = pair(world, &service);
    drive(world, &manager);
    assert!(agv.lease_is_live("drive"));
    (service, manager, agv)
}

fn a_lease_lives_while_it_is_renewed(world: &mut dyn World) {
    let service = Service::new("drive(n: int[1])").lease(lease(world));
    let (manager, agv) = pair(world, &service);
    let round = millis(100);
    for _ in 0..TRIES {
        let stops = service.log().stops().len();
        let (mut last, mut longest) = (world.now(), Duration::ZERO);
        drive(world, &manager);
        let (until, mut lives) = (world.now() + lease(world).times(3), agv.lease_is_live("drive"));
        while lives && world.now() < until {
            world.run_for(round);
            longest = longest.max(world.now().since(last));
            last = world.now();
            lives = agv.lease_is_live("drive");
        }
        if lives {
            assert_eq!(service.log().stops().len(), stops);
            return;
        }
        // On a busy machine a renewal may come so late that the motion has ended, which is as it should be.
        longest = longest.max(world.now().since(last));
        assert!(!world.is_virtual() && longest > round.times(2), "the longest round took {} ms", longest.as_millis());
    }
    panic!("{TRIES} times the machine was too busy to renew a lease");
}

/// Injects a fault at a random instant and measures the time until the safe hook; nothing may start again.
fn ends(world: &mut dyn World, what: &'static str, fault: impl Fn(&mut dyn World, &Unit, &Unit)) {
    let (service, manager, agv) = driving(world);
    let calm = millis(500) + Duration::from_micros(world.random(1_000_000));
    world.run_for(calm);
    let start = world.now();
    fault(world, &manager, &agv);
    let log = service.log();
    world.wait("the safe hook runs", || !log.stops().is_empty(), secs(20));
    let took = log.stops()[0].since(start);
    assert!(took <= lease(world) + SLACK, "{} us after the fault", took.as_micros());
    assert!(!agv.lease_is_live("drive"));
    world.measured(what, took);
    world.run_for(secs(20));
    assert_eq!((log.runs(), log.stops().len()), (1, 1), "nothing moves again by itself");
    assert_eq!(agv.count(|event| matches!(event, Seen::LeaseExpired(_))), 1);
    assert!(!agv.lease_is_live("drive"));
}

fn motion_ends_when_the_manager_loses_power(world: &mut dyn World) {
    ends(world, "power cut of the manager to safe hook", |world, manager, _| {
        world.fault(Fault::PowerCut(manager));
    });
}

fn motion_ends_when_the_path_is_cut(world: &mut dyn World) {
    ends(world, "cut path to safe hook", |world, manager, agv| world.fault(Fault::Cut(manager, agv)));
}

fn motion_ends_when_the_link_freezes(world: &mut dyn World) {
    // What was held arrives at once after the thaw, old renewals and commands among it.
    ends(world, "frozen link to safe hook", |world, manager, agv| {
        world.fault(Fault::FreezeLink(manager, agv, secs(8)));
        manager.request("agv", "drive", &number("n", 2)).expect("it is accepted");
    });
}

fn motion_ends_when_the_manager_stops(world: &mut dyn World) {
    let (service, manager, agv) = driving(world);
    manager.stop();
    world.wait("the safe hook runs", || service.log().stops().len() == 1, secs(10));
    assert!(!agv.lease_is_live("drive"));
    world.run_for(millis(500));
    assert_eq!(service.log().stops().len(), 1);
    world.reached("stopped");
}

fn without_a_lease_motion_goes_on(world: &mut dyn World) {
    let service = Service::new("drive(n: int[1])");
    let (manager, _agv) = pair(world, &service);
    assert_eq!(world.ask(&manager, "agv", "drive", &mut number("n", 1)), Ok(()));
    manager.stop();
    let long = lease(world).times(4);
    world.run_for(long);
    assert_eq!(service.log().stops(), [], "nobody stops it");
    world.reached("went on");
}

fn a_lease_that_is_not_renewed_ends(world: &mut dyn World) {
    let service = Service::new("drive(n: int[1])").lease(lease(world));
    let (manager, agv) = pair(world, &service);
    let options = RequestOptions { renew: Renew::Never, timeout: Some(secs(10)), ..RequestOptions::default() };
    assert_eq!(world.ask_with(&manager, "agv", "drive", &mut number("n", 1), options), Ok(()));
    world.wait("the safe hook runs", || service.log().stops().len() == 1, secs(10));
    assert!(!agv.lease_is_live("drive"));
    let took = service.log().stops()[0].since(service.log().began()[0]);
    assert!(!world.is_virtual() || took <= lease(world) + SLACK, "{} ms", took.as_millis());
    let expired = || manager.count(|event| *event == Seen::LeaseEnded("drive".to_owned(), LeaseEnd::Expired));
    // The caller holds no lease, so the news of its end is not its matter.
    world.run_for(millis(200));
    assert_eq!(expired(), 0);
}

/// Asks for a motion that goes on while a heart beats.
fn want(world: &mut dyn World, manager: &Unit, function: &str, heart: &mut Heart) {
    let mut asked = Err(Error::Expired);
    for _ in 0..200 {
        heart.beat();
        let options = RequestOptions { timeout: Some(secs(10)), ..RequestOptions::renewing(heart.renew()) };
        asked = world.ask_with(manager, "agv", function, &mut number("n", 1), options);
        if !matches!(asked, Err(Error::Expired | Error::StaleFunction)) {
            break;
        }
    }
    assert_eq!(asked, Ok(()));
}

fn a_loop_that_hangs_ends_what_it_wanted_and_nothing_else(world: &mut dyn World) {
    let services = ["drive", "lift"].map(|name| Service::new(&format!("{name}(n: int[1])")).lease(lease(world)));
    let [drives, lifts] = services.each_ref().map(Service::log);
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&services[0]).service(&services[1]));
    met(world, &manager, "agv", "lift");
    let round = lease(world).divided_by(8);
    let [mut driving, mut lifting] = [(); 2].map(|()| manager.heart(round.times(2)));
    want(world, &manager, "lift", &mut lifting);
    want(world, &manager, "drive", &mut driving);
    // On a busy machine a loop may come round so late that its motion has ended, which is as it should be.
    let (start, mut last, mut longest, mut hung) = (world.now(), world.now(), Duration::ZERO, None);
    while lifts.stops().is_empty() || world.now() < start + lease(world).times(4) {
        longest = longest.max(world.now().since(last));
        last = world.now();
        driving.beat();
        if world.now() < start + lease(world).times(2) {
            lifting.beat();
            hung = Some(last);
        }
        assert!(world.now() < start + secs(60), "the loop hangs, and what it wanted goes on");
        world.run_for(round);
    }
    if longest > round.times(2) {
        return;
    }
    let (hung, stopped) = (hung.expect("it has beaten"), lifts.stops()[0]);
    assert!(stopped > hung, "it ended while its loop came round");
    assert_eq!((agv.lease_is_live("drive"), drives.stops().len(), lifts.stops().len()), (true, 0, 1));
    world.measured("last beat to safe hook", stopped.since(hung));
    world.reached("hung");
}

fn a_heart_that_is_dropped_releases_all_that_it_renewed(world: &mut dyn World) {
    let names = ["drive", "lift", "tilt"];
    // So long that nothing ends by time.
    let services = names.map(|name| Service::new(&format!("{name}(n: int[1])")).lease(secs(60)));
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(services.iter().fold(Spec::agv("agv", 7), Spec::service));
    names.iter().for_each(|name| met(world, &manager, "agv", name));
    let [mut dropped, mut kept] = [(); 2].map(|()| manager.heart(secs(30)));
    want(world, &manager, "drive", &mut dropped);
    want(world, &manager, "lift", &mut kept);
    want(world, &manager, "tilt", &mut dropped);
    drop(dropped);
    let stops = || services.each_ref().map(|service| service.log().stops().len());
    world.wait("what it renewed is safe", || stops() == [1, 0, 1], secs(10));
    assert_eq!(names.map(|name| agv.lease_is_live(name)), [false, true, false]);
    world.reached("released");
}

/// The vehicle's machine sleeps for longer than the lease, and not so long that its manager would give up.
fn a_renewal_that_comes_after_the_end_revives_nothing(world: &mut dyn World) {
    let (service, manager, agv) = driving(world);
    let log = service.log();
    for round in 1..=8 {
        let calm = millis(500) + Duration::from_micros(world.random(100_000));
        world.run_for(calm);
        assert!(agv.lease_is_live("drive"));
        let asleep = lease(world) + millis(2) + Duration::from_micros(world.random(90_000));
        world.fault(Fault::Suspend(&agv, asleep));
        world.run_for(asleep);
        world.wait("the safe hook runs", || log.stops().len() == round, millis(60));
        assert!(!agv.lease_is_live("drive"));
        world.run_for(secs(2));
        assert!(!agv.lease_is_live("drive"));
        drive(world, &manager);
    }
    assert_eq!((log.runs(), log.stops().len()), (9, 8));
}

fn a_manager_that_takes_over_has_the_vehicle_alone(world: &mut dyn World) {
    let (service, first, agv) = driving(world);
    let second = world.add(Spec::manager("manager", 1).takes_over());
    met(world, &second, "agv", "drive");
    world.wait("the first is told", || first.count(|event| *event == Seen::Fenced(2)) == 1, secs(40));
    assert!(!agv.lease_is_live("drive"), "what the first wanted has ended");
    assert_eq!(service.log().stops().len(), 1);
    assert!(first.request("agv", "drive", &number("n", 1)).is_err());
    drive(world, &second);
    assert!(agv.lease_is_live("drive"));
    world.reached("fenced");
}

/// Neither replaces the order of the other one, who goes on, unless it takes over.
fn an_operator_and_the_program_of_a_manager_hold_for_themselves(world: &mut dyn World) {
    // So long that nothing ends by time.
    let service = Service::new("drive(n: int[1])").lease(secs(60));
    let (manager, agv) = pair(world, &service);
    let ask = |world: &mut dyn World, operator, take_over| {
        let mut asked = Err(Error::Expired);
        for _ in 0..200 {
            let wanted = RequestOptions::renewing(Renew::Process);
            let options = RequestOptions { timeout: Some(secs(10)), operator, take_over, ..wanted };
            asked = world.ask_with(&manager, "agv", "drive", &mut number("n", 1), options);
            if !matches!(asked, Err(Error::Expired | Error::StaleFunction)) {
                break;
            }
        }
        asked
    };
    let by = manager.identity().id();
    for operator in [false, true] {
        assert_eq!(ask(world, operator, true), Ok(()));
        assert_eq!(ask(world, !operator, false), Err(Error::Held { by, operator }));
        assert_eq!(ask(world, operator, false), Ok(()), "its own gives way");
        assert!(agv.lease_is_live("drive"));
    }
    assert_eq!(service.log().stops(), [], "a new order takes the place of the one before at once");
    world.reached("taken over");
    manager.release("agv", "drive").expect("it is held");
    world.wait("the safe hook runs", || service.log().stops().len() == 1, secs(10));
}

fn a_released_lease_stops_at_once(world: &mut dyn World) {
    let (service, manager, agv) = driving(world);
    manager.release("agv", "drive").expect("it is held");
    world.wait("the safe hook runs", || service.log().stops().len() == 1, secs(10));
    assert!(!agv.lease_is_live("drive"));
    world.reached("stopped");
}

fn what_a_service_that_goes_has_started_stops_at_once(world: &mut dyn World) {
    let (first, manager, agv) = driving(world);
    let second = Service::new("drive(n: int[1])").lease(long(world));
    agv.replace_service(&second).expect("it is there");
    world.wait("what the first one started is safe", || first.log().stops().len() == 1, secs(10));
    agv.publish().expect("it runs");
    drive(world, &manager);
    assert!(agv.lease_is_live("drive"));
    agv.remove_service("drive").expect("it is there");
    world.wait("what the second one started is safe", || second.log().stops().len() == 1, secs(10));
    world.run_for(lease(world).times(2));
    let stops = [&first, &second].map(|service| service.log().stops().len());
    assert_eq!(stops, [1, 1], "each hook runs once");
    world.reached("gone");
}

fn what_is_finished_needs_no_safe_hook(world: &mut dyn World) {
    let service = Service::new("drive(n: int[1])").lease(long(world));
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&service));
    met(world, &manager, "agv", "drive");
    drive(world, &manager);
    assert!(agv.end_order("drive", 0));
    assert!(!agv.lease_is_live("drive"));
    let finished = |event: &Seen| *event == Seen::LeaseEnded("drive".to_owned(), LeaseEnd::Finished);
    world.wait("the caller is told", || manager.count(finished) == 1, secs(10));
    let long = lease(world).times(3);
    world.run_for(long);
    if service.log().stops().is_empty() {
        world.reached("finished");
    }
}

fn what_is_finished_is_one_order_and_not_the_newer_one(world: &mut dyn World) {
    // So long that nothing ends by time.
    let service = Service::new("drive(n: int[1])").lease(secs(60));
    let (manager, agv) = pair(world, &service);
    drive(world, &manager);
    drive(world, &manager);
    assert!(!agv.end_order("drive", 0), "the second one has replaced it");
    let finished = |event: &Seen| *event == Seen::LeaseEnded("drive".to_owned(), LeaseEnd::Finished);
    world.run_for(millis(300));
    assert!(agv.lease_is_live("drive") && manager.count(finished) == 0);
    world.reached("went on");
    assert!(agv.end_order("drive", 1) && !agv.lease_is_live("drive"));
    world.wait("the caller is told", || manager.count(finished) == 1, secs(10));
    assert_eq!(service.log().stops(), []);
}
