//! Who goes where next: PIBT, priority inheritance with backtracking (K. Okumura, M. Machida, X. Défago, Y. Tamura, "Priority
//! Inheritance with Backtracking for Iterative Multi-agent Path Finding", Artificial Intelligence 310, 2022), made for vehicles
//! that do not move in step as its time-independent form is (Okumura, Tamura, Défago, "Time-Independent Planning for Multiple
//! Moving Agents", AAAI 2021).
//!
//! It plans one cell ahead and is asked again and again. The most urgent vehicle takes the cell that is nearest to its goal; one
//! that stands on it inherits the urgency and makes way, and where it cannot, the next best cell is tried. Vehicles that cannot be
//! commanded are obstacles where they are.
//!
//! A vehicle is sent into a cell only when that is empty, so one that follows another waits until it has left. Therefore no
//! vehicle makes way into a cell of those that push it: they would wait for each other in a circle. In the published form, in
//! which all move at once, they may.
//!
//! Where each two cells beside each other are part of a circle of cells and one cell is empty, the most urgent vehicle always
//! comes nearer to its goal; one that has waited longest is the most urgent, so that all get there. A vehicle that stands for
//! good in an aisle of one cell's width takes that away.

use crate::distances::Distances;
use crate::map::{Cell, Map};

/// What is on a cell beside vehicles that can be commanded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Ground {
    /// Nothing.
    #[default]
    Clear,
    /// A vehicle that is leaving it: it can be planned with.
    Leaving,
    /// A vehicle that stays, or that is coming.
    Taken,
}

/// A vehicle that stands in the middle of a cell and can be commanded.
#[derive(Clone, Copy, Debug)]
pub struct Agent<'d> {
    /// Where it is.
    pub at: Cell,
    /// The way to its goal; without one it stays unless it has to make way.
    pub way: Option<&'d Distances>,
    /// Larger ones go first.
    pub urgency: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Decision {
    Open,
    /// It waits for those that are to make way for it.
    Asked,
    Made(usize),
}

struct Plan<'p, 'd> {
    map: &'p Map,
    ground: &'p [Ground],
    agents: &'p [Agent<'d>],
    /// The agent on each cell.
    on: Vec<Option<usize>>,
    /// The agent that goes there, or stays there.
    reserved: Vec<Option<usize>>,
    decisions: Vec<Decision>,
}

