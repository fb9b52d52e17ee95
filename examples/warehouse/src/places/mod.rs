//! Shared places: a gate, a lift or a crossing that vehicles of several managers enter, one at a time.
//!
//! An m_unit offers them ([`Places`]); each vehicle's manager asks it for a [`Pass`] before it lets the vehicle in
//! ([`SharedPlace`]). Who may be in a place is on disk before a manager hears of it. A place becomes free only when a manager
//! passes on that the vehicle with the newest pass has left, or when an operator has looked and releases it.
//!
//! A pass has a lease, which the manager renews while it is linked to the vehicle. Without renewals the place is blocked: as
//! closed to other vehicles as before, but visible, and open to the vehicle's next manager and to an operator.
//!
//! What is not promised: a manager that says of its vehicle that it has left, although it has not, is believed.

mod host;
mod record;
mod user;

use cara_std::{AnyCall, LeaseWatch, ServiceError, Variables, interface};

pub use host::{OpenError, Options, Places, run};
pub use record::{Occupant, Record, Refused};
pub use user::{Pass, SharedPlace};

/// A pass that is not renewed for so long is no longer live, in milliseconds. Nothing moves by it.
pub const LEASE_MS: u64 = 1_000;

/// Codes with which the unit of the places refuses a call.
pub mod refusal {
    /// Another vehicle may be in it.
    pub const TAKEN: u16 = 1;
    /// A newer pass was given.
    pub const OLD_PASS: u16 = 2;
    /// There is no such place.
    pub const NO_PLACE: u16 = 3;
    /// What names the vehicle is no full name, as `agv-1/101`.
    pub const NO_VEHICLE: u16 = 4;
    /// The vehicle's manager may still let it in, and gives the place back.
    pub const LIVE: u16 = 5;
    /// The record could not be written; the call may count all the same.
    pub const NOT_KEPT: u16 = 6;
}

/// A place as its unit describes it.
#[derive(Variables, Clone, Debug, Default, PartialEq, Eq)]
pub struct Shown {
    /// `free`, `held` by a vehicle whose manager renews its pass, or `blocked`.
    #[size(8)]
    pub state: String,
    /// Who may be in it: [`Occupant`] as text.
    #[size(64)]
    pub occupant: String,
}

/// What the unit of the places offers beside `enter_PLACE(vehicle) -> (pass)`, which is leased, a function for each place.
#[interface]
pub trait Shared {
    /// Describes a place.
    #[idempotent]
    fn place(&mut self, #[size(32)] place: &str) -> Result<Shown, ServiceError>;

    /// A vehicle has left, by its own position, and no order lets it in again.
    #[idempotent]
    fn left(&mut self, #[size(32)] place: &str, #[size(64)] vehicle: &str, pass: i64) -> Result<(), ServiceError>;

    /// An operator has looked: the occupant that blocks the place is not in it. Refused until two leases after the last order.
    fn release(
        &mut self,
        call: &impl AnyCall<Order = LeaseWatch>,
        #[size(32)] place: &str,
        #[size(64)] occupant: &str,
        #[size(128)] reason: &str,
    ) -> Result<(), ServiceError>;
}
