//! Errors as the standard names them, with their references (2.1: 6.6.4, 6.10.5, 7.1; 3.0: 6.6.5.4).
//!
//! 2.0 and 2.1 have the same names. 2.0's sentence that an `orderError` "must not be reported until" a new order is read as 2.1 has
//! it, without the *not*.

use crate::message::{Error, ErrorLevel, Reference};
use crate::version::Version;

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A message is malformed, of another vehicle, retained or too old (6.6.4.1).
    Validation,
    /// An identifier, a name or parameters are too long, or have control characters.
    Text,
    /// An order has a member that this vehicle cannot use (6.6.4.2).
    Unsupported,
    /// A node has no position, and the vehicle needs it; or the vehicle refuses to drive to it behind those that it has.
    NoWay,
    /// A node is on a map that the vehicle does not have.
    UnknownMap,
    /// An order has an action that the vehicle does not have there.
    OrderAction,
    /// An action at once that the vehicle does not have, or not now.
    InstantAction,
    /// More nodes or actions than are held.
    Space,
    /// Another order is being executed (figure 8, box 3).
    OtherOrder,
    /// The vehicle is not at the first node (figure 8, box 4; in 3.0 box 5).
    OutOfRange,
    /// The vehicle is not in an automatic mode, or not linked.
    NotAvailable,
    /// A late copy of an order; in 3.0 also a new order whose update is not 0 (box 4).
    Replaced,
    /// A lower update than the last one (6.6.4.3, figure 8).
    Outdated,
    /// The same update with other content, which 2.x ignores.
    SameUpdate,
    /// An update of a cancelled order.
    Cancelled,
    /// An update that does not continue the order (figure 8).
    NoContinuation,
    /// `cancelOrder` without an order (6.6.3.2).
    NoOrderToCancel,
    /// An action failed, or nobody knows whether it ran. The standard has no name for it.
    Action,
    /// The vehicle's drive is stopped and waits for a reset. The standard has no name for it.
    VehicleStopped,
    /// The client's or the broker's certificate expires soon. The standard has no name for it.
    CertificateExpires,
    /// The gateway cannot read the vehicle's record. The standard has no name for it.
    OutOfService,
    /// The order's end was not reached while the broker was away, by the configured limit. The standard has no name for it.
    BrokerLost,
    /// The vehicle does not take the stretch that it is told to drive. The standard has no name for it.
    DriveRefused,
}

