//! What ST's Nucleo-144 boards with a Cortex-M7 need below embassy: clocks, Ethernet, button, LED, motors, watchdog,
//! and the settings in their flash. What the vehicle does is in `cara_vehicle`.
//!
//! Caches stay off, as the processor starts, because the Ethernet driver does not clean or invalidate any; see
//! `docs/boards.md` before switching them on.

#![no_std]

pub mod board;
mod clocks;
mod motor;
mod reset;
pub mod settings;

pub use board::Board;

defmt::timestamp!("{=u64:us}", embassy_time::Instant::now().as_micros());
