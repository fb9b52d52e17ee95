//! A bare TCP echo: what the board, embassy and the network cost without CARA. `cargo xtask sizes` subtracts it.

#![no_std]
#![no_main]

use cara_lm3s6965evb::arguments::ArgumentError;
use cara_lm3s6965evb::wiring::{self, NO_ROOM};
use cara_lm3s6965evb::{arguments, executor, stack, start};
use cara_vehicle::echo;
use embassy_executor::Spawner;
use embassy_net::{Stack, StackResources};
use static_cell::ConstStaticCell;

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
    executor::run(spawn)
}

#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static RESOURCES: ConstStaticCell<StackResources<4>> = ConstStaticCell::new(StackResources::new());
    let given = arguments::read().map_err(ArgumentError::text)?;
    let network = wiring::network(spawner, &given.settings, RESOURCES.take(), given.noise)?;
    spawner.spawn(answer(network.stack()).map_err(|_| NO_ROOM)?);
    spawner.spawn(stack::report().map_err(|_| NO_ROOM)?);
    cara_vehicle::info!("started");
    Ok(())
}

#[embassy_executor::task]
async fn answer(stack: Stack<'static>) -> ! {
    static BUFFERS: ConstStaticCell<echo::Buffers> = ConstStaticCell::new(echo::Buffers::new());
    echo::run(stack, BUFFERS.take()).await
}
