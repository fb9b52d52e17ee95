//! A vehicle that tracks its position and drives only while a lease is live.

use core::fmt;

use cara_core::Variables;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::ServiceError;
use cara_core::time::Duration;

/// Tells where the vehicle is, rounded to whole units.
pub const POS_INFO: &str = "pos_info(position: int[2]) -> (position: int[2])";
/// Drives to a position, first along x, then along y. Wants a lease: driving goes on while the caller renews it.
pub const GO_TO: &str = "go_to(position: int[2])";
/// Tells how full the battery is, in percent.
pub const BATTERY: &str = "battery() -> (charge: float)";
/// The stream of where the vehicle is: [`Pose`].
pub const POSE: &str = "pose";
/// The stream of how full the battery is: [`Charge`].
pub const CHARGE: &str = "charge";
/// Stops at once, and keeps the vehicle from driving until [`RESET`].
pub const STOP: &str = "stop()";
/// Lets the vehicle drive again, unless its bumper is pressed.
pub const RESET: &str = "reset()";

/// Where the vehicle is.
#[derive(Variables, Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// In units.
    pub position: [f64; 2],
}

/// How full the battery is.
#[derive(Variables, Clone, Copy, Debug, PartialEq)]
pub struct Charge {
    /// Of a full one.
    pub percent: f64,
}

/// How long [`GO_TO`] goes on after the manager's last renewal.
pub const GO_TO_LEASE: Duration = Duration::from_millis(400);
/// How often [`Agv::step`] is to be called.
pub const TICK: Duration = Duration::from_millis(20);

/// The code of the error for a position that is out of the warehouse.
pub const OUT_OF_THE_WAREHOUSE: u16 = 1;
/// The code of the error for a reset while the bumper is pressed.
pub const BUMPER_IS_PRESSED: u16 = 2;

/// Why the vehicle stops itself, as callers are told: its bumper was pressed.
pub const BUMPER: u16 = 1;

/// The warehouse reaches this many units from its middle, in each direction.
const WAREHOUSE: i64 = 10_000;
/// Parts of a unit that are counted.
const PARTS: i64 = 1_000;
/// Parts of a unit that the vehicle drives in a millisecond: a unit takes half a second.
const SPEED: i64 = 2;
/// Units that the vehicle can drive with a full battery.
const RANGE: i64 = 5_000;
/// The longest time that counts as one step: a loop that was held up must not make the vehicle jump.
const LONGEST_STEP: Duration = Duration::from_millis(100);

/// A place in the warehouse, exact to a thousandth of a unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Place {
    x: i64,
    y: i64,
}

impl Place {
    /// A place of whole units.
    pub const fn at(position: [i64; 2]) -> Self {
        let [x, y] = position;
        Self { x: x.saturating_mul(PARTS), y: y.saturating_mul(PARTS) }
    }

    /// The nearest place of whole units.
    pub const fn rounded(self) -> [i64; 2] {
        [(self.x + PARTS / 2).div_euclid(PARTS), (self.y + PARTS / 2).div_euclid(PARTS)]
    }

    /// In units.
    pub const fn exact(self) -> [f64; 2] {
        [self.x as f64 / PARTS as f64, self.y as f64 / PARTS as f64]
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = |parts: i64| if parts < 0 { "-" } else { "" };
        let [x, y] = [self.x.unsigned_abs(), self.y.unsigned_abs()];
        let parts = PARTS.unsigned_abs();
        write!(f, "[{}{}.{:03}, ", sign(self.x), x / parts, x % parts)?;
        write!(f, "{}{}.{:03}]", sign(self.y), y / parts, y % parts)
    }
}

/// What a step of driving led to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// The vehicle has come nearer to another whole unit.
    Passed(Place),
    /// It is where it was to go, and stands.
    Arrived(Place),
    /// The lease ended; it stands.
    Stopped(Place),
}

/// A vehicle. It stands until [`Agv::go_to`], and moves in [`Agv::step`] only. `Order` is what names a call in its port, by which
/// the vehicle says that it has done what that call wanted.
#[derive(Clone, Debug, Default)]
pub struct Agv<Order = ()> {
    place: Place,
    target: Option<Place>,
    /// The order of the last target.
    order: Option<Order>,
    /// Parts of a unit that it has driven.
    driven: i64,
    bumper: bool,
}

impl<Order> Agv<Order> {
    /// A vehicle that stands.
    pub const fn new(position: [i64; 2]) -> Self {
        Self { place: Place::at(position), target: None, order: None, driven: 0, bumper: false }
    }

    /// Where it is.
    pub const fn place(&self) -> Place {
        self.place
    }

    /// Where it drives to, if it drives.
    pub const fn target(&self) -> Option<Place> {
        self.target
    }

    /// Drives for `elapsed`; without a live lease it stops.
    pub fn step(&mut self, elapsed: Duration, lease_live: bool) -> Option<Progress> {
        let target = self.target?;
        if !lease_live {
            return self.stop().map(Progress::Stopped);
        }
        let before = self.place.rounded();
        let micros = elapsed.as_micros().min(LONGEST_STEP.as_micros()) as i64;
        let budget = micros * SPEED / 1_000;
        let left = approach(&mut self.place.x, target.x, budget);
        let left = approach(&mut self.place.y, target.y, left);
        self.driven += budget - left;
        if self.place == target {
            self.target = None;
            return Some(Progress::Arrived(self.place));
        }
        (self.place.rounded() != before).then_some(Progress::Passed(self.place))
    }

