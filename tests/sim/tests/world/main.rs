//! Fleets in the simulator: the core through the eyes of its users.

mod actuators;
mod calls;
mod claims;
mod faults;
mod leases;
mod renewals;
mod runs;
mod trips;

use cara_core::distribution::parameters::Parameters;
use cara_core::time::Duration;
use cara_sim::{Service, UnitHandle, World};
use std::cell::RefCell;
use std::rc::Rc;

fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn secs(secs: u64) -> Duration {
    Duration::from_secs(secs)
}

/// A value that closures share with the test.
fn shared<T>(value: T) -> (Rc<RefCell<T>>, Rc<RefCell<T>>) {
    let value = Rc::new(RefCell::new(value));
    (Rc::clone(&value), value)
}

/// The paper's vehicle: `pos_info` tells a position that `go_to` sets.
fn start_agv(world: &World, name: &str, id: u32) -> UnitHandle {
    world.s_unit(name, id).joins("manager", 1).program(agv).start()
}

fn agv(unit: &UnitHandle) {
    let (position, reported) = shared([0_i64, 0]);
    let pos_info = Service::new(move |_, parameters| {
        parameters.set_value("position", *reported.borrow()).expect("the signature declares it");
        Ok(())
    });
    let go_to = Service::new(move |_, parameters| {
        parameters.variable_into("position", &mut *position.borrow_mut()).expect("the core checked it");
        Ok(())
    });
    unit.my_function_list().add_service("pos_info() -> (position: int[2])", pos_info).unwrap();
    unit.my_function_list().add_service("go_to(position: int[2])", go_to).unwrap();
    unit.publish_my_function_list().unwrap();
}

fn position() -> Parameters {
    let mut parameters = Parameters::new();
    parameters.add_int("position", 2).unwrap();
    parameters
}

/// A manager and one vehicle that know each other's functions.
fn pair(seed: u64) -> (World, UnitHandle, UnitHandle) {
    let mut world = World::new(seed);
    let manager = world.m_unit("manager", 1).start();
    let agv = start_agv(&world, "agv", 7);
    assert!(world.run_until(|_| manager.knows("agv", "go_to"), secs(10)));
    (world, manager, agv)
}
