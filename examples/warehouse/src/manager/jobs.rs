//! Which vehicle does what: orders to the nearest idle ones, and charging.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use super::known::{Job, Known, State};
use crate::book::Written;
use crate::map::{Cell, Map};
use crate::orders::Order;
use cara_apps::warehouse::Place;

/// Below this an idle vehicle charges, in percent: the longest order in the hall, twice across it, takes 29.
const LOW: f64 = 40.0;
/// Until this.
const FULL: f64 = 90.0;

/// The orders, by their numbers from 1, and what has become of them.
pub(super) struct Jobs {
    pub(super) orders: Vec<Order>,
    pub(super) done: HashSet<usize>,
    /// The vehicle that may have an order's parcel, by name: no other one is sent for it.
    picked: HashMap<usize, String>,
}

impl Jobs {
    pub(super) fn new(orders: Vec<Order>, written: Written) -> Self {
        Self { orders, done: written.done, picked: written.picked }
    }

    /// A vehicle may take an order's parcel from here on.
    pub(super) fn picks(&mut self, order: usize, vehicle: &str) {
        self.picked.insert(order, vehicle.to_owned());
    }

    /// A vehicle has told what it carries, which is what counts. An order that it has delivered and that is not known to be done
    /// is returned.
    pub(super) fn reconcile(&mut self, vehicle: &mut Known, place: &Place) -> Option<usize> {
        let number = |order: i64| usize::try_from(order).ok().filter(|order| (1..=self.orders.len()).contains(order));
        let (carries, delivered) = (number(place.carries), number(place.delivered));
        self.picked.retain(|order, by| *by != vehicle.name || Some(*order) == carries);
        match (carries, vehicle.job) {
            (Some(order), job) if job != Job::Carry(order) => {
                self.picked.insert(order, vehicle.name.clone());
                vehicle.do_job(Job::Carry(order));
            }
            (None, Job::Carry(_)) => vehicle.do_job(Job::Idle),
            _ => {}
        }
        delivered.filter(|order| self.done.insert(*order))
    }

    /// Gives work to idle vehicles. Orders of vehicles that do not go on are given to others.
    pub(super) fn assign(&mut self, vehicles: &mut [Known], map: &Map, elapsed: Duration) {
        for vehicle in vehicles.iter_mut() {
            match vehicle.job {
                Job::Fetch(_) if !vehicle.peer.is_connected() => vehicle.do_job(Job::Idle),
                Job::Fetch(_) if matches!(vehicle.state, State::Stopped { .. }) => vehicle.do_job(Job::Idle),
                Job::Charge(_) if vehicle.charge().is_some_and(|charge| charge >= FULL) => vehicle.do_job(Job::Idle),
                _ => {}
            }
        }
        charge(vehicles, map);
        let taken: HashSet<usize> = vehicles.iter().filter_map(|vehicle| order_of(vehicle.job)).collect();
        let waits = |number: &usize| {
            !taken.contains(number) && !self.done.contains(number) && !self.picked.contains_key(number)
        };
        let released = |number: &usize| self.orders[number - 1].release <= elapsed;
        for number in (1..=self.orders.len()).filter(released).filter(waits) {
            let pick = self.orders[number - 1].pick;
            let idle = vehicles.iter_mut().filter(|vehicle| vehicle.job == Job::Idle && vehicle.state == State::Ready);
            let nearest = idle.min_by_key(|vehicle| vehicle.cells.map(|[at, _]| at.distance(pick)));
            let Some(vehicle) = nearest else { return };
            vehicle.do_job(Job::Fetch(number));
        }
    }
}

fn order_of(job: Job) -> Option<usize> {
    match job {
        Job::Fetch(order) | Job::Carry(order) => Some(order),
        Job::Idle | Job::Charge(_) => None,
    }
}

/// Sends idle vehicles that need it to the nearest free stations.
fn charge(vehicles: &mut [Known], map: &Map) {
    let mut taken: HashSet<Cell> = vehicles
        .iter()
        .filter_map(|vehicle| match vehicle.job {
            Job::Charge(station) => Some(station),
            _ => None,
        })
        .collect();
    for vehicle in vehicles.iter_mut().filter(|vehicle| vehicle.job == Job::Idle && vehicle.state == State::Ready) {
        let Some([at, _]) = vehicle.cells.filter(|_| vehicle.charge().is_some_and(|charge| charge < LOW)) else {
            continue;
        };
        let free = map.stations().iter().filter(|station| !taken.contains(station));
        if let Some(station) = free.min_by_key(|station| station.distance(at)).copied() {
            taken.insert(station);
            vehicle.do_job(Job::Charge(station));
        }
    }
}
