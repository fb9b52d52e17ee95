//! CARA core.
#![no_std]

#[cfg(test)]
extern crate std;

mod bytes;
pub mod config;
pub mod counters;
pub mod error;
#[macro_use]
mod fmt;
pub mod random;
pub mod storage;
pub mod time;

pub mod distribution;
pub mod host;
pub mod services;
