//! What really happened, from the logs of the vehicles' bodies: it asks no manager.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::time::Duration;

use crate::map::{Cell, Map};
use crate::orders::Order;

/// Lines of different processes come in another order than they were written; this is waited for, in nanoseconds.
const SETTLED: u64 = 3_000_000_000;
/// So many lines of each vehicle are kept, to be shown where two are in one cell.
const RECENT: usize = 8;

/// A stop, as the vehicle has measured it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Stop {
    pub(super) vehicle: String,
    pub(super) is_by_lease: bool,
    pub(super) took: Duration,
    pub(super) bound: Duration,
    pub(super) held_up: Duration,
}

impl Stop {
    /// Whether it stood in time, but for what the machine held its motors' loop up.
    pub(super) fn is_in_time(&self) -> bool {
        self.took <= self.bound + self.held_up
    }
}

/// What the vehicles have done.
#[derive(Debug)]
pub struct Truth<'m> {
    map: &'m Map,
    orders: &'m [Order],
    /// Lines by their time, which have not been looked at yet.
    waiting: BTreeMap<(u64, u64), (String, String)>,
    lines: u64,
    newest: u64,
    /// The last lines of each vehicle that have been looked at.
    recent: HashMap<String, VecDeque<String>>,
    on: HashMap<Cell, String>,
    cells: HashMap<String, Vec<Cell>>,
    pub(super) stops: Vec<Stop>,
    pub(super) restarts: usize,
    /// From cell to cell, of each vehicle.
    pub moves: HashMap<String, usize>,
    /// How often each order's parcel was put down.
    pub(super) delivered: HashMap<usize, usize>,
    /// Orders whose parcels were put down, also where the line has not been looked at yet.
    pub(super) done: HashSet<usize>,
    /// What is wrong.
    pub wrong: Vec<String>,
}

impl<'m> Truth<'m> {
    /// Of vehicles that have not said anything yet.
    pub fn new(map: &'m Map, orders: &'m [Order]) -> Self {
        Self {
            map,
            orders,
            waiting: BTreeMap::new(),
            lines: 0,
            newest: 0,
            recent: HashMap::new(),
            on: HashMap::new(),
            cells: HashMap::new(),
            stops: Vec::new(),
            restarts: 0,
            moves: HashMap::new(),
            delivered: HashMap::new(),
            done: HashSet::new(),
            wrong: Vec::new(),
        }
    }

    /// A line of a process with vehicles.
    pub fn hear(&mut self, line: &str) {
        let Some((time, vehicle, what)) = split(line) else {
            self.wrong.push(format!("no line of a log: `{line}`"));
            return;
        };
        if let ["deliver", order, _] = what.split(' ').collect::<Vec<_>>()[..] {
            self.done.extend(order.parse::<usize>());
        }
        self.lines += 1;
        self.newest = self.newest.max(time);
        // Lines of one time stay in the order in which they came.
        self.waiting.insert((time, self.lines), (vehicle.to_owned(), what.to_owned()));
        while let Some(first) = self.waiting.first_entry() {
            if first.key().0 + SETTLED > self.newest {
                return;
            }
            let (time, _) = *first.key();
            let (vehicle, what) = first.remove();
            self.take(time, &vehicle, &what);
        }
    }

    /// Looks at all that has come.
    pub fn finish(&mut self) {
        for ((time, _), (vehicle, what)) in std::mem::take(&mut self.waiting) {
            self.take(time, &vehicle, &what);
        }
    }

    /// Vehicles that were between two cells a moment ago, in the order of their names.
    pub(super) fn moving(&self) -> Vec<String> {
        let mut moving: HashMap<&str, usize> =
            self.cells.iter().map(|(name, cells)| (name.as_str(), cells.len())).collect();
        for (vehicle, what) in self.waiting.values() {
            let count = moving.entry(vehicle).or_default();
            match what.split(' ').next() {
                Some("enter") => *count += 1,
                Some("leave") => *count = count.saturating_sub(1),
                _ => {}
            }
        }
        let mut names: Vec<_> =
            moving.into_iter().filter(|(_, cells)| *cells > 1).map(|(name, _)| name.to_owned()).collect();
        names.sort();
        names
    }

    fn take(&mut self, time: u64, vehicle: &str, what: &str) {
        let recent = self.recent.entry(vehicle.to_owned()).or_default();
        recent.push_back(format!("{:.3} {what}", Duration::from_nanos(time).as_secs_f64()));
        recent.drain(..recent.len().saturating_sub(RECENT));
        let words: Vec<&str> = what.split(' ').collect();
        let known = match words[..] {
            ["enter", cell] => cell.parse().map(|cell| self.enter(vehicle, cell)).ok(),
            ["leave", cell] => cell.parse().map(|cell| self.leave(vehicle, cell)).ok(),
            ["deliver", order, at] => {
                order.parse().ok().zip(at.parse().ok()).map(|(order, at)| self.deliver(order, at))
            }
            ["stop", cause, took, bound, held_up] => self.stop(vehicle, cause, [took, bound, held_up]),
            ["off"] => Some(()),
            ["on"] => {
                self.restarts += 1;
                Some(())
            }
            _ => None,
        };
        if known.is_none() {
            self.wrong.push(format!("no line of a log: `{vehicle} {what}`"));
        }
    }

