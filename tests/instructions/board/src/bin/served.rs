//! An s_unit that serves and does nothing else: what it executes between a request and its reply is counted from outside.

#![no_std]
#![no_main]

use cara_embassy::{Config, Handler, Limits, Runner as UnitRunner, Security, ServiceOptions, resources};
use cara_lm3s6965evb::arguments;
use cara_lm3s6965evb::wiring::{self, NO_ROOM};
use cara_lm3s6965evb::{executor, start};
use defmt_semihosting as _;
use embassy_executor::Spawner;
use embassy_net::StackResources;
use static_cell::{ConstStaticCell, StaticCell};

/// Those of an s_unit, with room for a text of 512 characters.
const LIMITS: Limits = Limits { arguments: 640, ..Limits::S_UNIT };
type Memory = resources!((), LIMITS);

const SERVICES: [&str; 2] =
    ["pos_info(position: int[2]) -> (position: int[2])", "echo(text: string[512]) -> (text: string[512])"];

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
    executor::run(spawn)
}

#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static SOCKETS: ConstStaticCell<StackResources<{ LIMITS.sockets() }>> = ConstStaticCell::new(StackResources::new());
    static MEMORY: StaticCell<Memory> = StaticCell::new();
    let settings = arguments::read().map_err(|_| "the arguments are no settings")?.settings;
    let manager = settings.manager.as_ref().ok_or("the arguments name no manager")?;
    // The same numbers in every run, as far as the network lets them be.
    let seed = 1;
    let network = wiring::network(spawner, &settings, SOCKETS.take(), seed)?;
    let (name, id) = (settings.identity.name(), settings.identity.id());
    let config = Config::s_unit(name, id, &manager.name, manager.id, Security::insecure(seed))
        .map_err(|_| "the settings are of no unit")?;
    let config = config.fleet(settings.fleet.0);
    let (unit, unit_runner) =
        cara_embassy::new(network, MEMORY.init_with(Memory::new), config, ()).map_err(|_| "no such unit")?;
    for service in SERVICES {
        let nothing = Handler::method(&|(), _, _| Ok(()));
        unit.my_function_list()
            .add_service(service, ServiceOptions::new().idempotent(), nothing)
            .map_err(|_| "no room for a service")?;
    }
    unit.publish_my_function_list().map_err(|_| "nothing is published")?;
    spawner.spawn(serve(unit_runner).map_err(|_| NO_ROOM)?);
    defmt::info!("started");
    Ok(())
}

#[embassy_executor::task]
async fn serve(mut runner: UnitRunner<()>) -> ! {
    runner.run().await
}
