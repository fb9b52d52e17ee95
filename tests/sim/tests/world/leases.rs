//! A vehicle moves only while its manager wants it to.

use super::*;
use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::session::RequestOptions;
use cara_sim::{Crash, Direction, LeaseWatch, UnitEvent};

const LEASE: Duration = Duration::from_millis(500);

/// A manager, and a vehicle whose `drive` goes on while its lease is live; with the counts of ticks and safe stops.
fn driving(seed: u64) -> (World, UnitHandle, UnitHandle, Rc<RefCell<u32>>, Rc<RefCell<u32>>) {
    let mut world = World::new(seed);
    let manager = world.m_unit("manager", 1).start();
    let agv = world.s_unit("agv", 7).joins("manager", 1).start();
    let ((ticks, driven), (stops, stopped)) = (shared(0), shared(0));
    let drive = Service::future(move |call, parameters| {
        let ticks = Rc::clone(&ticks);
        let moving = call.clone();
        call.unit.spawn(async move {
            while moving.lease.as_ref().is_some_and(LeaseWatch::is_live) {
                *ticks.borrow_mut() += 1;
                moving.unit.sleep(millis(10)).await;
            }
        });
        async move { Ok(parameters) }
    });
    agv.my_function_list().add_service("drive()", drive.lease(LEASE, move |_| *stops.borrow_mut() += 1)).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "drive"), secs(10)));
    manager.request_with("agv", "drive", &Parameters::new(), RequestOptions::renewing(Renew::Process)).unwrap();
    world.run_for(millis(100));
    (world, manager, agv, driven, stopped)
}

#[test]
fn it_drives_while_the_lease_is_renewed_and_stops_when_released() {
    let (mut world, manager, agv, driven, stopped) = driving(1);
    world.run_for(secs(5));
    assert!(agv.lease_is_live("drive"));
    assert!(*driven.borrow() > 490 && *stopped.borrow() == 0);
    manager.release("agv", "drive").unwrap();
    world.run_for(millis(20));
    assert!(!agv.lease_is_live("drive"));
    assert_eq!(*stopped.borrow(), 1);
}

#[test]
fn it_stops_within_the_lease_when_the_manager_dies_or_the_link_is_cut() {
    for cut in [false, true] {
        let (mut world, manager, agv, driven, stopped) = driving(2);
        world.run_for(secs(1));
        let before = *driven.borrow();
        if cut {
            world.network(|network| network.partition(&[manager.host()], &[agv.host()], Direction::Both));
        } else {
            world.crash(&manager, Crash::PowerCut);
        }
        world.run_for(LEASE + millis(10));
        assert_eq!(*stopped.borrow(), 1, "cut: {cut}");
        assert!(*driven.borrow() - before <= 52, "{} ticks of 10 ms", *driven.borrow() - before);
        let after = *driven.borrow();
        world.run_for(secs(20));
        assert_eq!((*driven.borrow(), *stopped.borrow()), (after, 1));
        assert_eq!(agv.count(|event| matches!(event, UnitEvent::LeaseExpired { .. })), 1);
    }
}

#[test]
fn without_renewal_the_lease_ends_by_itself() {
    let (mut world, manager, _agv, _, stopped) = driving(3);
    manager.release("agv", "drive").unwrap();
    world.run_for(millis(20));
    let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    manager.request_with("agv", "drive", &Parameters::new(), options).unwrap();
    world.run_for(LEASE - millis(50));
    assert_eq!(*stopped.borrow(), 1, "the release");
    world.run_for(millis(60));
    assert_eq!(*stopped.borrow(), 2, "the expiry");
}

#[test]
fn what_is_finished_is_one_order_and_ends_without_the_safe_hook() {
    let (mut world, manager, agv, _, stopped) = driving(4);
    let ((started, orders), (stops, lifted)) = (shared(Vec::<LeaseWatch>::new()), shared(0));
    let lift = Service::new(move |call, _| {
        started.borrow_mut().extend(call.lease.clone());
        Ok(())
    });
    agv.my_function_list().add_service("lift()", lift.lease(LEASE, move |_| *stops.borrow_mut() += 1)).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "lift"), secs(10)));
    for _ in 0..2 {
        manager.request_with("agv", "lift", &Parameters::new(), RequestOptions::renewing(Renew::Process)).unwrap();
        world.run_for(millis(100));
    }
    let [older, newer] = &orders.borrow()[..] else { panic!("two have begun") };
    assert!(!agv.end_order(older), "it was replaced");
    world.run_for(secs(2));
    assert!(agv.lease_is_live("lift") && agv.end_order(newer) && !agv.end_order(newer));
    world.run_for(secs(2));
    assert_eq!((*lifted.borrow(), *stopped.borrow(), agv.lease_is_live("drive")), (0, 0, true));
    assert_eq!(manager.count(|event| matches!(event, UnitEvent::LeaseEnded { why: LeaseEnd::Finished, .. })), 1);
}

#[test]
fn an_order_that_has_ended_by_then_begins_without_its_handler() {
    let (mut world, manager, agv, _, stopped) = driving(5);
    let (heard, happened) = shared(String::new());
    let [began, safe] = [(); 2].map(|()| Rc::clone(&happened));
    let lift = Service::new(move |call, _| {
        assert!(call.lease.as_ref().is_some_and(LeaseWatch::is_live));
        *heard.borrow_mut() += "handler ";
        Ok(())
    });
    let lift = lift.lease(LEASE, move |_| *safe.borrow_mut() += "hook ");
    let lift = lift.on_order(move |call, parameters| {
        let n: i64 = parameters.variable("n").unwrap();
        let is_live = call.lease.as_ref().is_some_and(LeaseWatch::is_live);
        *began.borrow_mut() += &format!("{n} {is_live} ");
    });
    agv.my_function_list().add_service("lift(n: int)", lift).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "lift"), secs(10)));
    // Both are read at once, and the second takes the place of the first.
    world.suspend(&agv, millis(100));
    for n in [1_i64, 2] {
        let mut parameters = Parameters::new();
        parameters.add_int("n", 1).unwrap();
        parameters.set_value("n", n).unwrap();
        manager.request_with("agv", "lift", &parameters, RequestOptions::default()).unwrap();
    }
    world.run_for(secs(2));
    assert_eq!(*happened.borrow(), "1 false 2 true handler hook ");
    let expired = |event: &UnitEvent| matches!(event, UnitEvent::RequestFailed { error: Error::Expired, .. });
    assert_eq!((manager.count(expired), *stopped.borrow()), (1, 0));
}
