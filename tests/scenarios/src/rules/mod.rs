//! The rules, one file each.

mod access;
mod age;
mod anything;
mod at_most_once;
mod bad_input;
mod best_effort;
mod deadlines;
mod details;
mod emergency;
mod everybody;
mod fleets;
mod identity;
mod interval;
mod leases;
mod limits;
mod links;
mod listing;
mod membership;
mod message_size;
mod orders;
mod priorities;
mod publishing;
mod scheduling;
mod slow;
mod stops;
mod streams;
mod turns;

use std::sync::{Arc, Mutex};

use cara_core::error::ServiceError;

use crate::{Scenario, Service, Spec, Unit, World, number, secs};

/// Every scenario.
pub fn all() -> Vec<Scenario> {
    [
        listing::SCENARIOS,
        publishing::SCENARIOS,
        access::SCENARIOS,
        membership::SCENARIOS,
        identity::SCENARIOS,
        fleets::SCENARIOS,
        deadlines::SCENARIOS,
        interval::SCENARIOS,
        message_size::SCENARIOS,
        limits::SCENARIOS,
        bad_input::SCENARIOS,
        at_most_once::SCENARIOS,
        age::SCENARIOS,
        leases::SCENARIOS,
        orders::SCENARIOS,
        stops::SCENARIOS,
        turns::SCENARIOS,
        links::SCENARIOS,
        priorities::SCENARIOS,
        scheduling::SCENARIOS,
        emergency::SCENARIOS,
        best_effort::SCENARIOS,
        slow::SCENARIOS,
        everybody::SCENARIOS,
        streams::SCENARIOS,
        details::SCENARIOS,
        anything::SCENARIOS,
    ]
    .concat()
}

/// The listing's services: `pos_info` tells the position that `go_to` sets.
fn paper_services() -> (Service, Service) {
    let position = Arc::new(Mutex::new([3_i64, 4]));
    let reported = Arc::clone(&position);
    let pos_info = Service::new("pos_info(position: int[2]) -> (position: int[2])").does(move |_, parameters| {
        let value = *reported.lock().map_err(|_| ServiceError::Panicked)?;
        parameters.set_value("position", value).map_err(|_| ServiceError::BadResults)
    });
    let go_to = Service::new("go_to(position: int[2])").does(move |_, parameters| {
        let mut position = position.lock().map_err(|_| ServiceError::Panicked)?;
        parameters.variable_into("position", &mut *position).map_err(|_| ServiceError::BadResults)
    });
    (pos_info, go_to)
}

/// A manager, and an AGV with one service that the manager knows.
fn pair(world: &mut dyn World, service: &Service) -> (Unit, Unit) {
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(service));
    met(world, &manager, "agv", service.name());
    (manager, agv)
}

/// An AGV that has nothing to do with what goes wrong: its calls go on.
struct Bystander {
    service: Service,
    calls: usize,
}

impl Bystander {
    fn add(world: &mut dyn World, manager: &Unit) -> Self {
        let service = Service::numbered("count");
        world.add(Spec::agv("bystander", 99).service(&service));
        met(world, manager, "bystander", "count");
        Self { service, calls: 0 }
    }

    /// Calls it.
    fn continues(&mut self, world: &mut dyn World, manager: &Unit) {
        self.calls += 1;
        let asked = world.ask(manager, "bystander", "count", &mut number("n", self.calls as i64));
        assert_eq!(asked, Ok(()), "another node's calls go on{}", world.story());
        assert_eq!(self.service.log().runs(), self.calls);
    }
}

/// Waits until `unit` knows a function of `peer`.
fn met(world: &mut dyn World, unit: &Unit, peer: &str, function: &str) {
    world.wait("the two have met", || unit.knows(peer, function), secs(40));
}
