//! A vehicle of the warehouse, and what the units there offer each other: the names and types of all functions and streams.

mod body;
mod motor;
mod vehicle;

use core::fmt;
use core::time::Duration;

use cara_core::error::ServiceError;
use cara_core::{AnyCall, Variables, interface};

pub use body::{Body, RAMP};
pub use motor::{Cause, Motor, Stop, TICK, Turned};
pub use vehicle::{Entered, Vehicle};

/// How long a vehicle drives on after its manager's last sign that it wants it, in milliseconds.
pub const LEASE_MS: u64 = 400;

/// The stream of where a vehicle is: [`Pose`].
pub const POSE: &str = "pose";
/// Its values are so far apart, at least.
pub const POSE_EVERY: Duration = Duration::from_millis(50);
/// The stream of how full a vehicle's battery is: [`Charge`].
pub const CHARGE: &str = "charge";
/// Its values are so far apart, at least.
pub const CHARGE_EVERY: Duration = Duration::from_secs(1);
/// Stops a vehicle, until it is reset.
pub const STOP: &str = "stop()";

/// Codes with which a vehicle refuses a call.
pub mod refusal {
    /// The cell is not beside its own, or it stands between two others.
    pub const NOT_BESIDE: u16 = 1;
    /// It moves, or stands between cells.
    pub const MOVES: u16 = 2;
    /// It has another parcel, or none.
    pub const OTHER_PARCEL: u16 = 3;
    /// It has a fault that is not mended.
    pub const FAULTY: u16 = 4;
}

/// Why a vehicle inhibits its own drive: it has a fault.
pub const FAULT: u16 = 1;

/// A cell of the floor; x to the right, y down, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Cell {
    /// The column.
    pub x: u16,
    /// The row.
    pub y: u16,
}

impl Cell {
    /// As variables of calls have it.
    pub const fn numbers(self) -> [i64; 2] {
        [self.x as i64, self.y as i64]
    }

    /// From variables of calls.
    pub fn of_numbers([x, y]: [i64; 2]) -> Option<Self> {
        Some(Self { x: x.try_into().ok()?, y: y.try_into().ok()? })
    }

    /// Cells between the two as a vehicle drives.
    pub const fn distance(self, other: Self) -> u32 {
        self.x.abs_diff(other.x) as u32 + self.y.abs_diff(other.y) as u32
    }
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{},{}", self.x, self.y)
    }
}

impl core::str::FromStr for Cell {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let (x, y) = text.split_once(',').ok_or(())?;
        Ok(Self { x: x.parse().map_err(drop)?, y: y.parse().map_err(drop)? })
    }
}

/// All that a manager has to know of a vehicle before it commands it.
#[derive(Variables, Clone, Copy, Debug, Default, PartialEq)]
pub struct Place {
    /// The cell that it is in, or leaves.
    pub at: [i64; 2],
    /// The cell that it enters; `at` where it enters none.
    pub next: [i64; 2],
    /// The moves that it has begun in its life.
    pub moves: i64,
    /// It does not move, and no order lets it.
    pub stands: bool,
    /// The order whose parcel it has; 0 for none.
    pub carries: i64,
    /// The order whose parcel it has put down last; 0 for none.
    pub delivered: i64,
    /// Of a full battery.
    #[unit = "%"]
    pub charge: f64,
}

/// Where a vehicle is.
#[derive(Variables, Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// The middle of its body.
    #[unit = "cells"]
    pub position: [f64; 2],
    /// As [`Place`] has it.
    pub at: [i64; 2],
    /// As [`Place`] has it.
    pub next: [i64; 2],
    /// As [`Place`] has it.
    pub moves: i64,
    /// As [`Place`] has it.
    pub stands: bool,
}

impl Pose {
    /// What is told of a place.
    pub const fn of(position: [f64; 2], &Place { at, next, moves, stands, .. }: &Place) -> Self {
        Self { position, at, next, moves, stands }
    }
}

/// How full a vehicle's battery is.
#[derive(Variables, Clone, Copy, Debug, Default, PartialEq)]
pub struct Charge {
    /// Of a full one.
    #[unit = "%"]
    pub percent: f64,
}

/// What a vehicle does.
#[interface]
pub trait Transport {
    /// What its port knows an order by.
    type Order;

    /// Drives into a cell beside its own, while its caller wants it. The number of this move.
    #[actuator(drive)]
    #[lease(ms = 400)]
    #[returns(moves)]
    fn advance(
        &mut self,
        call: &impl AnyCall<Order = Self::Order>,
        #[unit = "cells"] cell: [i64; 2],
    ) -> Result<i64, ServiceError>;

    /// Tells where it is, and what it carries.
    #[idempotent]
    fn place(&mut self) -> Place;

    /// Takes the parcel of an order, where it stands.
    #[idempotent]
    fn load(&mut self, order: i64) -> Result<(), ServiceError>;

    /// Puts the parcel of an order down, where it stands.
    #[idempotent]
    fn unload(&mut self, order: i64) -> Result<(), ServiceError>;

    /// Lets it drive again. With a fault it does not, unless a mechanic has mended it.
    #[actuator(drive)]
    #[reset]
    #[idempotent]
    fn reset(&mut self, mended: bool) -> Result<(), ServiceError>;
}

/// What stops a vehicle. One offers it by its text, [`STOP`]: an emergency waits for no state, and this one has to tell the
/// motors' loop when it came.
#[interface]
pub trait Brake {
    /// Stops it, until it is reset.
    #[priority(emergency)]
    #[actuator(drive)]
    #[stop]
    #[idempotent]
    fn stop();
}

/// What the mechanic offers.
#[interface]
pub trait Workshop {
    /// Calls the mechanic to a vehicle, and tells in how many seconds it will be mended.
    #[idempotent]
    #[returns(#[unit = "s"] seconds)]
    fn call_mechanic(&mut self, #[size(32)] vehicle: &str, fault: u16) -> i64;
}

/// What a manager offers to the mechanic.
#[interface]
pub trait Floor {
    /// A vehicle has been mended.
    #[idempotent]
    fn mended(&mut self, #[size(32)] vehicle: &str);
}
