//! The AGV of the examples on a Nucleo board. The blue button calls the mechanic.

#![no_std]
#![no_main]

use cara_embassy::Security;
use cara_nucleo::Board;
use cara_nucleo::board::{Button, Device, Led, Watchdog};
use cara_settings::Settings;
use cara_vehicle::provision::{Provision, halves};
use cara_vehicle::{LIMITS, Vehicle, led, tasks};
use defmt_rtt as _;
use embassy_executor::{SpawnError, Spawner};
use embassy_net::{Runner, StackResources};
use static_cell::StaticCell;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let mut board = Board::start();
    let [first, second] = board.pages;
    let known = Provision::read(first, second).and_then(|Provision { settings, proof }| {
        proof.begin(board.lives, halves(board.seed)).map(|security| (settings, security))
    });
    let Some((settings, security)) = known else { led::unprovisioned(async |on| board.led.set(on)).await };
    defmt::unwrap!(spawn(
        spawner,
        settings,
        security,
        board.seed,
        board.device,
        board.led,
        board.button,
        board.watchdog
    ));
}

fn spawn(
    spawner: Spawner,
    settings: Settings,
    security: Security,
    seed: u64,
    device: Device,
    led: Led,
    button: Button,
    watchdog: Watchdog,
) -> Result<(), SpawnError> {
    static SOCKETS: StaticCell<StackResources<{ LIMITS.sockets() }>> = StaticCell::new();
    let sockets = SOCKETS.init_with(StackResources::new);
    let (transport, network_runner) = cara_vehicle::network(device, &settings, sockets, seed);
    spawner.spawn(network(network_runner)?);
    let vehicle = defmt::unwrap!(tasks::start(spawner, transport, &settings, security));
    spawner.spawn(call_mechanic(vehicle, button)?);
    spawner.spawn(shine(vehicle, led)?);
    watchdog.start();
    Ok(())
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, Device>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn call_mechanic(vehicle: Vehicle, mut button: Button) -> ! {
    cara_vehicle::call_mechanic(vehicle, async || button.pressed().await).await
}

#[embassy_executor::task]
async fn shine(vehicle: Vehicle, mut led: Led) -> ! {
    led::show(vehicle, async |on| led.set(on)).await
}
