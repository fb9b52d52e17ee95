//! The least s_unit: one service, and memory for no more than that. What it takes beyond the bare echo
//! is CARA's part.

#![no_std]
#![no_main]

use cara_embassy::Runner as UnitRunner;
use cara_lm3s6965evb::arguments::{self, ArgumentError};
use cara_lm3s6965evb::ethernet::Ethernet;
use cara_lm3s6965evb::{executor, fault, stack, start};
use cara_vehicle::least::{self, LIMITS, LeastResources};
use embassy_executor::Spawner;
use embassy_net::{Runner, StackResources};
use static_cell::{ConstStaticCell, StaticCell};

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
    executor::run(|spawner| match spawn(spawner) {
        Ok(()) => cara_vehicle::info!("started"),
        Err(text) => {
            cara_vehicle::error!("{=str}", text);
            semihosting::process::exit(fault::NOT_STARTED)
        }
    })
}

#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static ETHERNET: ConstStaticCell<Ethernet> = ConstStaticCell::new(Ethernet::new());
    static SOCKETS: ConstStaticCell<StackResources<{ LIMITS.sockets() }>> = ConstStaticCell::new(StackResources::new());
    static RESOURCES: StaticCell<LeastResources> = StaticCell::new();
    const NO_ROOM: &str = "no room for a task";
    let given = arguments::read().map_err(ArgumentError::text)?;
    let (settings, security, noise) = given.security().ok_or("it joins no manager")?;
    let ethernet = ETHERNET.take();
    ethernet.start();
    let sockets = SOCKETS.take();
    let (stack, network_runner) = embassy_net::new(ethernet, cara_vehicle::network(&settings), sockets, noise);
    let made = least::unit(stack, RESOURCES.init_with(LeastResources::new), &settings, security);
    let unit_runner = made.map_err(|_| "the settings are of no s_unit")?;
    spawner.spawn(network(network_runner).map_err(|_| NO_ROOM)?);
    spawner.spawn(unit(unit_runner).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    Ok(())
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, &'static mut Ethernet>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn unit(mut runner: UnitRunner<()>) -> ! {
    runner.run().await
}
