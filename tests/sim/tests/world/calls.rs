//! Requests in every direction, and services that live through time.

use super::*;
use cara_core::config::Constraints;
use cara_core::error::{Error, ServiceError};
use cara_core::services::session::RequestOptions;
use cara_sim::UnitEvent;

#[test]
fn the_papers_listing() {
    let (mut world, manager, agv) = pair(1);
    assert_eq!(manager.s_units(), [agv.identity()]);
    let list = manager.their_function_list("agv").unwrap();
    assert_eq!(list, "pos_info() -> (position: int[2])\ngo_to(position: int[2])\n");

    let mut pos = position();
    world.block_request(&manager, "agv", "pos_info", &mut pos).unwrap();
    let mut coordinates = [9; 2];
    pos.variable_into("position", &mut coordinates).unwrap();
    assert_eq!(coordinates, [0, 0]);
    pos.set_value("position", [1, 2]).unwrap();
    manager.request("agv", "go_to", &pos).unwrap();

    let mut reported = position();
    world.block_request(&manager, "agv", "pos_info", &mut reported).unwrap();
    assert_eq!(reported, pos);

    manager.my_function_list().add_service("call_mechanic(place: int[2])", Service::new(|_, _| Ok(()))).unwrap();
    manager.publish_my_function_list_to("agv").unwrap();
    assert!(world.run_until(|_| agv.knows("manager", "call_mechanic"), secs(1)));
    let mut place = Parameters::new();
    place.add_int("place", 2).unwrap();
    world.block_request(&agv, "manager", "call_mechanic", &mut place).unwrap();
}

#[test]
fn two_managers_call_each_other() {
    let mut world = World::new(3);
    let units = [world.m_unit("one", 1).start(), world.m_unit("two", 2).start()];
    for unit in &units {
        unit.my_function_list().add_service("ping()", Service::new(|_, _| Ok(()))).unwrap();
        unit.publish_my_function_list().unwrap();
    }
    assert!(world.run_until(|_| units[0].knows("two", "ping") && units[1].knows("one", "ping"), secs(10)));
    world.block_request(&units[0], "two", "ping", &mut Parameters::new()).unwrap();
    world.block_request(&units[1], "one", "ping", &mut Parameters::new()).unwrap();
}

/// A calls B, whose service calls A, before B answers.
#[test]
fn a_service_calls_its_caller_back() {
    let (mut world, manager, agv) = pair(1);
    manager
        .my_function_list()
        .add_service(
            "where_to() -> (position: int[2])",
            Service::new(|_, parameters| {
                parameters.set_value("position", [5, 6]).map_err(|_| ServiceError::BadResults)
            }),
        )
        .unwrap();
    manager.publish_my_function_list().unwrap();
    let fetch = Service::future(|call, mut parameters| async move {
        let mut order = position();
        let asked = call.unit.block_request(&call.caller, "where_to", &mut order).await;
        asked.map_err(|_| ServiceError::NotReady)?;
        parameters.copy_from(&order).map_err(|_| ServiceError::BadResults)?;
        Ok(parameters)
    });
    agv.my_function_list().add_service("fetch() -> (position: int[2])", fetch).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "fetch") && agv.knows("manager", "where_to"), secs(1)));
    let mut order = position();
    world.block_request(&manager, "agv", "fetch", &mut order).unwrap();
    assert_eq!(order.variable::<[i64; 2]>("position"), Ok([5, 6]));
}