    /// The order whose target it has reached, once: the one that is finished, whichever has begun since.
    pub fn finished(&mut self) -> Option<Order> {
        self.order.take_if(|_| self.target.is_none())
    }

    /// Stops at once; where, if it was driving.
    pub fn stop(&mut self) -> Option<Place> {
        self.order = None;
        self.target.take().map(|_| self.place)
    }

    /// Notes whether the bumper is pressed.
    pub fn set_bumper(&mut self, pressed: bool) {
        self.bumper = pressed;
    }

    /// Serves [`RESET`].
    pub fn reset(&self) -> Result<(), ServiceError> {
        if self.bumper { Err(ServiceError::Failed(BUMPER_IS_PRESSED)) } else { Ok(()) }
    }

    /// Serves [`POS_INFO`].
    pub fn pos_info(&self, parameters: &mut ParametersView) -> Result<(), ServiceError> {
        parameters.set_value("position", self.place.rounded()).map_err(|_| ServiceError::BadResults)
    }

    /// Serves [`GO_TO`]; a later call replaces the target of an earlier one, and its order.
    pub fn go_to(&mut self, parameters: &ParametersView, order: Option<Order>) -> Result<(), ServiceError> {
        let outside = ServiceError::Failed(OUT_OF_THE_WAREHOUSE);
        let position: [i64; 2] = parameters.variable("position").map_err(|_| outside)?;
        if position.iter().any(|along| !(-WAREHOUSE..=WAREHOUSE).contains(along)) {
            return Err(outside);
        }
        (self.target, self.order) = (Some(Place::at(position)), order);
        Ok(())
    }

    /// Serves [`BATTERY`].
    pub fn battery(&self, parameters: &mut ParametersView) -> Result<(), ServiceError> {
        parameters.set_value("charge", self.charge()).map_err(|_| ServiceError::BadResults)
    }

    /// How full the battery is, in percent.
    pub fn charge(&self) -> f64 {
        (100.0 - 100.0 * self.driven as f64 / (RANGE * PARTS) as f64).max(0.0)
    }
}

/// Moves `from` towards `to` by at most `budget`; what is left of it.
fn approach(from: &mut i64, to: i64, budget: i64) -> i64 {
    let way = (to - *from).clamp(-budget, budget);
    *from += way;
    budget - way.abs()
}

#[cfg(test)]
mod tests {
    use super::{Agv, BUMPER_IS_PRESSED, OUT_OF_THE_WAREHOUSE, Place, Progress, TICK};
    use cara_core::distribution::parameters::Parameters;
    use cara_core::error::ServiceError;

    fn position(value: [i64; 2]) -> Parameters {
        let mut parameters = Parameters::new();
        parameters.add_int("position", 2).unwrap();
        parameters.set_value("position", value).unwrap();
        parameters
    }

    fn driving_to(target: [i64; 2]) -> Agv<u8> {
        let mut agv = Agv::new([0, 0]);
        agv.go_to(&position(target), Some(1)).unwrap();
        agv
    }

    #[test]
    fn a_unit_takes_half_a_second() {
        let mut agv = driving_to([1, -2]);
        let steps = (1..).find(|_| matches!(agv.step(TICK, true), Some(Progress::Arrived(_)))).unwrap();
        assert_eq!(steps, 75);
        assert_eq!(agv.place(), Place::at([1, -2]));
        assert_eq!(agv.step(TICK, true), None);
        assert_eq!((agv.finished(), agv.finished()), (Some(1), None));
    }

    #[test]
    fn a_place_is_exact_in_units() {
        let mut agv = driving_to([0, -1]);
        assert_eq!(agv.step(TICK, true), None);
        assert_eq!((agv.place().exact(), agv.charge()), ([0.0, -0.04], 100.0 - 0.04 / 50.0));
    }

    #[test]
    fn it_stops_where_it_is_and_stays() {
        let mut agv = driving_to([5, 0]);
        agv.step(TICK, true);
        let place = agv.place();
        assert_eq!(agv.step(TICK, false), Some(Progress::Stopped(place)));
        assert_eq!(agv.step(TICK, true), None);
        assert_eq!((agv.place(), agv.stop()), (place, None));
        assert_ne!(place, Place::at([0, 0]));
    }

    #[test]
    fn a_loop_that_was_held_up_makes_no_jump() {
        let mut agv = driving_to([100, 0]);
        agv.step(cara_core::time::Duration::from_secs(10), true);
        assert_eq!(agv.place().rounded(), [0, 0]);
    }

    #[test]
    fn it_stays_in_the_warehouse() {
        let mut agv = Agv::<()>::new([0, 0]);
        for far in [i64::MAX, i64::MIN, 10_001] {
            assert_eq!(agv.go_to(&position([0, far]), None), Err(ServiceError::Failed(OUT_OF_THE_WAREHOUSE)));
        }
        assert_eq!(agv.target(), None);
    }

    #[test]
    fn a_reset_waits_for_the_bumper() {
        let mut agv = Agv::<()>::new([0, 0]);
        agv.set_bumper(true);
        assert_eq!(agv.reset(), Err(ServiceError::Failed(BUMPER_IS_PRESSED)));
        agv.set_bumper(false);
        assert_eq!(agv.reset(), Ok(()));
    }

    #[test]
    fn driving_costs_charge() {
        let mut charge = Parameters::new();
        charge.add_float("charge", 1).unwrap();
        let mut agv = driving_to([5, 0]);
        while agv.step(TICK, true) != Some(Progress::Arrived(Place::at([5, 0]))) {}
        agv.battery(&mut charge).unwrap();
        assert_eq!(charge.variable::<f64>("charge"), Ok(99.9));
    }
}
