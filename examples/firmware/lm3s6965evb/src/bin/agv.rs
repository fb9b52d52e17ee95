//! The AGV of the examples on the emulated board. A timer presses its button.

#![no_std]
#![no_main]

use cara_lm3s6965evb::arguments::{self, ArgumentError};
use cara_lm3s6965evb::wiring::{self, NO_ROOM, Sockets};
use cara_lm3s6965evb::{executor, motor, reset, stack, start, watchdog};
use cara_vehicle::{LIMITS, Vehicle, tasks};
use embassy_executor::Spawner;
use embassy_time::{Duration, Timer};
use static_cell::ConstStaticCell;

/// How often the timer presses the button.
const PRESSED_EVERY: Duration = Duration::from_secs(10);

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
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
    static SOCKETS: ConstStaticCell<Sockets<{ LIMITS.sockets() }>> = ConstStaticCell::new(Sockets::new());
    let given = arguments::read().map_err(ArgumentError::text)?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let network = wiring::network(spawner, &settings, SOCKETS.take(), noise)?;
    let vehicle = tasks::start(spawner, network, &settings, security)?;
    #[cfg(feature = "faults")]
    cara_lm3s6965evb::faults::offer(vehicle).map_err(|_| "no room for the test's functions")?;
    #[cfg(feature = "lists")]
    cara_lm3s6965evb::lists::offer(vehicle).map_err(|_| "no room for the test's function with lists")?;
    #[cfg(feature = "logs")]
    spawner.spawn(cara_emulated::logs::send(vehicle).map_err(|_| NO_ROOM)?);
    #[cfg(all(feature = "faults", feature = "logs"))]
    spawner.spawn(cara_emulated::logs::chatter().map_err(|_| NO_ROOM)?);
    spawner.spawn(button(vehicle).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    #[cfg(feature = "faults")]
    spawner.spawn(cara_lm3s6965evb::faults::starve().map_err(|_| NO_ROOM)?);
    #[cfg(feature = "faults")]
    for _ in 0..2 {
        spawner.spawn(cara_lm3s6965evb::creep::take(vehicle).map_err(|_| NO_ROOM)?);
    }
    watchdog::start();
    Ok(())
}

#[embassy_executor::task]
async fn button(vehicle: Vehicle) -> ! {
    cara_vehicle::call_mechanic(vehicle, async || Timer::after(PRESSED_EVERY).await).await
}
