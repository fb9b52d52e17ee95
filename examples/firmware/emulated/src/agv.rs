//! The AGV of the examples on an emulated board. A timer presses its button.

use cara_board::Reason;
use cara_embassy::Transport;
use cara_settings::Settings;
use cara_vehicle::tasks::{self, NO_ROOM};
use cara_vehicle::{Vehicle, call_mechanic, info};
use embassy_executor::Spawner;
use embassy_time::{Duration, Timer};

use crate::arguments::{self, ArgumentError};
use crate::{executor, stack};

/// How often the timer presses the button.
const PRESSED_EVERY: Duration = Duration::from_secs(10);

/// Runs the AGV, for ever: says whether the motors were on, and why the board started, with the line or address where it had
/// ended. A board brings its network, which gets a seed of random numbers, and its watchdog.
pub fn run<N: Transport>(
    motors: bool,
    (reason, place): (Reason, u32),
    network: impl FnOnce(Spawner, &Settings, u64) -> Result<N, &'static str>,
    watchdog: impl FnOnce(),
) -> ! {
    let motors = if motors { "on" } else { "off" };
    info!("started because of {}, with the motors {=str}", reason, motors);
    if place != 0 {
        info!("it ended at line or address {=u32:#x}", place);
    }
    executor::run(|spawner| spawn(spawner, network, watchdog))
}

/// Not merged into `run`: what it needs of the stack is free again once the tasks run.
#[inline(never)]
fn spawn<N: Transport>(
    spawner: Spawner,
    network: impl FnOnce(Spawner, &Settings, u64) -> Result<N, &'static str>,
    watchdog: impl FnOnce(),
) -> Result<(), &'static str> {
    let given = arguments::read().map_err(ArgumentError::text)?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let network = network(spawner, &settings, noise)?;
    let vehicle = tasks::start(spawner, network, &settings, security)?;
    #[cfg(feature = "faults")]
    crate::faults::offer(vehicle).map_err(|_| "no room for the test's functions")?;
    #[cfg(feature = "lists")]
    crate::lists::offer(vehicle).map_err(|_| "no room for the test's function with lists")?;
    #[cfg(feature = "logs")]
    spawner.spawn(crate::logs::send(vehicle).map_err(|_| NO_ROOM)?);
    #[cfg(all(feature = "faults", feature = "logs"))]
    spawner.spawn(crate::logs::chatter().map_err(|_| NO_ROOM)?);
    spawner.spawn(button(vehicle).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    #[cfg(feature = "faults")]
    spawner.spawn(crate::faults::starve().map_err(|_| NO_ROOM)?);
    #[cfg(feature = "faults")]
    for _ in 0..2 {
        spawner.spawn(crate::creep::take(vehicle).map_err(|_| NO_ROOM)?);
    }
    watchdog();
    Ok(())
}

#[embassy_executor::task]
async fn button(vehicle: Vehicle) -> ! {
    call_mechanic(vehicle, async || Timer::after(PRESSED_EVERY).await).await
}
