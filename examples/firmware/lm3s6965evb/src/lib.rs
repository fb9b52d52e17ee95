//! What the board lm3s6965evb needs below embassy: Ethernet controller, serial line, clock, faults, watchdog and motors; the rest is
//! that of every emulated board. The board exists for QEMU's sake: an emulated Cortex-M3 on which firmware is tested.
//!
//! "Data sheet" is Texas Instruments, *Stellaris LM3S6965 Microcontroller*, DS-LM3S6965; register names are as there.

#![no_std]

pub mod clock;
#[cfg(feature = "net")]
pub mod ethernet;
pub mod fault;
pub mod motor;
mod register;
pub mod reset;
#[cfg(any(feature = "line", feature = "slip"))]
pub mod uart;
pub mod watchdog;
pub mod wiring;

#[cfg(feature = "lists")]
pub use cara_emulated::lists;
pub use cara_emulated::{arguments, executor, stack};
#[cfg(feature = "faults")]
pub use cara_emulated::{creep, faults};

/// Starts the clock and paints the stack; call it first, once.
///
/// The core's peripherals, for a program that needs more of them; `None` if they were taken before.
pub fn start() -> Option<cortex_m::Peripherals> {
    stack::paint();
    let mut peripherals = cortex_m::Peripherals::take()?;
    clock::start(&mut peripherals.SYST);
    Some(peripherals)
}

#[cfg(all(feature = "defmt", not(feature = "logs")))]
use defmt_semihosting as _;
#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", embassy_time::Instant::now().as_micros());
