//! Which vehicle may enter which cell now.

use std::collections::HashMap;
use std::time::Instant;

use super::known::{Job, Known, State};
use crate::distances::Distances;
use crate::map::{Cell, Map};
use crate::orders::Order;
use crate::plan::{Agent, Ground, next_cells};

/// Ways that are kept at most, before all are made anew.
const KEPT: usize = 1_024;

/// The floor with what stands on it.
pub(super) struct Traffic {
    pub(super) map: Map,
    /// Cells of vehicles that stand for a while.
    standing: Vec<bool>,
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
        if standing != self.standing || self.ways.len() > KEPT {
            (self.standing, self.ways) = (standing, HashMap::new());
        }
        let ready = || vehicles.iter().enumerate().filter(|(_, vehicle)| vehicle.state == State::Ready);
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