#[test]
fn a_slow_service_delays_no_other_unit_and_no_keep_alive() {
    let (mut world, manager, agv) = pair(1);
    agv.my_function_list().add_service("lift()", Service::new(|_, _| Ok(())).takes(secs(20))).unwrap();
    agv.publish_my_function_list().unwrap();
    let other = start_agv(&world, "other", 8);
    assert!(world.run_until(|_| manager.knows("agv", "lift") && manager.knows("other", "pos_info"), secs(5)));
    let (done, result) = shared(None);
    let caller = manager.clone();
    manager.spawn(async move {
        let options = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::default() };
        let lifted = caller.block_request_with("agv", "lift", &mut Parameters::new(), options).await;
        *done.borrow_mut() = Some((lifted, caller.now()));
    });
    let start = world.now();
    world.run_for(secs(10));
    let before = world.now();
    world.block_request(&manager, "other", "pos_info", &mut position()).unwrap();
    assert!(world.now().since(before) < millis(2));
    assert_eq!(*result.borrow(), None);
    assert!(world.run_until(|_| result.borrow().is_some(), secs(15)));
    let (lifted, at) = result.borrow().unwrap();
    assert_eq!(lifted, Ok(()));
    assert!(at.since(start) >= secs(20) && at.since(start) < secs(21));
    assert_eq!(manager.count(|event| matches!(event, UnitEvent::Left { .. })), 0);
    drop(other);
}

#[test]
fn a_call_ends_with_its_deadline_and_frees_its_slot() {
    let (mut world, manager, agv) = pair(1);
    agv.my_function_list().add_service("sleep()", Service::new(|_, _| Ok(())).takes(secs(60))).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "sleep"), secs(1)));
    let start = world.now();
    assert_eq!(world.block_request(&manager, "agv", "sleep", &mut Parameters::new()), Err(Error::TimedOut));
    assert_eq!(world.now().since(start), Constraints::M_UNIT.request_timeout);
    assert_eq!(manager.calls_in_flight(), 0);
}

#[test]
fn a_service_that_panics_is_answered_when_it_may() {
    let (mut world, manager, agv) = pair(1);
    agv.my_function_list().add_service("crash()", Service::new(|_, _| panic!("on purpose")).survives_panics()).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "crash"), secs(1)));
    let crashed = world.block_request(&manager, "agv", "crash", &mut Parameters::new());
    assert_eq!(crashed, Err(Error::Service(ServiceError::Panicked)));
    world.block_request(&manager, "agv", "pos_info", &mut position()).unwrap();
}

#[test]
fn a_call_to_everybody_has_an_outcome_for_each() {
    let mut world = World::new(5);
    let manager = world.m_unit("manager", 1).start();
    let agvs: Vec<_> = (0..5).map(|id| start_agv(&world, &format!("agv-{id}"), 10 + id)).collect();
    assert!(world.run_until(|_| manager.nodes_offering("pos_info").len() == 5, secs(20)));
    let outcomes = world.block_on(manager.block_request_all("pos_info", &position()));
    assert_eq!(outcomes.len(), 5);
    assert!(outcomes.iter().all(|(_, outcome)| outcome.is_ok()), "{outcomes:?}");
    drop(agvs);
}

#[test]
fn publishing_can_wait_for_everybody_to_have_read() {
    let (mut world, manager, agv) = pair(1);
    manager.my_function_list().add_service("late()", Service::new(|_, _| Ok(()))).unwrap();
    assert_eq!(world.block_on(manager.publish_and_wait()), Ok(vec![]));
    assert!(agv.knows("manager", "late"));
}

#[test]
fn long_strings_cross_a_split_and_slow_network_whole() {
    let mut world = World::new(9);
    world.network(|network| {
        network.set_calm(cara_sim::Path::LAN.bits_per_second(2_000_000).loss_percent(0.5));
        network.split_reads(cara_sim::Chance::percent(50.0));
    });
    let (one, two) = (world.m_unit("one", 1).start(), world.m_unit("two", 2).start());
    two.my_function_list()
        .add_service("echo(text: string[20000]) -> (text: string[20000])", Service::new(|_, _| Ok(())))
        .unwrap();
    two.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| one.knows("two", "echo"), secs(20)));
    let text: String = (0..20_000).map(|index| char::from(b'a' + (index % 26) as u8)).collect();
    let mut parameters = cara_sim::boxed_parameters(40_000);
    parameters.add_string("text", 20_000).unwrap();
    parameters.set_value("text", text.as_str()).unwrap();
    world.block_request(&one, "two", "echo", &mut parameters).unwrap();
    assert_eq!(parameters.variable::<&str>("text"), Ok(text.as_str()));
}
