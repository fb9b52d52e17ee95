//! What the boards that QEMU emulates have in common: settings from QEMU's arguments, a file of the host in place of flash, clock,
//! executor, Ethernet driver, the AGV's image, stack paint, access to registers, and services for tests. A board adds its controller, timers, pins and watchdog.

#![no_std]

#[cfg(feature = "agv")]
pub mod agv;
pub mod arguments;
#[cfg(feature = "secure")]
mod boots;
pub mod clock;
#[cfg(feature = "faults")]
pub mod creep;
#[cfg(feature = "net")]
pub mod ethernet;
pub mod executor;
#[cfg(feature = "faults")]
pub mod faults;
#[cfg(feature = "lists")]
pub mod lists;
#[cfg(feature = "logs")]
pub mod logs;
pub mod register;
pub mod stack;

use embassy_time::Duration;

/// How often the motors' interrupt looks.
pub const TICK: Duration = Duration::from_millis(1);

/// Whether the motors may run now, for their interrupt.
pub fn may_move() -> bool {
    #[cfg(feature = "faults")]
    if creep::may_move() {
        return true;
    }
    cara_vehicle::may_move()
}
