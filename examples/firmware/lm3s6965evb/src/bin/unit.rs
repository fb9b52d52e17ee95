//! The least s_unit: one service, and memory for no more than that. What it takes beyond the bare echo
//! is CARA's part.

#![no_std]
#![no_main]

use cara_embassy::Runner as UnitRunner;
use cara_lm3s6965evb::arguments::{self, ArgumentError};
use cara_lm3s6965evb::wiring::{self, NO_ROOM, Sockets};
use cara_lm3s6965evb::{executor, stack, start};
use cara_vehicle::least::{self, LIMITS, LeastResources};
use embassy_executor::Spawner;
use static_cell::{ConstStaticCell, StaticCell};

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
    executor::run(spawn)
}

#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static SOCKETS: ConstStaticCell<Sockets<{ LIMITS.sockets() }>> = ConstStaticCell::new(Sockets::new());
    static RESOURCES: StaticCell<LeastResources> = StaticCell::new();
    let given = arguments::read().map_err(ArgumentError::text)?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let network = wiring::network(spawner, &settings, SOCKETS.take(), noise)?;
    let made = least::unit(network, RESOURCES.init_with(LeastResources::new), &settings, security);
    let unit_runner = made.map_err(|_| "the settings are of no s_unit")?;
    spawner.spawn(unit(unit_runner).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    cara_vehicle::info!("started");
    Ok(())
}

#[embassy_executor::task]
async fn unit(mut runner: UnitRunner<()>) -> ! {
    runner.run().await
}
