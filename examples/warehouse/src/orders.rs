//! What is to be carried where: a file with one order a line.
//!
//! ```text
//! # pick  drop   seconds after the start, 0 unless given
//! 3,4     20,7
//! 3,4     11,2   12.5
//! ```

use std::fmt;
use std::time::Duration;

use crate::map::{Cell, Map};
use crate::text::{Line, Mistake};

/// Most orders in a file.
const MOST: usize = 100_000;
/// The latest release of an order, in seconds: a day.
const LATEST: f64 = 86_400.0;

/// A parcel to be carried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Order {
    /// Where it lies.
    pub pick: Cell,
    /// Where it is to lie.
    pub drop: Cell,
    /// It becomes known so long after the start.
    pub release: Duration,
}

impl fmt::Display for Order {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {:.1}", self.pick, self.drop, self.release.as_secs_f64())
    }
}

/// Reads a file of orders; an order's number is its place, from 1.
pub fn parse(file: &str, text: &str, map: &Map) -> Result<Vec<Order>, Mistake> {
    let mut orders = Vec::new();
    for line in Line::all(file, text) {
        let words = line.words();
        let Some(pick) = words.first() else { continue };
        if orders.len() == MOST {
            return Err(line.mistake(1, format!("{MOST} orders are read at most: put the rest into another file")));
        }
        let end = line.text.trim_end().chars().count() + 1;
        let drop =
            words.get(1).ok_or_else(|| line.mistake(end, "say where it is carried: write a second cell, as 20,7"))?;
        if let Some(more) = words.get(3) {
            return Err(line.mistake(more.column, "an order is two cells and seconds: remove this, or put # before it"));
        }
        let order = Order { pick: line.cell(*pick, map)?, drop: line.cell(*drop, map)?, release: Duration::ZERO };
        if order.pick == order.drop {
            return Err(line.mistake(drop.column, "the parcel lies there already: write another cell"));
        }
        let seconds = words.get(2).map(|word| {
            let seconds = word.text.parse().ok().filter(|seconds| (0.0..=LATEST).contains(seconds));
            seconds
                .ok_or_else(|| line.mistake(word.column, format!("write seconds after the start, from 0 to {LATEST}")))
        });
        let release = Duration::from_secs_f64(seconds.transpose()?.unwrap_or(0.0));
        orders.push(Order { release, ..order });
    }
    match orders.is_empty() {
        true => {
            Err(Line { file, number: 1, text: "" }.mistake(1, "no order is there: write one a line, as `3,4 20,7`"))
        }
        false => Ok(orders),
    }
}

/// Draws so many orders, released evenly within `span`.
pub fn draw(map: &Map, count: usize, span: Duration, rng: &mut fastrand::Rng) -> Vec<Order> {
    let cells: Vec<_> = map.floor().filter(|cell| !map.stations().contains(cell)).collect();
    let (mut orders, mut cell) = (Vec::with_capacity(count), || cells[rng.usize(..cells.len())]);
    while orders.len() < count && cells.len() > 1 {
        let (pick, drop) = (cell(), cell());
        if pick != drop {
            let release = span.mul_f64(orders.len() as f64 / count as f64);
            orders.push(Order { pick, drop, release });
        }
    }
    orders
}

#[cfg(test)]
mod tests {
    use super::{Order, draw, parse};
    use crate::map::{Cell, Map};
    use std::time::Duration;

    fn map() -> Map {
        Map::parse("m", "type octile\nheight 2\nwidth 4\nmap\n..@.\n....\n").unwrap()
    }

    #[test]
    fn orders_are_read() {
        let orders = parse("o", "# two\n0,0 3,1\n\n 1,1  0,0 2.5 # later\n", &map()).unwrap();
        let cell = |x, y| Cell { x, y };
        let first = Order { pick: cell(0, 0), drop: cell(3, 1), release: Duration::ZERO };
        let second = Order { pick: cell(1, 1), drop: cell(0, 0), release: Duration::from_millis(2500) };
        assert_eq!(orders, [first, second]);
    }

    #[test]
    fn mistakes_are_told_with_their_place() {
        let cases = [
            ("", 1, 1, "no order is there"),
            ("0,0\n", 1, 4, "say where it is carried"),
            ("0,0 3,1\n0,0 2,0\n", 2, 5, "no vehicle can stand on 2,0"),
            ("0,0 4,0\n", 1, 5, "x from 0 to 3"),
            ("0;0 4,0\n", 1, 1, "write x,y"),
            ("0,0 0,0\n", 1, 5, "already"),
            ("0,0 1,0 -1\n", 1, 9, "from 0 to 86400"),
            ("0,0 1,0 NaN\n", 1, 9, "from 0 to 86400"),
            ("0,0 1,0 1 2\n", 1, 11, "remove this"),
        ];
        for (text, line, column, what) in cases {
            let found = parse("o", text, &map()).unwrap_err();
            assert_eq!((found.line, found.column), (line, column), "{found}");
            assert!(found.what.contains(what), "{found}");
        }
    }

    #[test]
    fn drawn_orders_can_be_read_again() {
        let map = map();
        let orders = draw(&map, 20, Duration::from_secs(10), &mut fastrand::Rng::with_seed(1));
        let text: String = orders.iter().map(|order| format!("{order}\n")).collect();
        assert_eq!(parse("o", &text, &map).unwrap(), orders);
        assert_eq!(orders[10].release, Duration::from_secs(5));
    }
}
