//! A vehicle: its body and its motor, and what its services do. Where it runs, and how its order is watched, its port says.

use cara_core::error::ServiceError;

use super::{Body, Cell, Motor, Place, refusal};

/// A vehicle. `Order` is what names a call in its port, by which it says that it has done what that call wanted.
#[derive(Clone, Debug)]
pub struct Vehicle<Order> {
    /// Its body.
    pub body: Body,
    /// What moves it.
    pub motor: Motor,
    /// The order of the cell that it drives to.
    pub order: Option<Order>,
    moves: i64,
    carries: i64,
    delivered: i64,
    is_faulty: bool,
}

/// What an order to drive has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entered {
    /// The number of the move.
    pub moves: i64,
    /// It was not on its way to this cell already.
    pub is_new: bool,
}

impl<Order> Vehicle<Order> {
    /// One that stands, with a battery that is so full, in percent.
    pub const fn new(at: Cell, charge: f64) -> Self {
        Self {
            body: Body::new(at, charge),
            motor: Motor::new(),
            order: None,
            moves: 0,
            carries: 0,
            delivered: 0,
            is_faulty: false,
        }
    }

    /// Where it is and what it carries; `is_ordered` while an order lives.
    pub fn place(&self, is_ordered: bool) -> Place {
        Place {
            at: self.body.at().numbers(),
            next: self.body.next().numbers(),
            moves: self.moves,
            stands: self.body.stands() && !is_ordered,
            carries: self.carries,
            delivered: self.delivered,
            charge: self.body.charge(),
        }
    }

    /// Is to drive into a cell beside its own, or on into the one that it is entering.
    pub fn advance(&mut self, cell: [i64; 2], order: Option<Order>) -> Result<Entered, ServiceError> {
        let cell = Cell::of_numbers(cell).filter(|cell| self.body.can_enter(*cell));
        let cell = cell.ok_or(ServiceError::Failed(refusal::NOT_BESIDE))?;
        let is_new = self.body.next() != cell;
        self.body.enter(cell);
        self.moves = self.moves.saturating_add(1);
        self.order = order;
        Ok(Entered { moves: self.moves, is_new })
    }

    /// Takes the parcel of an order.
    pub fn load(&mut self, order: i64) -> Result<(), ServiceError> {
        self.stands_in_a_cell()?;
        if self.carries != 0 && self.carries != order {
            return Err(ServiceError::Failed(refusal::OTHER_PARCEL));
        }
        self.carries = order;
        Ok(())
    }

    /// Puts the parcel of an order down; whether it had not before.
    pub fn unload(&mut self, order: i64) -> Result<bool, ServiceError> {
        self.stands_in_a_cell()?;
        if self.delivered == order {
            return Ok(false);
        }
        if self.carries != order {
            return Err(ServiceError::Failed(refusal::OTHER_PARCEL));
        }
        (self.carries, self.delivered) = (0, order);
        Ok(true)
    }

    /// May drive again, unless it has a fault that has not been mended.
    pub const fn reset(&mut self, mended: bool) -> Result<(), ServiceError> {
        self.is_faulty &= !mended;
        if self.is_faulty { Err(ServiceError::Failed(refusal::FAULTY)) } else { Ok(()) }
    }

    /// It has a fault.
    pub const fn fail(&mut self) {
        self.is_faulty = true;
    }

    /// Whether it has one.
    pub const fn is_faulty(&self) -> bool {
        self.is_faulty
    }

    fn stands_in_a_cell(&self) -> Result<(), ServiceError> {
        let stands = self.body.stands() && self.body.at() == self.body.next();
        stands.then_some(()).ok_or(ServiceError::Failed(refusal::MOVES))
    }
}

#[cfg(test)]
mod tests {
    use super::{Cell, Entered, Vehicle, refusal};
    use cara_core::error::ServiceError;
    use core::time::Duration;

    const START: Cell = Cell { x: 1, y: 1 };

    #[test]
    fn it_drives_into_cells_beside_its_own_and_on_into_the_one_that_it_enters() {
        let mut vehicle = Vehicle::<()>::new(START, 100.0);
        let not_beside = Err(ServiceError::Failed(refusal::NOT_BESIDE));
        for cell in [[1, 1], [3, 1], [2, 2], [-1, 1], [65_537, 1]] {
            assert_eq!(vehicle.advance(cell, None), not_beside, "{cell:?}");
        }
        assert_eq!(vehicle.advance([2, 1], Some(())), Ok(Entered { moves: 1, is_new: true }));
        vehicle.body.step(Duration::from_millis(100), true, false);
        vehicle.body.step(Duration::from_millis(500), false, false);
        assert_eq!(vehicle.advance([1, 1], None), not_beside, "it stands between two cells");
        assert_eq!(vehicle.advance([2, 1], Some(())), Ok(Entered { moves: 2, is_new: false }));
        assert!(vehicle.place(false).stands && !vehicle.place(true).stands);
        assert_eq!(vehicle.load(7), Err(ServiceError::Failed(refusal::MOVES)));
    }

    #[test]
    fn a_parcel_is_put_down_once() {
        let mut vehicle = Vehicle::<()>::new(START, 100.0);
        let other = ServiceError::Failed(refusal::OTHER_PARCEL);
        assert_eq!(vehicle.unload(7), Err(other));
        assert_eq!([vehicle.load(7), vehicle.load(7), vehicle.load(8)], [Ok(()), Ok(()), Err(other)]);
        assert_eq!([vehicle.unload(8), vehicle.unload(7), vehicle.unload(7)], [Err(other), Ok(true), Ok(false)]);
        assert_eq!((vehicle.place(false).carries, vehicle.place(false).delivered), (0, 7));
    }

    #[test]
    fn one_with_a_fault_is_let_go_on_when_it_is_mended() {
        let mut vehicle = Vehicle::<()>::new(START, 100.0);
        assert_eq!(vehicle.reset(false), Ok(()));
        vehicle.fail();
        assert_eq!([vehicle.reset(false), vehicle.reset(true)], [Err(ServiceError::Failed(refusal::FAULTY)), Ok(())]);
        assert!(!vehicle.is_faulty());
    }
}
