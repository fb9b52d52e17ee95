//! High before normal before low.

use cara_core::config::{Constraints, Priority};
use cara_core::error::{Error, Limit, ServiceError};
use cara_core::services::session::RequestOptions;
use cara_sim::Path;

use super::met;
use crate::scenario::scenarios;
use crate::{Fault, Service, Spec, Unit, World, millis, secs, text};

scenarios![
    high_goes_before_normal_before_low: "73", Own, [Path], ["bandwidth", "sorted"];
    a_high_call_overtakes_bulk_on_a_slow_link: "73", Own, [SlowReader], ["bandwidth", "overtook"];
    without_priorities_the_order_is_that_of_asking: "73 (priority removed)", Own, [Path], ["bandwidth", "unsorted"];
];

/// Messages of each class: more than what the network takes at once.
const EACH: usize = 12;

/// A manager, and a vehicle that notes the numbers that come with texts of so many characters.
fn storing(world: &mut dyn World, length: usize, message_size: u32) -> (Unit, Unit, Service) {
    let service = Service::new(&format!("store(n: int[1], text: string[{length}])"));
    let log = service.log();
    let service = service.does(move |_, parameters| {
        log.note(parameters.variable::<i64>("n").map_err(|_| ServiceError::BadResults)?);
        Ok(())
    });
    let service = service.in_turns();
    let large = |limits: &mut Constraints| {
        limits.calls_per_peer = 60;
        limits.message_size = message_size;
    };
    let manager = world.add(Spec::manager("manager", 1).limits(large));
    let agv = world.add(Spec::agv("agv", 7).service(&service).limits(large));
    met(world, &manager, "agv", "store");
    (manager, agv, service)
}

/// Sends low, normal and high in turn over a slow path; the order in which they ran, by number of class.
fn ran(world: &mut dyn World, classes: [Option<Priority>; 3]) -> Vec<i64> {
    let (manager, agv, service) = storing(world, 500, 32 * 1_024);
    world.run_for(millis(500));
    let bits = 64_000 + world.random(64_000);
    world.fault(Fault::Path(&manager, &agv, Path::LAN.bits_per_second(bits)));
    let mut parameters = text(500);
    parameters.add_int("n", 1).expect("there is room");
    for _ in 0..EACH {
        for (class, priority) in classes.into_iter().enumerate() {
            let options = RequestOptions { priority, timeout: Some(secs(60)), ..RequestOptions::default() };
            parameters.set_value("n", class as i64).expect("it is there");
            manager.request_with("agv", "store", &parameters, options).expect("it is accepted");
        }
    }
    world.wait("all ran", || service.log().runs() == 3 * EACH, secs(60));
    service.log().values()
}

/// The sum of a class's places in the order.
fn places(order: &[i64], class: i64) -> usize {
    order.iter().enumerate().filter(|(_, other)| **other == class).map(|(place, _)| place).sum()
}

fn high_goes_before_normal_before_low(world: &mut dyn World) {
    let order = ran(world, [Some(Priority::Low), Some(Priority::Normal), Some(Priority::High)]);
    assert!(places(&order, 2) < places(&order, 1) && places(&order, 1) < places(&order, 0), "{order:?}");
    world.reached("sorted");
}

fn without_priorities_the_order_is_that_of_asking(world: &mut dyn World) {
    let order = ran(world, [None; 3]);
    assert_eq!(order, [0, 1, 2].repeat(EACH));
    world.reached("unsorted");
}

/// A high call is made behind as much bulk as its manager takes, while next to nothing passes. What the network has and what is
/// sealed stays ahead of it.
fn a_high_call_overtakes_bulk_on_a_slow_link(world: &mut dyn World) {
    const LENGTH: usize = 20_000;
    const HIGH: i64 = -1;
    let (manager, agv, service) = storing(world, LENGTH, 256 * 1_024);
    world.fault(Fault::SlowReader(&manager, &agv, 1_000));
    let mut parameters = text(LENGTH);
    parameters.add_int("n", 1).expect("there is room");
    let mut ask = |n, priority| {
        let options = RequestOptions { priority: Some(priority), timeout: Some(secs(60)), ..RequestOptions::default() };
        parameters.set_value("n", n).expect("it is there");
        manager.request_with("agv", "store", &parameters, options)
    };
    let bulk = (0..60).find(|n| ask(*n, Priority::Normal) == Err(Error::Full(Limit::SendQueue)));
    let bulk = bulk.expect("the queue of a class is bounded");
    ask(HIGH, Priority::High).expect("each class has a queue");
    world.fault(Fault::SlowReader(&manager, &agv, 600_000));
    world.wait("all ran", || service.log().runs() as i64 == bulk + 1, secs(60));
    let order = service.log().values();
    let behind = order.iter().rev().take_while(|n| **n != HIGH).count();
    assert!(behind >= 4, "the class of bulk held 256 KiB, of which 64 were sealed: {order:?}");
    assert!(order.iter().filter(|n| **n != HIGH).is_sorted(), "{order:?}");
    world.reached("overtook");
}
