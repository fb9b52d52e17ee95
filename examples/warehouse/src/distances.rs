//! How far it is from each cell to a goal, around vehicles that stand.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::map::{Cell, Map};

/// What a vehicle that stands in the way costs, in cells: a way around it that is shorter is taken, and otherwise it is waited
/// for.
const STANDING: u32 = 40;

/// The way from each cell to one goal.
#[derive(Clone, Debug)]
pub struct Distances {
    by_cell: Vec<u32>,
}

impl Distances {
    /// To `goal`, where vehicles stand on the cells for which `standing` is true.
    pub fn to(map: &Map, goal: Cell, standing: &[bool]) -> Self {
        let mut by_cell = vec![u32::MAX; map.size()];
        let mut next = BinaryHeap::new();
        by_cell[map.index(goal)] = 0;
        next.push((Reverse(0), map.index(goal)));
        while let Some((Reverse(distance), at)) = next.pop() {
            if distance > by_cell[at] {
                continue;
            }
            let through = distance + 1 + if standing[at] { STANDING } else { 0 };
            for beside in map.neighbours(map.cell(at)).map(|cell| map.index(cell)) {
                if through < by_cell[beside] {
                    by_cell[beside] = through;
                    next.push((Reverse(through), beside));
                }
            }
        }
        Self { by_cell }
    }

    /// From the cell of this place in a table of the map.
    pub fn from(&self, index: usize) -> u32 {
        self.by_cell[index]
    }
}

#[cfg(test)]
mod tests {
    use super::Distances;
    use crate::map::{Cell, Map};

    #[test]
    fn a_short_way_around_what_stands_is_taken() {
        let map = Map::parse("m", "type octile\nheight 2\nwidth 4\nmap\n....\n....\n").unwrap();
        let mut standing = vec![false; map.size()];
        let goal = Cell { x: 3, y: 0 };
        assert_eq!(Distances::to(&map, goal, &standing).from(0), 3);
        standing[1] = true;
        assert_eq!(Distances::to(&map, goal, &standing).from(0), 5);
        standing[4] = true;
        assert_eq!(Distances::to(&map, goal, &standing).from(0), 43);
    }
}
