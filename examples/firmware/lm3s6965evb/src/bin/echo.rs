//! A bare TCP echo: what the board, embassy and the network cost without CARA. `cargo xtask sizes` subtracts it.

#![no_std]
#![no_main]

use cara_lm3s6965evb::arguments::ArgumentError;
use cara_lm3s6965evb::ethernet::Ethernet;
use cara_lm3s6965evb::{arguments, executor, fault, stack, start};
use cara_vehicle::echo;
use embassy_executor::Spawner;
use embassy_net::{Runner, Stack, StackResources};
use static_cell::ConstStaticCell;

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
    static RESOURCES: ConstStaticCell<StackResources<4>> = ConstStaticCell::new(StackResources::new());
    let given = arguments::read().map_err(ArgumentError::text)?;
    let ethernet = ETHERNET.take();
    ethernet.start();
    let config = cara_vehicle::network(&given.settings);
    let (stack, runner) = embassy_net::new(ethernet, config, RESOURCES.take(), given.noise);
    spawner.spawn(network(runner).map_err(|_| "no room for a task")?);
    spawner.spawn(answer(stack).map_err(|_| "no room for a task")?);
    spawner.spawn(stack::report().map_err(|_| "no room for a task")?);
    Ok(())
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, &'static mut Ethernet>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn answer(stack: Stack<'static>) -> ! {
    static BUFFERS: ConstStaticCell<echo::Buffers> = ConstStaticCell::new(echo::Buffers::new());
    echo::run(stack, BUFFERS.take()).await
}
