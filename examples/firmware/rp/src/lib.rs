//! What boards with Raspberry Pi's RP2040 or RP2350 need below embassy: network, button, LED, motors, watchdog, and the
//! settings in their flash. What the vehicle does is in `cara_vehicle`.
//!
//! [`Board`] is the same whatever the network: a W5500 on SPI, or the radio of a Pico 2 W.

#![no_std]

#[cfg(feature = "pico2w")]
#[path = "board/pico2w.rs"]
pub mod board;
#[cfg(not(feature = "pico2w"))]
#[path = "board/w5500.rs"]
pub mod board;
mod motor;
pub mod parts;
mod reset;
pub mod settings;

pub use board::Board;

defmt::timestamp!("{=u64:us}", embassy_time::Instant::now().as_micros());