/// The next cell of each agent, its own where it is to stay. A cell is given to one agent only; it may still have to be left by
/// another one. `ground` is a table of the map's cells.
pub fn next_cells(map: &Map, ground: &[Ground], agents: &[Agent<'_>]) -> Vec<Cell> {
    let mut on = vec![None; map.size()];
    for (agent, known) in agents.iter().enumerate() {
        on[map.index(known.at)] = Some(agent);
    }
    let mut plan = Plan {
        map,
        ground,
        agents,
        on,
        reserved: vec![None; map.size()],
        decisions: vec![Decision::Open; agents.len()],
    };
    let mut order: Vec<_> = (0..agents.len()).collect();
    order.sort_by_key(|agent| std::cmp::Reverse(agents[*agent].urgency));
    for agent in order {
        if plan.decisions[agent] == Decision::Open {
            plan.decide(agent);
        }
    }
    let cell = |(agent, decision): (usize, &Decision)| match decision {
        Decision::Made(index) => map.cell(*index),
        Decision::Open | Decision::Asked => agents[agent].at,
    };
    plan.decisions.iter().enumerate().map(cell).collect()
}

impl Plan<'_, '_> {
    /// Finds a cell for an agent; `false` where it has to stay although it was to make way. Recursion is as deep as there are
    /// agents in a row, of which each is asked once.
    fn decide(&mut self, agent: usize) -> bool {
        let at = self.map.index(self.agents[agent].at);
        self.decisions[agent] = Decision::Asked;
        for cell in self.candidates(agent) {
            if self.ground[cell] == Ground::Taken || self.reserved[cell].is_some() {
                continue;
            }
            let there = self.on[cell].filter(|there| *there != agent);
            if there.is_some_and(|there| self.decisions[there] == Decision::Asked) {
                continue;
            }
            self.reserved[cell] = Some(agent);
            if there.is_some_and(|there| self.decisions[there] == Decision::Open && !self.decide(there)) {
                // That one stays, and has reserved its cell.
                continue;
            }
            self.decisions[agent] = Decision::Made(cell);
            return true;
        }
        self.reserved[at] = Some(agent);
        self.decisions[agent] = Decision::Made(at);
        false
    }

    /// Its own cell and those beside it, the best first: nearest to the goal, and of equal ones an empty one.
    fn candidates(&self, agent: usize) -> Vec<usize> {
        let Agent { at, way, .. } = self.agents[agent];
        let own = self.map.index(at);
        let mut cells: Vec<_> = self.map.neighbours(at).map(|cell| self.map.index(cell)).collect();
        cells.push(own);
        cells.sort_by_key(|cell| {
            let distance = way.map_or(u32::from(*cell != own), |way| way.from(*cell));
            (distance, self.on[*cell].is_some() && *cell != own, self.ground[*cell] != Ground::Clear)
        });
        cells
    }
}

#[cfg(test)]
mod tests {
    use super::{Agent, Ground, next_cells};
    use crate::distances::Distances;
    use crate::map::{Cell, Map};
    use proptest::prelude::*;
    use std::collections::HashSet;

    fn map(rows: &[&str]) -> Map {
        let text = format!("type octile\nheight {}\nwidth {}\nmap\n{}\n", rows.len(), rows[0].len(), rows.join("\n"));
        Map::parse("m", &text).unwrap()
    }

    fn cell(x: u16, y: u16) -> Cell {
        Cell { x, y }
    }

    /// Vehicles that take a random time from cell to cell.
    struct World {
        map: Map,
        rng: fastrand::Rng,
        /// Where each is, and where it goes, with the steps that are left.
        vehicles: Vec<(Cell, Option<(Cell, u32)>)>,
        goals: Vec<Cell>,
        waited: Vec<u64>,
        reached: Vec<usize>,
        stands: Vec<bool>,
    }

    impl World {
        fn new(map: Map, vehicles: usize, seed: u64) -> Option<Self> {
            let starts = map.starts(vehicles, seed)?;
            let mut rng = fastrand::Rng::with_seed(seed);
            let floor: Vec<_> = map.floor().collect();
            let goals = starts.iter().map(|_| floor[rng.usize(..floor.len())]).collect();
            let vehicles: Vec<_> = starts.into_iter().map(|at| (at, None)).collect();
            let count = vehicles.len();
            Some(Self {
                map,
                rng,
                vehicles,
                goals,
                waited: vec![0; count],
                reached: vec![0; count],
                stands: vec![false; count],
            })
        }

        fn step(&mut self) {
            let floor: Vec<_> = self.map.floor().collect();
            for (at, going) in &mut self.vehicles {
                if let Some((to, left)) = going {
                    *left -= 1;
                    if *left == 0 {
                        (*at, *going) = (*to, None);
                    }
                }
            }
            for (vehicle, (at, going)) in self.vehicles.iter().enumerate() {
                self.waited[vehicle] += 1;
                if going.is_none() && *at == self.goals[vehicle] {
                    self.goals[vehicle] = floor[self.rng.usize(..floor.len())];
                    self.waited[vehicle] = 0;
                    self.reached[vehicle] += 1;
                }
            }
            let mut ground = vec![Ground::Clear; self.map.size()];
            let mut standing = vec![false; self.map.size()];
            for (vehicle, (at, going)) in self.vehicles.iter().enumerate() {
                match going {
                    Some((to, _)) => {
                        ground[self.map.index(*at)] = Ground::Leaving;
                        ground[self.map.index(*to)] = Ground::Taken;
                    }
                    None if self.stands[vehicle] => {
                        ground[self.map.index(*at)] = Ground::Taken;
                        standing[self.map.index(*at)] = true;
                    }
                    None => {}
                }
            }
            let free: Vec<_> = (0..self.vehicles.len())
                .filter(|vehicle| self.vehicles[*vehicle].1.is_none() && !self.stands[*vehicle])
                .collect();
            let ways: Vec<_> =
                free.iter().map(|vehicle| Distances::to(&self.map, self.goals[*vehicle], &standing)).collect();
            let agents: Vec<_> = free
                .iter()
                .zip(&ways)
                .map(|(vehicle, way)| Agent {
                    at: self.vehicles[*vehicle].0,
                    way: Some(way),
                    urgency: self.waited[*vehicle],
                })
                .collect();
            let next = next_cells(&self.map, &ground, &agents);
            assert_eq!(next.iter().collect::<HashSet<_>>().len(), next.len(), "two in one cell");
            for (vehicle, next) in free.into_iter().zip(next) {
                let at = self.vehicles[vehicle].0;
                assert!(at.distance(next) <= 1 && self.map.is_free(next));
                let is_empty =
                    self.vehicles.iter().all(|(at, going)| *at != next && going.is_none_or(|(to, _)| to != next));
                if next != at && is_empty {
                    self.vehicles[vehicle].1 = Some((next, self.rng.u32(1..6)));
                }
            }
            let occupied = self.vehicles.iter().flat_map(|(at, going)| [Some(*at), going.map(|(to, _)| to)]).flatten();
            let all: Vec<_> = occupied.collect();
            assert_eq!(all.iter().collect::<HashSet<_>>().len(), all.len(), "a collision");
        }
    }

    #[test]
    fn one_that_stands_in_the_way_makes_way() {
        let map = map(&["....", ".@@.", "...."]);
        let ground = vec![Ground::Clear; map.size()];
        let way = Distances::to(&map, cell(3, 0), &vec![false; map.size()]);
        let pushes = Agent { at: cell(0, 0), way: Some(&way), urgency: 9 };
        let idle = Agent { at: cell(1, 0), way: None, urgency: 0 };
        assert_eq!(next_cells(&map, &ground, &[pushes, idle]), [cell(1, 0), cell(2, 0)]);
        // Head on: the one that is less urgent goes back, and never through the other one.
        let back = Distances::to(&map, cell(0, 0), &vec![false; map.size()]);
        let other = Agent { at: cell(1, 0), way: Some(&back), urgency: 1 };
        assert_eq!(next_cells(&map, &ground, &[pushes, other]), [cell(1, 0), cell(2, 0)]);
    }

    #[test]
    fn nobody_goes_where_a_vehicle_stays_or_comes() {
        let map = map(&["..."]);
        let mut ground = vec![Ground::Clear; map.size()];
        let way = Distances::to(&map, cell(2, 0), &vec![false; map.size()]);
        let agent = [Agent { at: cell(0, 0), way: Some(&way), urgency: 0 }];
        ground[1] = Ground::Taken;
        assert_eq!(next_cells(&map, &ground, &agent), [cell(0, 0)]);
        ground[1] = Ground::Leaving;
        assert_eq!(next_cells(&map, &ground, &agent), [cell(1, 0)]);
    }

    #[test]
    fn all_get_to_their_goals_where_vehicles_stand_and_go_on() {
        let map = map(&["..........", ".@@.@@.@@.", ".@@.@@.@@.", "..........", ".@@.@@.@@.", ".........."]);
        let mut world = World::new(map, 20, 3).unwrap();
        for step in 0..6000 {
            if step % 50 == 0 {
                let vehicle = world.rng.usize(..20);
                world.stands.fill(false);
                world.stands[vehicle] = true;
            }
            world.step();
        }
        assert!(world.reached.iter().all(|reached| *reached > 20), "{:?}", world.reached);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn vehicles_never_meet_on_any_map(rows in proptest::collection::vec("[.]{2}[.@]{6}", 3..8), vehicles in 1_usize..20, seed: u64) {
            let rows: Vec<_> = rows.iter().map(String::as_str).collect();
            if let Some(mut world) = World::new(map(&rows), vehicles, seed) {
                world.stands[0] = seed % 2 == 0;
                (0..200).for_each(|_| world.step());
            }
        }
    }
}
