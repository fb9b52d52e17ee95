//! A vehicle's body: where it is, how fast, how full its battery is. It moves in small steps of time from the middle of one cell
//! to that of the next, and stands still at the end of a ramp. What it may do the orders say; this knows nothing of them.

use core::time::Duration;

use super::Cell;

/// The side of a cell is a metre; metres a second.
const SPEED: f64 = 1.8;
/// Metres a second, each second, faster and slower.
const ACCELERATION: f64 = 4.0;
/// From full speed to standing still it takes 450 ms; what is granted is a little more.
pub const RAMP: Duration = Duration::from_millis(500);

/// Percent of the battery that a metre takes.
const PER_METRE: f64 = 0.15;
/// Percent a second that a station gives.
const CHARGING: f64 = 4.0;
/// With an empty battery it creeps.
const CREEPING: f64 = 0.2;
/// A step of the integration.
const STEP: f64 = 0.005;
/// The longest time that counts: a loop that was held up makes no jump.
const LONGEST: Duration = Duration::from_millis(500);
/// So near to a cell's middle it is there.
const THERE: f64 = 0.001;

/// A body.
#[derive(Clone, Debug)]
pub struct Body {
    at: Cell,
    /// The same as `at` while it stands in the middle.
    next: Cell,
    /// Metres from the middle of `at` to that of `next`.
    along: f64,
    speed: f64,
    charge: f64,
}

impl Body {
    /// One that stands, with a battery that is so full, in percent.
    pub const fn new(at: Cell, charge: f64) -> Self {
        Self { at, next: at, along: 0.0, speed: 0.0, charge }
    }

    /// The cell that it is in, or leaves.
    pub const fn at(&self) -> Cell {
        self.at
    }

    /// The cell that it enters; the same as [`at`](Self::at) where it enters none.
    pub const fn next(&self) -> Cell {
        self.next
    }

    /// Whether it does not move.
    pub const fn stands(&self) -> bool {
        self.speed == 0.0
    }

    /// In metres.
    pub fn position(&self) -> [f64; 2] {
        let along = |at: u16, next: u16| f64::from(at) + (f64::from(next) - f64::from(at)) * self.along;
        [along(self.at.x, self.next.x), along(self.at.y, self.next.y)]
    }

    /// Percent.
    pub const fn charge(&self) -> f64 {
        self.charge
    }

    /// Whether it can begin to drive there: to a cell beside its own, or, where it stands between two cells, to the one that it
    /// was entering.
    pub const fn can_enter(&self, cell: Cell) -> bool {
        if self.at.distance(self.next) == 0 { self.at.distance(cell) == 1 } else { self.next.distance(cell) == 0 }
    }

    /// The cell that it drives to when it is let; only if [`can_enter`](Self::can_enter) says so.
    pub fn enter(&mut self, cell: Cell) {
        self.next = cell;
    }

    /// Moves for so long, on or down to a stop; whether it has arrived in the middle of `next`.
    pub fn step(&mut self, elapsed: Duration, on: bool, station: bool) -> bool {
        let mut left = elapsed.min(LONGEST).as_secs_f64();
        let mut arrived = false;
        while left > 0.0 {
            let span = left.min(STEP);
            left -= span;
            arrived |= self.advance(span, on);
            if station && self.stands() && self.at == self.next {
                self.charge = (self.charge + CHARGING * span).min(100.0);
            }
        }
        arrived
    }

    fn advance(&mut self, span: f64, on: bool) -> bool {
        if self.at == self.next {
            return false;
        }
        let left = 1.0 - self.along;
        let most = if self.charge > 0.0 { SPEED } else { CREEPING };
        let change = ACCELERATION * span;
        // No faster than it can stop within the cell, whatever ends the order, if it goes so fast for another step.
        let stops = |speed: &f64| speed * (span + speed / (2.0 * ACCELERATION)) <= left;
        let slower = self.speed - change;
        let choices = [(self.speed + change).min(most), self.speed.min(most)].map(|speed| speed.max(slower));
        let faster = choices.into_iter().find(stops).filter(|_| on).unwrap_or(slower).max(0.0);
        let way = ((self.speed + faster) / 2.0 * span).clamp(0.0, left);
        (self.speed, self.along) = (faster, self.along + way);
        self.charge = (self.charge - PER_METRE * way).max(0.0);
        if 1.0 - self.along > THERE {
            return false;
        }
        (self.at, self.along, self.speed) = (self.next, 0.0, 0.0);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::{ACCELERATION, Body, Cell, RAMP, SPEED};
    use core::time::Duration;
    use proptest::prelude::*;

    const TICK: Duration = Duration::from_millis(20);
    const START: Cell = Cell { x: 3, y: 3 };
    const BESIDE: Cell = Cell { x: 3, y: 2 };

    fn driving() -> Body {
        let mut body = Body::new(START, 100.0);
        body.enter(BESIDE);
        body
    }

    #[test]
    fn a_cell_takes_a_second() {
        let mut body = driving();
        let ticks = (1..200).find(|_| body.step(TICK, true, false)).unwrap();
        assert!((47..=51).contains(&ticks), "{ticks}");
        assert_eq!((body.at(), body.next(), body.stands(), body.position()), (BESIDE, BESIDE, true, [3.0, 2.0]));
        assert!((body.charge() - 99.85).abs() < 0.001);
        assert!(!body.step(TICK, true, false));
    }

    #[test]
    fn full_speed_stops_within_the_ramp() {
        assert!(SPEED / ACCELERATION < RAMP.as_secs_f64());
        let mut body = driving();
        (0..25).for_each(|_| assert!(!body.step(TICK, true, false)));
        let before = body.position();
        assert!((body.speed - SPEED).abs() < 0.01);
        assert!(!body.step(TICK, false, false) && !body.stands());
        body.step(RAMP - TICK, false, false);
        assert!(body.stands());
        assert!(before[1] - body.position()[1] > 0.3, "a stop takes a way");
        assert!(body.can_enter(BESIDE) && !body.can_enter(START) && !body.can_enter(Cell { x: 4, y: 3 }));
        assert!((1..200).any(|_| body.step(TICK, true, false)));
    }

    #[test]
    fn a_station_charges_what_stands_there() {
        let mut body = Body::new(START, 10.0);
        (0..50).for_each(|_| assert!(!body.step(TICK, false, true)));
        assert!((body.charge() - 14.0).abs() < 0.01);
        body.enter(BESIDE);
        body.step(TICK, true, true);
        assert!(body.charge() < 14.0);
    }

    #[test]
    fn an_empty_battery_lets_it_creep() {
        let mut body = Body::new(START, 0.0);
        body.enter(BESIDE);
        let ticks = (1..1000).find(|_| body.step(TICK, true, false)).unwrap();
        assert!(ticks > 200, "{ticks}");
    }

    proptest! {
        #[test]
        fn whatever_ends_the_order_it_stays_within_its_cells(steps in proptest::collection::vec((1_u64..400, any::<bool>()), 1..60)) {
            let mut body = driving();
            for (millis, on) in steps {
                let before = body.at();
                let arrived = body.step(Duration::from_millis(millis), on, false);
                prop_assert!((0.0..1.0).contains(&body.along));
                prop_assert_eq!(arrived, body.at() != before);
            }
        }
    }
}