/// A kind's name and level in 2.x, and in 3.0 (6.6.5.4).
type Row = (Kind, [(&'static str, ErrorLevel); 2]);

/// `INVALID_ORDER` is in 3.0's list of words (7.8) only: its clauses have no name for what it stands for here.
#[rustfmt::skip]
const ROWS: [Row; 23] = {
    use ErrorLevel::{Critical, Fatal, Urgent, Warning};
    [
        (Kind::Validation, [("validationError", Warning), ("VALIDATION_FAILURE", Warning)]),
        (Kind::Text, [("orderError", Warning), ("VALIDATION_FAILURE", Warning)]),
        (Kind::Unsupported, [("orderError", Warning), ("UNSUPPORTED_PARAMETER", Critical)]),
        (Kind::NoWay, [("orderError", Warning), ("NO_ROUTE_TO_TARGET", Warning)]),
        (Kind::UnknownMap, [("orderError", Warning), ("UNKNOWN_MAP_ID", Warning)]),
        (Kind::OrderAction, [("orderError", Warning), ("INVALID_ORDER_ACTION", Warning)]),
        (Kind::InstantAction, [("orderError", Warning), ("INVALID_INSTANT_ACTION", Warning)]),
        (Kind::Space, [("orderError", Warning), ("INSUFFICIENT_MEMORY", Urgent)]),
        (Kind::OtherOrder, [("orderError", Warning), ("OTHER_ORDER_ACTIVE", Warning)]),
        (Kind::OutOfRange, [("orderError", Warning), ("START_NODE_OUT_OF_RANGE", Warning)]),
        (Kind::NotAvailable, [("orderError", Warning), ("MOBILE_ROBOT_NOT_AVAILABLE", Warning)]),
        (Kind::Replaced, [("orderError", Warning), ("INVALID_ORDER", Warning)]),
        (Kind::Outdated, [("orderUpdateError", Warning), ("OUTDATED_ORDER_UPDATE", Warning)]),
        (Kind::SameUpdate, [("orderUpdateError", Warning), ("SAME_ORDER_UPDATE_ID", Warning)]),
        (Kind::Cancelled, [("orderUpdateError", Warning), ("ORDER_UPDATE_FOLLOWING_CANCEL", Warning)]),
        (Kind::NoContinuation, [("orderUpdateError", Warning), ("INVALID_ORDER", Warning)]),
        (Kind::NoOrderToCancel, [("noOrderToCancel", Warning), ("NO_ORDER_TO_CANCEL", Warning)]),
        (Kind::Action, [("actionError", Warning), ("ACTION_ERROR", Urgent)]),
        (Kind::VehicleStopped, [("vehicleStopped", Fatal), ("VEHICLE_STOPPED", Fatal)]),
        (Kind::CertificateExpires, [("certificateExpires", Warning), ("CERTIFICATE_EXPIRES", Warning)]),
        (Kind::OutOfService, [("outOfService", Fatal), ("OUT_OF_SERVICE", Fatal)]),
        (Kind::BrokerLost, [("brokerLost", Warning), ("BROKER_LOST", Urgent)]),
        (Kind::DriveRefused, [("driveRefused", Warning), ("DRIVE_REFUSED", Urgent)]),
    ]
};

impl Kind {
    /// All of them.
    pub fn all() -> impl Iterator<Item = Self> {
        ROWS.iter().map(|(kind, _)| *kind)
    }

    const fn row(self, version: Version) -> (&'static str, ErrorLevel) {
        ROWS[self as usize].1[version as usize]
    }

    /// The `errorType`.
    pub const fn name(self, version: Version) -> &'static str {
        self.row(version).0
    }

    /// The `errorLevel`.
    pub const fn level(self, version: Version) -> ErrorLevel {
        self.row(version).1
    }

    /// Whether an error is one of this kind, whatever version it was said in: a record may be older than the version.
    pub fn is_of(self, error: &Error) -> bool {
        Version::ALL.iter().any(|version| error.error_type == self.name(*version))
    }

    /// Whether an error lasts until an action at once is taken (3.0).
    pub fn is_of_instant_action(error: &Error) -> bool {
        error.error_type == Self::InstantAction.name(Version::V3)
    }

    /// Whether an error lasts until an order or an update is taken.
    pub fn ends_with_an_order(error: &Error) -> bool {
        let of_orders = |(kind, _): &&Row| (*kind as usize) <= Self::NoOrderToCancel as usize;
        !Self::is_of_instant_action(error) && ROWS.iter().filter(of_orders).any(|(kind, _)| kind.is_of(error))
    }
}

/// Why something is not done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Its name.
    pub kind: Kind,
    /// For people.
    pub text: String,
    /// What it is about.
    pub references: Vec<(&'static str, String)>,
}

impl Refusal {
    /// Without references.
    pub fn new(kind: Kind, text: impl Into<String>) -> Self {
        Self { kind, text: text.into(), references: Vec::new() }
    }

    /// With one more reference (7.1).
    pub fn about(mut self, key: &'static str, value: impl ToString) -> Self {
        self.references.push((key, value.to_string()));
        self
    }

    /// As the state reports it.
    pub fn error(&self, version: Version) -> Error {
        let reference = |(key, value): &(&str, String)| Reference {
            reference_key: (*key).to_owned(),
            reference_value: value.clone(),
        };
        Error {
            error_type: self.kind.name(version).to_owned(),
            error_level: self.kind.level(version),
            error_references: Some(self.references.iter().map(reference).collect()),
            error_description: Some(self.text.clone()),
            error_hint: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Kind, ROWS};

    #[test]
    fn rows_are_in_the_order_of_their_kinds() {
        assert!(ROWS.iter().enumerate().all(|(index, (kind, _))| *kind as usize == index));
        assert_eq!(Kind::DriveRefused as usize + 1, ROWS.len());
    }
}
