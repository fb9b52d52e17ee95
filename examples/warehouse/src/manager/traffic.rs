//! Which vehicle may enter which cell now.

use std::collections::{HashMap, HashSet};
use std::time::Instant;

use super::known::{Job, Known, State};
use crate::distances::Distances;
use crate::map::{Cell, Map};
use crate::orders::Order;
use crate::plan::{Agent, Ground, next_cells};

/// The floor with what stands on it.
pub(super) struct Traffic {
    pub(super) map: Map,
    /// Cells of vehicles that stand for a while.
    standing: Vec<bool>,
    /// To the goals that vehicles have now.
    ways: HashMap<Cell, Distances>,
}

impl Traffic {
    pub(super) fn new(map: Map) -> Self {
        let standing = vec![false; map.size()];
        Self { map, standing, ways: HashMap::new() }
    }

    /// The vehicles that may enter a cell now, each with its cell. None while the place of any vehicle is unknown.
    pub(super) fn grants(&mut self, vehicles: &[Known], orders: &[Order]) -> Vec<(usize, Cell)> {
        let mut ground = vec![Ground::Clear; self.map.size()];
        let mut standing = vec![false; self.map.size()];
        let mut occupied = vec![false; self.map.size()];
        for vehicle in vehicles {
            let Some(cells) = vehicle.cells else { return Vec::new() };
            let [at, next] = cells.map(|cell| self.map.index(cell));
            (occupied[at], occupied[next]) = (true, true);
            match vehicle.state {
                // It goes when it is full, and makes way for nobody: others drive around it.
                State::Ready if vehicle.is_charging() => (ground[at], standing[at]) = (Ground::Taken, true),
                State::Ready => {}
                State::Sent | State::Moves(..) => {
                    // It leaves the one, unless it was sent on within its own.
                    (ground[at], ground[next]) = (Ground::Leaving, Ground::Taken);
                }
                State::Handles => ground[at] = Ground::Taken,
                State::Lost(_) | State::Asked | State::Stopped { .. } => {
                    (ground[at], ground[next]) = (Ground::Taken, Ground::Taken);
                    (standing[at], standing[next]) = (true, true);
                }
            }
        }
        if standing != self.standing {
            (self.standing, self.ways) = (standing, HashMap::new());
        }
        let goals: HashSet<Cell> = vehicles.iter().filter_map(|vehicle| goal(vehicle.job, orders)).collect();
        self.ways.retain(|goal, _| goals.contains(goal));
        let is_ready = |vehicle: &Known| vehicle.state == State::Ready && !vehicle.is_charging();
        let ready = || vehicles.iter().enumerate().filter(|(_, vehicle)| is_ready(vehicle));
        for goal in ready().filter_map(|(_, vehicle)| goal(vehicle.job, orders)) {
            self.ways.entry(goal).or_insert_with(|| Distances::to(&self.map, goal, &self.standing));
        }
        let now = Instant::now();
        let (numbers, agents): (Vec<_>, Vec<_>) = ready()
            .filter_map(|(number, vehicle)| {
                let [at, _] = vehicle.cells?;
                let way = goal(vehicle.job, orders).and_then(|goal| self.ways.get(&goal));
                let waited = now.saturating_duration_since(vehicle.since).as_millis() as u64 + 1;
                Some((number, Agent { at, way, urgency: if way.is_some() { waited } else { 0 } }))
            })
            .unzip();
        let next = next_cells(&self.map, &ground, &agents);
        let moves = numbers.into_iter().zip(agents).zip(next);
        // A cell is granted when nothing is on it any more.
        let free = moves.filter(|((_, agent), next)| *next != agent.at && !occupied[self.map.index(*next)]);
        free.map(|((number, _), next)| (number, next)).collect()
    }
}

/// Where a job takes a vehicle next.
pub(super) fn goal(job: Job, orders: &[Order]) -> Option<Cell> {
    match job {
        Job::Idle => None,
        Job::Fetch(order) => Some(orders[order - 1].pick),
        Job::Carry(order) => Some(orders[order - 1].drop),
        Job::Charge(station) => Some(station),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::time::Duration;

    use cara_std::{CommunicationSystem, Identity};

    use super::{Job, Known, Order, State, Traffic};
    use crate::manager::Desk;
    use crate::map::{Cell, Map};
    use crate::network::{MANAGER, Network, vehicle_id, vehicle_name};

    #[test]
    fn one_that_charges_is_driven_around() {
        let cell = |x, y| Cell { x, y };
        let network = Network { fleet: 4_242, everywhere: false };
        let own = Identity::m_unit(MANAGER.0, MANAGER.1).unwrap();
        let keys = network.draw_keys(2).unwrap().ring(&own).unwrap();
        let builder = network.place(CommunicationSystem::builder(MANAGER.0, MANAGER.1).unwrap());
        let system = builder.keys(keys).state(Desk::default()).build().unwrap();
        let vehicle = |id: u32, at: Cell, job| {
            let identity = Identity::s_unit(&vehicle_name(id), vehicle_id(id)).unwrap();
            let mut known = Known::new(vehicle_name(id), system.node(&identity).unwrap(), Some([at; 2]), channel().0);
            (known.state, known.job) = (State::Ready, job);
            known
        };
        let map = Map::parse("m", "type octile\nheight 2\nwidth 4\nmap\n....\n....\n").unwrap();
        let orders = [Order { pick: cell(0, 0), drop: cell(3, 1), release: Duration::ZERO }];
        let mut vehicles = [vehicle(1, cell(1, 0), Job::Charge(cell(1, 0))), vehicle(2, cell(2, 0), Job::Fetch(1))];
        let mut traffic = Traffic::new(map);
        assert_eq!(traffic.grants(&vehicles, &orders), [(1, cell(2, 1))]);
        assert_eq!(traffic.ways.len(), 1);
        // Once it is full it makes way, and the other way is as short.
        vehicles[0].job = Job::Idle;
        vehicles[1].job = Job::Idle;
        assert!(traffic.grants(&vehicles, &orders).is_empty() && traffic.ways.is_empty());
    }
}
