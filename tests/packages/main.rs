//! A user's program: a manager and a vehicle that meet, and a typed call, built from the packages alone.

use std::time::Duration;

use cara_std::{CommunicationSystem, Interfaces, Unit, interface};

#[interface]
trait Agv {
    /// Tells its charge in percent.
    #[returns(percent)]
    fn battery(&self) -> i64;
}

struct Vehicle {
    charge: i64,
}

impl Agv for Vehicle {
    fn battery(&self) -> i64 {
        self.charge
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let fleet = std::process::id();
    let loopback = Interfaces::Loopback;
    let vehicle = Unit::builder("agv-17", 17, "depot", 1)?.fleet(fleet).interfaces(loopback.clone()).insecure();
    let vehicle = vehicle.state(Vehicle { charge: 80 }).build()?;
    vehicle.my_function_list().serve(AgvServer)?;
    vehicle.publish_my_function_list()?;
    vehicle.start()?;

    let depot = CommunicationSystem::builder("depot", 1)?.fleet(fleet).interfaces(loopback).insecure().build()?;
    depot.start()?;
    let agv = depot.wait_for_s_unit("agv-17", Duration::from_secs(30))?;
    assert!(agv.wait_for_function("battery", Duration::from_secs(30)), "it has published it");
    println!("{} %", AgvClient::at(&agv).battery().wait()?);
    Ok(())
}
