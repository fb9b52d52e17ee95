//! The floor: a grid that `cara web` reads as well, and charging stations from a file of their own, so that the map stays in the
//! format that others read.

pub use cara_apps::warehouse::Cell;
use cara_map::{FREE, Grid, Wrong};

use crate::text::{Line, Mistake};

/// Most cells along one side.
const LARGEST: u16 = 512;

/// The floor.
#[derive(Clone, Debug)]
pub struct Map {
    width: u16,
    height: u16,
    free: Vec<bool>,
    /// Of the largest connected part.
    reachable: Vec<bool>,
    stations: Vec<Cell>,
}

impl Map {
    /// Reads a `.map` file as [`Grid`] does. Vehicles drive along the four directions, whatever the type says, and count in cells,
    /// also where the map is in metres.
    pub fn parse(file: &str, text: &str) -> Result<Self, Mistake> {
        let mistake = |line, column, what| {
            let text = text.lines().nth(line - 1).unwrap_or_default();
            Line { file, number: line, text }.mistake(column, what)
        };
        let longest = usize::from(LARGEST);
        let grid = Grid::parse(text, longest, longest * longest)
            .map_err(|Wrong { line, column, what }| mistake(line, column, what))?;
        // Both are at most `LARGEST`.
        let (width, height) = (grid.width as u16, grid.rows.len() as u16);
        let free = grid.rows.iter().flat_map(|row| row.chars().map(|cell| FREE.contains(cell))).collect();
        let mut map = Self { width, height, free, reachable: Vec::new(), stations: Vec::new() };
        map.reachable = map.largest_part();
        match map.reachable.contains(&true) {
            true => Ok(map),
            false => Err(mistake(1, 1, "no cell of this map is passable: write `.` where vehicles can be".to_owned())),
        }
    }

    /// Reads charging stations: one cell a line, as `3,4`; what is behind `#` is not read.
    pub fn read_stations(&mut self, file: &str, text: &str) -> Result<(), Mistake> {
        for line in Line::all(file, text) {
            let words = line.words();
            let Some(word) = words.first() else { continue };
            if let Some(more) = words.get(1) {
                return Err(line.mistake(more.column, "one station stands on a line: remove this, or put # before it"));
            }
            let cell = line.cell(*word, self)?;
            if self.stations.contains(&cell) {
                return Err(line.mistake(word.column, format!("{cell} is a station already: remove one of the two")));
            }
            self.stations.push(cell);
        }
        Ok(())
    }

    /// Cells in a row.
    pub const fn width(&self) -> u16 {
        self.width
    }

    /// Rows.
    pub const fn height(&self) -> u16 {
        self.height
    }

    /// Where vehicles charge.
    pub fn stations(&self) -> &[Cell] {
        &self.stations
    }

    /// All cells, passable or not.
    pub const fn size(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The place of a cell in tables of [`size`](Self::size).
    pub const fn index(&self, cell: Cell) -> usize {
        cell.y as usize * self.width as usize + cell.x as usize
    }

    /// The cell of a place in such a table.
    pub const fn cell(&self, index: usize) -> Cell {
        Cell { x: (index % self.width as usize) as u16, y: (index / self.width as usize) as u16 }
    }

    /// Whether it is on the map.
    pub const fn contains(&self, cell: Cell) -> bool {
        cell.x < self.width && cell.y < self.height
    }

    /// Whether a vehicle can stand there.
    pub fn is_free(&self, cell: Cell) -> bool {
        self.contains(cell) && self.free[self.index(cell)]
    }

    /// Whether it is of the largest connected part of the floor.
    pub fn is_reachable(&self, cell: Cell) -> bool {
        self.contains(cell) && self.reachable[self.index(cell)]
    }

    /// The cells of the largest connected part.
    pub fn floor(&self) -> impl Iterator<Item = Cell> + '_ {
        (0..self.size()).filter(|index| self.reachable[*index]).map(|index| self.cell(index))
    }

    /// The passable cells beside one.
    pub fn neighbours(&self, Cell { x, y }: Cell) -> impl Iterator<Item = Cell> + '_ {
        let beside =
            [(x.checked_sub(1), Some(y)), (Some(x + 1), Some(y)), (Some(x), y.checked_sub(1)), (Some(x), Some(y + 1))];
        let cells = beside.into_iter().filter_map(|(x, y)| Some(Cell { x: x?, y: y? }));
        cells.filter(|cell| self.is_free(*cell))
    }

    /// Where so many vehicles stand at first, the same for a seed; `None` where the floor is too small. At most two thirds of it
    /// are used: vehicles need room to make way. Stations stay free.
    pub fn starts(&self, vehicles: usize, seed: u64) -> Option<Vec<Cell>> {
        let mut cells: Vec<_> = self.floor().filter(|cell| !self.stations.contains(cell)).collect();
        if vehicles > cells.len() * 2 / 3 {
            return None;
        }
        fastrand::Rng::with_seed(seed).shuffle(&mut cells);
        cells.truncate(vehicles);
        Some(cells)
    }

    fn largest_part(&self) -> Vec<bool> {
        let mut seen = vec![false; self.size()];
        let mut largest = Vec::new();
        for start in 0..self.size() {
            if !self.free[start] || seen[start] {
                continue;
            }
            seen[start] = true;
            let mut part = vec![start];
            let mut looked = 0;
            while let Some(at) = part.get(looked).copied() {
                looked += 1;
                for beside in self.neighbours(self.cell(at)) {
                    let beside = self.index(beside);
                    if !std::mem::replace(&mut seen[beside], true) {
                        part.push(beside);
                    }
                }
            }
            if part.len() > largest.len() {
                largest = part;
            }
        }
        let mut reachable = vec![false; self.size()];
        largest.into_iter().for_each(|index| reachable[index] = true);
        reachable
    }
}

