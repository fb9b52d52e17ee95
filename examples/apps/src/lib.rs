//! The logic of the examples, once, for every port: no socket, no thread and no clock. The binaries beside this crate are
//! wiring only.
//!
//! Services take [`ParametersView`](cara_core::distribution::parameters::ParametersView) in place or
//! [`Parameters`](cara_core::distribution::parameters::Parameters) by value, as methods of the application's type.

#![no_std]

pub mod agv;
pub mod depot;
pub mod mechanic;
pub mod telemetry;
pub mod warehouse;
