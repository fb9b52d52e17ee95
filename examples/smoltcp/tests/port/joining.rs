//! How a vehicle finds its manager, and finds it again.

use crate::world::World;
use cara_core::services::session::Event;
use cara_core::time::Duration;
use cara_ethernet::Faults;

#[test]
fn a_vehicle_finds_its_manager_by_broadcast() {
    let mut world = World::new(1, 1, Faults::NONE);
    world.join();
    assert_eq!(world.vehicles[0].program.news.iter().filter(|(_, news)| *news == Event::Joined).count(), 1);
    let functions = world.vehicles[0].unit.their_function_list().unwrap().show_functions().to_string();
    assert_eq!(functions, "mechanic(number: int) -> (number: int)\n");
}

#[test]
fn a_vehicle_dials_a_fixed_address() {
    let mut world = World::dialing(1);
    world.join();
}

#[test]
fn five_vehicles_join_on_a_bad_network() {
    let bad = Faults { loss: 0.1, jitter: Duration::from_millis(5), duplication: 0.1, reordering: 0.1, ..Faults::NONE };
    let mut world = World::new(7, 5, bad);
    world.join();
}
