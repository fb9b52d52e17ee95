//! The AGV of the examples on an RP2040 or RP2350. A button on a pin calls the mechanic.

#![no_std]
#![no_main]

use cara_rp::Board;
use cara_rp::board::{Device, Led};
use cara_rp::parts::Button;
use cara_vehicle::provision::{Provision, halves};
use cara_vehicle::{LIMITS, Vehicle, led, tasks};
use defmt_rtt as _;
use embassy_executor::{SpawnError, Spawner};
use embassy_net::{Runner, StackResources};
use static_cell::StaticCell;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    defmt::unwrap!(run(spawner).await);
}

async fn run(spawner: Spawner) -> Result<(), SpawnError> {
    static SOCKETS: StaticCell<StackResources<{ LIMITS.sockets() }>> = StaticCell::new();
    let Board { pages: [first, second], lives, seed, led, button, watchdog, network } = Board::start(spawner).await;
    let known = Provision::read(first, second).and_then(|Provision { settings, proof }| {
        proof.begin(lives, halves(seed)).map(|security| (settings, security))
    });
    let Some((settings, security)) = known else {
        spawner.spawn(flicker(led)?);
        let (_, uplink) = network.start(spawner).await?;
        uplink.only_led().await
    };
    let (device, uplink) = network.start(spawner).await?;
    let sockets = SOCKETS.init_with(StackResources::new);
    let (network, runner) = cara_vehicle::network(device, &settings, sockets, seed);
    uplink.keep(spawner, network.stack(), Some(&settings))?;
    spawner.spawn(talk(runner)?);
    let vehicle = defmt::unwrap!(tasks::start(spawner, network, &settings, security));
    spawner.spawn(call_mechanic(vehicle, button)?);
    spawner.spawn(shine(vehicle, led)?);
    watchdog.start();
    Ok(())
}

#[embassy_executor::task]
async fn talk(mut runner: Runner<'static, Device>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn call_mechanic(vehicle: Vehicle, mut button: Button) -> ! {
    cara_vehicle::call_mechanic(vehicle, async || button.pressed().await).await
}

#[embassy_executor::task]
async fn shine(vehicle: Vehicle, mut led: Led) -> ! {
    led::show(vehicle, async |on| led.set(on).await).await
}

#[embassy_executor::task]
async fn flicker(mut led: Led) -> ! {
    led::unprovisioned(async |on| led.set(on).await).await
}