#[cfg(test)]
mod tests {
    use super::{Cell, Map};
    use proptest::prelude::*;

    const SMALL: &str = "type octile\nheight 3\nwidth 4\nmap\n..@.\n.T@.\n..@@\n";

    fn map() -> Map {
        Map::parse("small.map", SMALL).unwrap()
    }

    #[test]
    fn a_map_is_read() {
        let map = map();
        assert_eq!((map.width(), map.height()), (4, 3));
        assert!(map.is_free(Cell { x: 3, y: 0 }) && !map.is_reachable(Cell { x: 3, y: 0 }));
        assert_eq!(map.floor().count(), 5);
        let beside: Vec<_> = map.neighbours(Cell { x: 0, y: 1 }).collect();
        assert_eq!(beside, [Cell { x: 0, y: 0 }, Cell { x: 0, y: 2 }]);
    }

    fn mistake(text: &str) -> (usize, usize, String) {
        let mistake = Map::parse("m", text).unwrap_err();
        (mistake.line, mistake.column, mistake.what)
    }

    #[test]
    fn mistakes_are_told_with_their_place() {
        let cases = [
            ("", 1, 1, "the file ends: write `type octile`"),
            ("height 3\n", 1, 1, "begins with `type octile`"),
            ("type octile\nheight x\n", 2, 8, "from 1 to 512"),
            ("type octile\nheight 513\n", 2, 8, "from 1 to 512"),
            ("type octile\nheight 3\nheight 3\n", 3, 1, "twice"),
            ("type octile\nheight 1\nwidth 2\n..\n", 4, 1, "write `map`"),
            ("type octile\nheight 1\nwidth 2\nmap\n.\n", 5, 2, "has 1 cells: write 2"),
            ("type octile\nheight 1\nwidth 2\nmap\n...\n", 5, 3, "longer than 2"),
            ("type octile\nheight 1\nwidth 2\nmap\n.x\n", 5, 2, "`x` is no cell"),
            ("type octile\nheight 2\nwidth 2\nmap\n..\n", 6, 1, "1 rows are there: write 2"),
            ("type octile\nheight 1\nwidth 2\nmap\n..\n..\n", 6, 1, "remove this one"),
            ("type octile\nheight 1\nwidth 2\nmap\n@@\n", 1, 1, "no cell of this map is passable"),
        ];
        for (text, line, column, what) in cases {
            let found = mistake(text);
            assert_eq!((found.0, found.1), (line, column), "{text:?}: {}", found.2);
            assert!(found.2.contains(what), "{text:?}: {}", found.2);
        }
    }

    #[test]
    fn stations_are_cells_that_vehicles_reach() {
        let mut map = map();
        map.read_stations("s", "# two\n0,0 # here\n\n1,2\n").unwrap();
        assert_eq!(map.stations(), [Cell { x: 0, y: 0 }, Cell { x: 1, y: 2 }]);
        let cases = [
            ("3,0", 1, "no way leads"),
            ("2,0", 1, "no vehicle can stand"),
            ("4,0", 1, "x from 0 to 3"),
            ("a", 1, "write x,y"),
        ];
        for (text, column, what) in cases {
            let mistake = map.clone().read_stations("s", text).unwrap_err();
            assert!(mistake.column == column && mistake.what.contains(what), "{mistake}");
        }
        assert_eq!(map.clone().read_stations("s", "0,2 1,0").unwrap_err().column, 5);
        assert!(map.read_stations("s", "0,0").unwrap_err().what.contains("already"));
    }

    #[test]
    fn vehicles_begin_apart_and_leave_room() {
        let mut map = Map::parse("m", "type octile\nheight 2\nwidth 6\nmap\n......\n......\n").unwrap();
        map.read_stations("s", "0,0\n1,0\n2,0\n").unwrap();
        let starts = map.starts(6, 7).unwrap();
        assert_eq!(map.starts(6, 7), Some(starts.clone()));
        let mut apart = starts.clone();
        apart.sort();
        apart.dedup();
        assert_eq!(apart.len(), 6);
        assert!(starts.iter().all(|cell| !map.stations().contains(cell)));
        assert_eq!(map.starts(7, 7), None);
    }

    proptest! {
        #[test]
        fn any_text_is_a_map_or_a_mistake(text in "(type octile\n)?(height [0-9]{1,3}\n)?(width [0-9]{1,3}\n)?(map\n)?([.@TxG]{0,4}\n){0,5}") {
            if let Err(mistake) = Map::parse("m", &text) {
                prop_assert!(mistake.line >= 1 && mistake.column >= 1 && !mistake.to_string().is_empty());
            }
        }
    }
}
