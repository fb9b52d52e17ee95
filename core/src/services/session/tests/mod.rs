//! What a session promises, one behaviour per test, on two sessions joined in memory.
#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

mod access;
mod acts;
mod actuators;
mod chaos;
mod delivery;
#[cfg(feature = "details")]
mod details;
mod ends;
mod gathering;
#[cfg(feature = "hand-over")]
mod handing;
mod hearts;
mod hello;
mod hostile;
mod latches;
mod leases;
mod limits;
mod lines;
mod lists;
mod liveness;
mod net;
mod orders;
mod overtaking;
mod pair;
mod requests;
#[cfg(feature = "scheduling")]
mod scheduling;
mod serving;
mod setup;
mod side;
mod stops;
#[cfg(feature = "streams")]
mod streams;
mod yielding;

use std::boxed::Box;
use std::string::String;

use crate::distribution::parameters::ParametersView;
use side::Arguments;

/// Parameters filled by `build`.
fn parameters(build: impl FnOnce(&mut ParametersView)) -> Arguments {
    let mut parameters: Arguments = Box::default();
    build(&mut *parameters);
    parameters
}

/// No parameters.
fn none() -> Arguments {
    parameters(|_| ())
}

/// One integer named `x`.
fn x(value: i64) -> Arguments {
    parameters(|parameters| {
        parameters.add_int("x", 1).unwrap();
        parameters.set_value("x", value).unwrap();
    })
}

/// One text named `text` of `length` characters, with capacity for 20,000.
fn text(length: usize) -> Arguments {
    let content: String = (0..length).map(|at| char::from(b'a' + (at % 23) as u8)).collect();
    parameters(|parameters| {
        parameters.add_string("text", 20_000).unwrap();
        parameters.set_value("text", content.as_str()).unwrap();
    })
}
