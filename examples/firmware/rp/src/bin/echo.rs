//! A bare TCP echo: what the board, embassy and the network cost without CARA. `cargo xtask sizes` subtracts it.

#![no_std]
#![no_main]

use cara_rp::Board;
use cara_rp::board::Device;
use cara_settings::page;
use cara_vehicle::echo;
use defmt_rtt as _;
use embassy_executor::{SpawnError, Spawner};
use embassy_net::{Runner, Stack, StackResources};
use static_cell::StaticCell;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    defmt::unwrap!(run(spawner).await);
}

async fn run(spawner: Spawner) -> Result<(), SpawnError> {
    static RESOURCES: StaticCell<StackResources<4>> = StaticCell::new();
    let Board { pages: [first, second], seed, network, .. } = Board::start(spawner).await;
    let (device, uplink) = network.start(spawner).await?;
    let settings = page::newest(first, second);
    let config = settings.as_ref().map_or_else(|_| echo::dhcp(), cara_vehicle::network_config);
    let resources = RESOURCES.init_with(StackResources::new);
    let (stack, runner) = embassy_net::new(device, config, resources, seed);
    uplink.keep(spawner, stack, settings.as_ref().ok())?;
    spawner.spawn(talk(runner)?);
    spawner.spawn(answer(stack)?);
    Ok(())
}

#[embassy_executor::task]
async fn talk(mut runner: Runner<'static, Device>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn answer(stack: Stack<'static>) -> ! {
    static BUFFERS: StaticCell<echo::Buffers> = StaticCell::new();
    echo::run(stack, BUFFERS.init_with(echo::Buffers::new)).await
}
