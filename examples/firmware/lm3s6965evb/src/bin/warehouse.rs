//! A vehicle of `examples/warehouse` on the emulated board. Lines of what really happens go to standard error, behind the
//! board's time in microseconds: `12345678 enter 3,4`.

#![no_std]
#![no_main]

use core::fmt;

use cara_embassy::Runner as UnitRunner;
use cara_lm3s6965evb::arguments::{self, ArgumentError};
use cara_lm3s6965evb::wiring::{self, NO_ROOM, Sockets};
use cara_lm3s6965evb::{executor, motor, stack, start, watchdog};
use cara_vehicle::LIMITS;
use cara_vehicle::warehouse::{self, Agv, Vehicle, VehicleResources};
use embassy_executor::Spawner;
use static_cell::{ConstStaticCell, StaticCell};

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
    motor::start();
    executor::run(spawn)
}

/// Not merged into `main`: what it needs of the stack is free again once the tasks run.
#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static SOCKETS: ConstStaticCell<Sockets<{ LIMITS.sockets() }>> = ConstStaticCell::new(Sockets::new());
    static RESOURCES: StaticCell<VehicleResources> = StaticCell::new();
    let given = arguments::read().map_err(ArgumentError::text)?;
    let at = given.at.ok_or("at=X,Y is not told, the cell in which it stands")?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let network = wiring::network(spawner, &settings, SOCKETS.take(), noise)?;
    let resources = RESOURCES.init_with(VehicleResources::new);
    let made = warehouse::vehicle(network, resources, &settings, security, at, note);
    let (vehicle, unit_runner) = made.map_err(|_| "the settings are of no vehicle")?;
    cara_vehicle::info!("{=str}/{=u32}", settings.identity.name(), settings.identity.id());
    spawner.spawn(unit(unit_runner).map_err(|_| NO_ROOM)?);
    spawner.spawn(drive(vehicle).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    watchdog::start();
    Ok(())
}

/// To the host, at once.
fn note(what: fmt::Arguments<'_>) {
    semihosting::eprintln!("{} {what}", embassy_time::Instant::now().as_micros());
}

#[embassy_executor::task]
async fn unit(mut runner: UnitRunner<Agv>) -> ! {
    cara_board::watched(runner.run()).await
}

#[embassy_executor::task]
async fn drive(vehicle: Vehicle) -> ! {
    warehouse::drive(vehicle).await
}
