//! Errors as the standard names them, with their references (2.1: 6.6.4, 6.10.5, 7.1).
//!
//! 2.0 and 2.1 have the same names. 2.0's sentence that an `orderError` "must not be reported until" a new order is read as 2.1 has
//! it, without the *not*.

use crate::message::{Error, ErrorLevel, Reference};

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A message is malformed, of another vehicle, retained or too old (6.6.4.1).
    Validation,
    /// An order or an action that this vehicle cannot execute, or not now (6.6.4.2, figure 8).
    Order,
    /// An update that does not continue the order (6.6.4.3, figure 8).
    OrderUpdate,
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
}

impl Kind {
    /// The `errorType`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Validation => "validationError",
            Self::Order => "orderError",
            Self::OrderUpdate => "orderUpdateError",
            Self::NoOrderToCancel => "noOrderToCancel",
            Self::Action => "actionError",
            Self::VehicleStopped => "vehicleStopped",
            Self::CertificateExpires => "certificateExpires",
            Self::OutOfService => "outOfService",
            Self::BrokerLost => "brokerLost",
        }
    }

    const fn level(self) -> ErrorLevel {
        match self {
            Self::VehicleStopped | Self::OutOfService => ErrorLevel::Fatal,
            _ => ErrorLevel::Warning,
        }
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
    pub fn error(&self) -> Error {
        let reference = |(key, value): &(&str, String)| Reference {
            reference_key: (*key).to_owned(),
            reference_value: value.clone(),
        };
        Error {
            error_type: self.kind.name().to_owned(),
            error_level: self.kind.level(),
            error_references: Some(self.references.iter().map(reference).collect()),
            error_description: Some(self.text.clone()),
            error_hint: None,
        }
    }
}
