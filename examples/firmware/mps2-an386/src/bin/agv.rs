//! The AGV of the examples on the board. A timer presses its button.

#![no_std]
#![no_main]

use cara_emulated::arguments::{self, ArgumentError};
use cara_emulated::{executor, stack};
use cara_mps2_an386::{motor, reset, start, watchdog, wiring};
use cara_vehicle::tasks::{self, NO_ROOM};
use cara_vehicle::{LIMITS, Vehicle};
use embassy_executor::Spawner;
use embassy_net::StackResources;
use embassy_time::{Duration, Timer};
use static_cell::ConstStaticCell;

/// How often the timer presses the button.
const PRESSED_EVERY: Duration = Duration::from_secs(10);

#[cortex_m_rt::entry]
fn main() -> ! {
    start();
    let motors = if motor::start() { "on" } else { "off" };
    let (reason, place) = reset::reason();
    cara_vehicle::info!("started because of {}, with the motors {=str}", reason, motors);
    if place != 0 {
        cara_vehicle::info!("it ended at line or address {=u32:#x}", place);
    }
    executor::run(spawn)
}

/// Not merged into `main`: what it needs of the stack is free again once the tasks run.
#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static SOCKETS: ConstStaticCell<StackResources<{ LIMITS.sockets() }>> = ConstStaticCell::new(StackResources::new());
    let given = arguments::read().map_err(ArgumentError::text)?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let network = wiring::network(spawner, &settings, SOCKETS.take(), noise)?;
    let vehicle = tasks::start(spawner, network, &settings, security)?;
    #[cfg(feature = "faults")]
    cara_emulated::faults::offer(vehicle).map_err(|_| "no room for the test's functions")?;
    #[cfg(feature = "lists")]
    cara_emulated::lists::offer(vehicle).map_err(|_| "no room for the test's function with lists")?;
    spawner.spawn(button(vehicle).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    #[cfg(feature = "faults")]
    spawner.spawn(cara_emulated::faults::starve().map_err(|_| NO_ROOM)?);
    #[cfg(feature = "faults")]
    for _ in 0..2 {
        spawner.spawn(cara_emulated::creep::take(vehicle).map_err(|_| NO_ROOM)?);
    }
    watchdog::start();
    Ok(())
}

#[embassy_executor::task]
async fn button(vehicle: Vehicle) -> ! {
    cara_vehicle::call_mechanic(vehicle, async || Timer::after(PRESSED_EVERY).await).await
}