    fn enter(&mut self, vehicle: &str, cell: Cell) {
        if !self.map.is_free(cell) {
            self.wrong.push(format!("{vehicle} is on {cell}, where no vehicle can be"));
        }
        let cells = self.cells.entry(vehicle.to_owned()).or_default();
        *self.moves.entry(vehicle.to_owned()).or_default() += usize::from(!cells.is_empty());
        if cells.len() > 1 || cells.iter().any(|own| own.distance(cell) != 1) {
            self.wrong.push(format!("{vehicle} goes from {cells:?} to {cell}"));
        }
        cells.push(cell);
        if let Some(other) = self.on.insert(cell, vehicle.to_owned()) {
            let [own, others] = [vehicle, &other].map(|name| {
                let lines = self.recent.get(name).into_iter().flatten().map(String::as_str);
                format!("{name}: {}", lines.collect::<Vec<_>>().join(", "))
            });
            self.wrong.push(format!("{vehicle} and {other} are both on {cell} ({own}; {others})"));
        }
    }

    fn leave(&mut self, vehicle: &str, cell: Cell) {
        self.cells.entry(vehicle.to_owned()).or_default().retain(|own| *own != cell);
        if self.on.get(&cell).is_some_and(|on| on == vehicle) {
            self.on.remove(&cell);
        }
    }

    fn deliver(&mut self, number: usize, at: Cell) {
        *self.delivered.entry(number).or_default() += 1;
        let wanted = number.checked_sub(1).and_then(|index| self.orders.get(index)).map(|order| order.drop);
        if wanted != Some(at) {
            self.wrong.push(format!("the parcel of order {number} was put down on {at}"));
        }
    }

    fn stop(&mut self, vehicle: &str, cause: &str, micros: [&str; 3]) -> Option<()> {
        let [took, bound, held_up] = micros.map(|text| text.parse().ok().map(Duration::from_micros));
        let (took, bound, held_up) = (took?, bound?, held_up?);
        self.stops.push(Stop { vehicle: vehicle.to_owned(), is_by_lease: cause == "lease", took, bound, held_up });
        Some(())
    }
}

fn split(line: &str) -> Option<(u64, &str, &str)> {
    let (time, rest) = line.split_once(' ')?;
    let (vehicle, what) = rest.split_once(' ')?;
    let (seconds, nanos) = time.split_once('.')?;
    Some((seconds.parse::<u64>().ok()?.checked_mul(1_000_000_000)? + nanos.parse::<u64>().ok()?, vehicle, what))
}

#[cfg(test)]
mod tests {
    use super::Truth;
    use crate::map::Map;
    use crate::orders::{Order, parse};
    use std::time::Duration;

    fn seen(lines: &[&str], check: impl FnOnce(&Truth<'_>)) {
        let map = Map::parse("m", "type octile\nheight 1\nwidth 5\nmap\n....@\n").unwrap();
        let orders: Vec<Order> = parse("o", "0,0 1,0\n", &map).unwrap();
        let mut truth = Truth::new(&map, &orders);
        lines.iter().for_each(|line| truth.hear(line));
        truth.finish();
        check(&truth);
    }

    #[test]
    fn a_run_without_faults() {
        let lines = [
            "1.000000000 a enter 0,0",
            "1.000000000 b enter 3,0",
            "2.000000000 a enter 1,0",
            "3.000000000 a leave 0,0",
            "3.100000000 a deliver 1 1,0",
            "4.000000000 b enter 2,0",
            "4.100000000 b stop told 400000 520000 0",
            "5.000000000 b leave 3,0",
        ];
        seen(&lines, |truth| {
            assert!(truth.wrong.is_empty(), "{:?}", truth.wrong);
            assert_eq!((truth.moves["a"], truth.moves["b"]), (1, 1));
            assert_eq!((truth.delivered[&1], truth.done.len(), truth.stops.len()), (1, 1, 1));
            assert!(truth.stops[0].is_in_time());
        });
    }

    #[test]
    fn two_in_one_cell_are_found_in_whatever_order_the_lines_come() {
        let lines = [
            "1.0 a enter 0,0",
            "1.0 b enter 2,0",
            "2.5 b enter 1,0",
            "2.0 a enter 1,0",
            "2.9 a leave 0,0",
            "2.4 b leave 9,9",
        ];
        let [a, b] = ["a: 1.000 enter 0,0, 2.000 enter 1,0", "b: 1.000 enter 2,0, 2.000 leave 9,9, 2.000 enter 1,0"];
        let wrong = format!("b and a are both on 1,0 ({b}; {a})");
        seen(&lines, |truth| assert_eq!(truth.wrong, [wrong]));
        // The cell was left before.
        let lines = ["1.0 b enter 1,0", "3.0 a enter 1,0", "2.5 a enter 0,0", "2.0 b leave 1,0"];
        seen(&lines, |truth| assert!(truth.wrong.is_empty(), "{:?}", truth.wrong));
    }

    #[test]
    fn what_no_vehicle_can_do_is_wrong() {
        for (lines, what) in [
            (&["1.0 a enter 4,0"][..], "where no vehicle can be"),
            (&["1.0 a enter 0,0", "2.0 a enter 2,0"], "goes from"),
            (&["1.0 a deliver 1 0,0"], "put down on 0,0"),
            (&["1.0 a deliver 2 1,0"], "order 2 was put down"),
            (&["1.0 a jump"], "no line of a log"),
            (&["a"], "no line of a log"),
        ] {
            seen(lines, |truth| assert!(truth.wrong.len() == 1 && truth.wrong[0].contains(what), "{:?}", truth.wrong));
        }
    }

    #[test]
    fn a_late_stop_is_one_but_for_what_the_machine_held_up() {
        seen(&["1.0 a stop lease 930000 920000 0", "1.0 a stop lease 930000 920000 20000"], |truth| {
            assert_eq!(truth.stops.iter().map(|stop| stop.is_in_time()).collect::<Vec<_>>(), [false, true]);
            assert_eq!(truth.stops[0].bound, Duration::from_millis(920));
        });
    }
}
