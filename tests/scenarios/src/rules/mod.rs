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
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::{Delivery, RequestOptions};

use crate::{Scenario, Service, Spec, Unit, World, millis, number, secs};

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

const BEST_EFFORT: RequestOptions = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::new() };

/// Calls a function until its calls leave as datagrams: before the peer has reported that they arrive, best effort goes in the stream.
fn best_effort_passes(world: &mut dyn World, unit: &Unit, peer: &str, function: &str) {
    let mut in_a_row = 0;
    for n in -1_000..0 {
        let before = sent(unit);
        unit.request_with(peer, function, &number("n", n), BEST_EFFORT).expect("it is accepted at once");
        let [in_the_stream, in_datagrams] = sent(unit);
        let goes_in_a_datagram = in_the_stream == before[0] && in_datagrams > before[1];
        world.run_for(millis(10));
        // An earlier report may come later, for so long.
        in_a_row = if goes_in_a_datagram { in_a_row + 1 } else { 0 };
        if in_a_row == 30 {
            return;
        }
    }
    panic!("within 10 s {peer} has not reported that datagrams arrive");
}

fn sent(unit: &Unit) -> [u64; 2] {
    [LinkCounter::MessagesSent, LinkCounter::DatagramsSent].map(|counter| unit.counted(counter))
}

/// Waits until a datagram of each has reached the other: from then on keep-alives keep the link while its stream is held up.
fn keep_alives_pass(world: &mut dyn World, units: [&Unit; 2]) {
    let received = || units.iter().all(|unit| unit.counted(LinkCounter::DatagramsReceived) > 0);
    world.wait("datagrams pass both ways", received, secs(40));
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
