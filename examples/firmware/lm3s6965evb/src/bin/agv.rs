//! The AGV of the examples on the emulated board. A timer presses its button.

#![no_std]
#![no_main]

use cara_embassy::Runner as UnitRunner;
use cara_lm3s6965evb::arguments::{self, ArgumentError};
use cara_lm3s6965evb::ethernet::Ethernet;
use cara_lm3s6965evb::{executor, fault, motor, reset, stack, start, watchdog};
use cara_vehicle::{Agv, LIMITS, Vehicle, VehicleResources};
use embassy_executor::Spawner;
use embassy_net::{Runner, StackResources};
use embassy_time::{Duration, Timer};
use static_cell::{ConstStaticCell, StaticCell};

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
    executor::run(|spawner| {
        if let Err(text) = spawn(spawner) {
            cara_vehicle::error!("{=str}", text);
            semihosting::process::exit(fault::NOT_STARTED)
        }
    })
}

/// Not merged into `main`: what it needs of the stack is free again once the tasks run.
#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static ETHERNET: ConstStaticCell<Ethernet> = ConstStaticCell::new(Ethernet::new());
    static SOCKETS: ConstStaticCell<StackResources<{ LIMITS.sockets() }>> = ConstStaticCell::new(StackResources::new());
    static RESOURCES: StaticCell<VehicleResources> = StaticCell::new();
    const NO_ROOM: &str = "no room for a task";
    let given = arguments::read().map_err(ArgumentError::text)?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let ethernet = ETHERNET.take();
    ethernet.start();
    let sockets = SOCKETS.take();
    let (stack, network_runner) = embassy_net::new(ethernet, cara_vehicle::network(&settings), sockets, noise);
    let resources = RESOURCES.init_with(VehicleResources::new);
    let made = cara_vehicle::vehicle(stack, resources, &settings, security);
    let (vehicle, unit_runner) = made.map_err(|_| "the settings are of no vehicle")?;
    #[cfg(feature = "faults")]
    cara_lm3s6965evb::faults::offer(vehicle).map_err(|_| "no room for the test's functions")?;
    #[cfg(feature = "lists")]
    cara_lm3s6965evb::lists::offer(vehicle).map_err(|_| "no room for the test's function with lists")?;
    cara_vehicle::info!("{=str}/{=u32}", settings.identity.name(), settings.identity.id());
    spawner.spawn(network(network_runner).map_err(|_| NO_ROOM)?);
    spawner.spawn(unit(unit_runner).map_err(|_| NO_ROOM)?);
    spawner.spawn(drive(vehicle).map_err(|_| NO_ROOM)?);
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
async fn network(mut runner: Runner<'static, &'static mut Ethernet>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn unit(mut runner: UnitRunner<Agv>) -> ! {
    cara_board::watched(runner.run()).await
}

#[embassy_executor::task]
async fn drive(vehicle: Vehicle) -> ! {
    cara_vehicle::drive(vehicle).await
}

#[embassy_executor::task]
async fn button(vehicle: Vehicle) -> ! {
    cara_vehicle::call_mechanic(vehicle, async || Timer::after(PRESSED_EVERY).await).await
}
