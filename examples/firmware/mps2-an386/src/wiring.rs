//! What every image of the board starts with: its network.

use cara_embassy::Network;
use cara_settings::Settings;
use cara_vehicle::tasks::NO_ROOM;
use embassy_executor::Spawner;
use embassy_net::{Runner, StackResources};
use static_cell::ConstStaticCell;

use crate::ethernet::Ethernet;

/// Starts the controller and the network of the settings. Once per image.
pub fn network<const SOCKETS: usize>(
    spawner: Spawner,
    settings: &Settings,
    sockets: &'static mut StackResources<SOCKETS>,
    noise: u64,
) -> Result<Network<SOCKETS>, &'static str> {
    static ETHERNET: ConstStaticCell<Ethernet> = ConstStaticCell::new(Ethernet::new());
    let ethernet = ETHERNET.take();
    ethernet.start();
    let (network, runner) = cara_vehicle::network(ethernet, settings, sockets, noise);
    spawner.spawn(run(runner).map_err(|_| NO_ROOM)?);
    Ok(network)
}

#[embassy_executor::task]
async fn run(mut runner: Runner<'static, &'static mut Ethernet>) -> ! {
    runner.run().await
}
