//! Calls in both directions, and leases.

use cara_core::config::Priority;
use cara_core::error::{Error, ServiceError};
use cara_core::services::heart::Renew;
use cara_core::services::session::Event;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_ethernet::{Fault, Faults};

use crate::world::World;
use crate::world::manager::number;
use crate::world::vehicle::LEASE;

const SECOND: Duration = Duration::from_secs(1);
const MILLISECOND: Duration = Duration::from_millis(1);

fn joined() -> World {
    let mut world = World::new(1, 1, Faults::NONE);
    world.join();
    world
}

fn call(world: &mut World, function: &str, value: i64) -> Result<i64, Error> {
    let (now, link) = (world.now, world.manager().links()[0]);
    let id = world.manager().call(now, link, function, value)?;
    world.run(SECOND.times(3));
    let replies = &world.manager().replies;
    replies.iter().find(|(_, of, _)| *of == id).expect("every call ends").2
}

fn drive(world: &mut World) {
    let (now, link) = (world.now, world.manager().links()[0]);
    world.manager().request(now, link, "go_to", 5, &RequestOptions::renewing(Renew::Process), false).unwrap();
    world.run(SECOND.times(10));
    let vehicle = &world.vehicles[0];
    assert!(vehicle.program.driving && vehicle.lease.is_live(world.now));
    assert_eq!(vehicle.program.made_safe, []);
}

#[test]
fn the_manager_calls_the_vehicle() {
    let mut world = joined();
    assert_eq!(call(&mut world, "echo", 42), Ok(42));
    assert_eq!(call(&mut world, "echo", -1), Err(Error::Service(ServiceError::Failed(2))));
    assert_eq!(world.vehicles[0].program.echoed, [42, -1]);
    assert_eq!(call(&mut world, "fly", 1), Err(Error::UnknownFunction));
}

#[test]
fn the_vehicle_calls_its_manager() {
    let mut world = joined();
    let now = world.now;
    let vehicle = &mut world.vehicles[0];
    let id = vehicle.unit.request(now, "mechanic", &number(7), &RequestOptions::default(), true).unwrap();
    vehicle.wake();
    world.run(SECOND);
    assert_eq!(world.vehicles[0].program.replies, [(id, Ok(7))]);
    assert_eq!(world.manager().served, 1);
}

#[test]
fn a_call_may_be_answered_later_and_the_link_lives_meanwhile() {
    let mut world = joined();
    let (now, link) = (world.now, world.manager().links()[0]);
    let options = RequestOptions { timeout: Some(SECOND.times(60)), ..RequestOptions::default() };
    world.manager().request(now, link, "slow", 9, &options, true).unwrap();
    world.run(SECOND.times(30));
    assert_eq!(world.manager().replies, []);
    let now = world.now;
    let vehicle = &mut world.vehicles[0];
    let ticket = vehicle.program.waiting.expect("it was asked");
    vehicle.unit.answer(now, ticket, Ok(&number(10))).unwrap();
    vehicle.wake();
    world.run(SECOND);
    assert_eq!(world.manager().replies[0].2, Ok(10));
}

#[test]
fn answers_that_find_no_room_wait_for_it() {
    let mut world = joined();
    world.run(SECOND.times(2));
    let link = world.manager().links()[0];
    let vehicle_port = world.vehicles[0].cable.port;
    // What the manager sends arrives; nothing that the vehicle sends does, so that it fills up.
    world.switch.borrow_mut().set_faults_from(vehicle_port, Faults::loss(1.0));
    let options = RequestOptions { timeout: Some(SECOND.times(30)), ..RequestOptions::default() };
    for value in 0..5 {
        let now = world.now;
        world.manager().request(now, link, "report", value, &options, true).unwrap();
        world.run(MILLISECOND.times(100));
    }
    assert!(world.vehicles[0].program.reports < 5, "there was room for all answers");
    // An emergency is served all the same, and the results that wait are not touched.
    let urgent = RequestOptions { priority: Some(Priority::Emergency), ..options };
    let now = world.now;
    world.manager().request(now, link, "echo", 77, &urgent, true).unwrap();
    world.run(MILLISECOND.times(100));
    assert_eq!(world.vehicles[0].program.echoed, [77]);
    world.set_faults(Faults::NONE);
    world.run(SECOND.times(20));
    let mut replies: Vec<_> = world.manager().replies.iter().filter_map(|(_, _, outcome)| outcome.ok()).collect();
    replies.sort();
    assert_eq!(replies, [0, 1, 2, 3, 4, 77]);
    assert_eq!(world.vehicles[0].program.reports, 5);
}

