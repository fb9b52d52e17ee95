//! A bare TCP echo: what the board, embassy and the network cost without CARA. `cargo xtask sizes` subtracts it.

#![no_std]
#![no_main]

use cara_nucleo::Board;
use cara_nucleo::board::Device;
use cara_settings::page;
use cara_vehicle::echo;
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_net::{Runner, Stack, StackResources};
use static_cell::StaticCell;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    static RESOURCES: StaticCell<StackResources<4>> = StaticCell::new();
    let board = Board::start();
    let [first, second] = board.pages;
    let config =
        page::newest(first, second).map_or_else(|_| echo::dhcp(), |settings| cara_vehicle::network_config(&settings));
    let resources = RESOURCES.init_with(StackResources::new);
    let (stack, runner) = embassy_net::new(board.device, config, resources, board.seed);
    spawner.spawn(defmt::unwrap!(network(runner)));
    spawner.spawn(defmt::unwrap!(answer(stack)));
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, Device>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn answer(stack: Stack<'static>) -> ! {
    static BUFFERS: StaticCell<echo::Buffers> = StaticCell::new();
    echo::run(stack, BUFFERS.init_with(echo::Buffers::new)).await
}
