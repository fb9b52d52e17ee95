//! What Arm's board MPS2 with the image AN386 needs below embassy: Ethernet controller, clock, faults, watchdog and motors; the rest
//! is that of every emulated board. It exists for QEMU's sake: a Cortex-M4F on which firmware is tested, with another controller than
//! lm3s6965evb.
//!
//! "CMSDK" is Arm DDI 0479, *Cortex-M System Design Kit Technical Reference Manual*; "board" is Arm DAI 0386, *Application Note
//! AN386*; register names are as there.

#![no_std]

pub mod clock;
pub mod ethernet;
mod fault;
mod interrupt;
pub mod motor;
mod register;
pub mod reset;
pub mod watchdog;
pub mod wiring;

/// Guards the stack, starts the clock and paints the stack; call it first, once.
pub fn start() {
    cara_emulated::stack::paint();
    if let Some(mut peripherals) = cortex_m::Peripherals::take() {
        fault::guard_stack(&mut peripherals.MPU);
        clock::start(&mut peripherals.SYST);
    }
}

#[cfg(feature = "defmt")]
use defmt_semihosting as _;
#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", embassy_time::Instant::now().as_micros());