#[test]
fn an_answer_that_the_stream_takes_in_parts_goes_on_when_there_is_room() {
    let mut world = joined();
    world.set_faults(Faults { delay: MILLISECOND.times(50), ..Faults::NONE });
    let (now, link) = (world.now, world.manager().links()[0]);
    for value in 0..3 {
        world.manager().call(now, link, "report", value).unwrap();
    }
    // Three of them are longer than the stream's buffer, and nothing else is said meanwhile.
    assert!(world.run_until(MILLISECOND.times(700), |world| world.manager().replies.len() == 3));
}

#[test]
fn what_has_ended_is_made_safe_before_anything_is_served() {
    let mut world = joined();
    drive(&mut world);
    // The program is busy for longer than the lease, while the manager goes on.
    world.vehicles[0].asleep = true;
    world.run(LEASE + MILLISECOND.times(20));
    let (now, link) = (world.now, world.manager().links()[0]);
    world.manager().call(now, link, "echo", 3).unwrap();
    world.run(MILLISECOND);
    world.vehicles[0].program.order.clear();
    world.vehicles[0].asleep = false;
    world.run(SECOND);
    assert_eq!(world.vehicles[0].program.order, ["made safe", "echo"]);
}

#[test]
fn whatever_the_network_does_a_call_runs_once_at_most_and_ends_once() {
    let mut counts = [0; 3];
    for seed in 0..10 {
        let mut world = World::new(seed, 1, Faults::NONE);
        world.join();
        world.set_faults(Faults { loss: 0.05, duplication: 0.3, reordering: 0.3, ..Faults::NONE });
        let link = world.manager().links()[0];
        for value in 0..20 {
            let now = world.now;
            world.manager().call(now, link, "echo", value).unwrap();
            world.run(SECOND.divided_by(4));
        }
        world.run(SECOND.times(10));
        let echoed = &world.vehicles[0].program.echoed;
        assert!(echoed.windows(2).all(|pair| pair[0] < pair[1]), "seed {seed}: {echoed:?}");
        assert_eq!(world.manager().replies.len(), 20, "seed {seed}");
        let faults = [Fault::Loss, Fault::Duplicate, Fault::Reorder];
        let switch = world.switch.borrow();
        counts.iter_mut().zip(faults).for_each(|(count, fault)| *count += switch.counts().of(fault));
    }
    assert!(counts.iter().all(|count| *count > 40), "hardly anything went wrong: {counts:?}");
}

#[test]
fn driving_ends_with_the_lease_when_the_cable_is_pulled() {
    let mut world = joined();
    drive(&mut world);
    let pulled = world.now;
    world.set_link(0, false);
    assert!(world.run_until(SECOND.times(10), |world| !world.vehicles[0].program.driving));
    assert!(world.now.since(pulled) <= LEASE + MILLISECOND, "{:?}", world.now.since(pulled));
    assert!(!world.vehicles[0].lease.is_live(world.now));
    world.run(SECOND.times(10));
    assert_eq!(world.vehicles[0].program.made_safe.len(), 1);
    let (left, _) = *world.vehicles[0].program.news.last().unwrap();
    assert!(left > world.vehicles[0].program.made_safe[0]);
}

#[test]
fn driving_ends_at_once_when_the_device_says_that_the_cable_is_out() {
    let mut world = joined();
    drive(&mut world);
    let pulled = world.now;
    world.set_link(0, false);
    world.vehicles[0].unit.link_down();
    world.vehicles[0].wake();
    world.run(SECOND);
    assert_eq!(world.vehicles[0].program.made_safe, [pulled]);
    assert_eq!(world.vehicles[0].left(), 1);
}

#[test]
fn driving_ends_within_its_lease_when_the_manager_is_gone() {
    let mut world = joined();
    drive(&mut world);
    let gone = world.now;
    world.power_cut();
    assert!(world.run_until(SECOND.times(10), |world| !world.vehicles[0].program.driving));
    assert!(world.now.since(gone) <= LEASE + MILLISECOND, "{:?}", world.now.since(gone));
}

#[test]
fn what_is_finished_is_not_made_safe() {
    let mut world = joined();
    drive(&mut world);
    let now = world.now;
    let vehicle = &mut world.vehicles[0];
    let order = vehicle.program.drives_for.unwrap();
    assert!(vehicle.unit.end_order(now, vehicle.lease, order) && !vehicle.unit.end_order(now, vehicle.lease, order));
    vehicle.wake();
    world.run(SECOND.times(5));
    assert_eq!(world.vehicles[0].program.made_safe, []);
    assert!(!world.vehicles[0].lease.is_live(world.now));
    assert!(!world.vehicles[0].program.news.iter().any(|(_, news)| matches!(news, Event::Closed(_))));
}
