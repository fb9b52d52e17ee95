//! High before normal before low.

use cara_core::config::Priority;
use cara_core::error::ServiceError;
use cara_core::services::session::RequestOptions;
use cara_sim::Path;

use super::met;
use crate::scenario::scenarios;
use crate::{Fault, Service, Spec, World, millis, secs, text};

scenarios![
    high_goes_before_normal_before_low: "73", Own, [Path], ["bandwidth", "sorted"];
    without_priorities_the_order_is_that_of_asking: "73 (priority removed)", Own, [Path], ["bandwidth", "unsorted"];
];

/// Messages of each class: more than what the network takes at once.
const EACH: usize = 12;

/// Sends low, normal and high in turn over a slow path; the order in which they ran, by number of class.
fn ran(world: &mut dyn World, classes: [Option<Priority>; 3]) -> Vec<i64> {
    let service = Service::new("store(n: int[1], text: string[500])");
    let log = service.log();
    let service = service.does(move |_, parameters| {
        log.note(parameters.variable::<i64>("n").map_err(|_| ServiceError::BadResults)?);
        Ok(())
    });
    let service = service.in_turns();
    let manager = world.add(Spec::manager("manager", 1));
    let agv = Spec::agv("agv", 7).service(&service).limits(|limits| {
        limits.calls_per_peer = 60;
        limits.message_size = 32 * 1_024;
    });
    let agv = world.add(agv);
    met(world, &manager, "agv", "store");
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
