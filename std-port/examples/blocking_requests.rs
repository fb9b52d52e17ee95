//! A manager, a vehicle, and as many secured blocking requests as the argument says: `cargo xtask house` counts which functions
//! one request enters.

use std::error::Error;
use std::time::Duration;

use cara_std::control::Control;
use cara_std::keys::FleetKeys;
use cara_std::{
    CommunicationSystem, Fleet, Identity, Interfaces, Parameters, ParametersView, Served, ServiceError, Unit,
};

fn main() -> Result<(), Box<dyn Error>> {
    let requests = std::env::args().nth(1).ok_or("how many requests?")?.parse::<u32>()?;
    let fleet = std::process::id();
    let (depot, agv) = (Identity::m_unit("depot", 1)?, Identity::s_unit("agv", 7)?);
    let mut keys = FleetKeys::draw(Fleet(fleet))?;
    keys.add(&depot, &[])?;
    keys.add(&agv, &[])?;
    let manager = CommunicationSystem::builder("depot", 1)?.fleet(fleet).interfaces(Interfaces::Loopback);
    let manager = manager.control(Control::Off).keys(keys.ring(&depot)?).build()?;
    let vehicle = Unit::builder("agv", 7, "depot", 1)?.fleet(fleet).interfaces(Interfaces::Loopback);
    let vehicle = vehicle.keys(keys.ring(&agv)?).build()?;
    let next = |_: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        let number: i64 = view.variable("number").map_err(|_| ServiceError::BadResults)?;
        view.set_value("number", number + 1).map_err(|_| ServiceError::BadResults)
    };
    let mut parameters = Parameters::new();
    parameters.add_int("number", 1)?;
    vehicle.my_function_list().add_function("next", &parameters, next)?;
    vehicle.publish_my_function_list()?;
    manager.start()?;
    vehicle.start()?;
    while manager.nodes_offering("next").is_empty() {
        std::thread::sleep(Duration::from_millis(10));
    }
    let peer = manager.s_unit("agv")?;
    for _ in 0..requests {
        peer.block_request("next", &mut parameters)?;
    }
    println!("{}", parameters.variable::<i64>("number")?);
    Ok(())
}
