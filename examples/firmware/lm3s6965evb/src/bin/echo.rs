//! A bare TCP echo: what the board, embassy and the network cost without CARA. `cargo xtask sizes` subtracts it.

#![no_std]
#![no_main]

use cara_lm3s6965evb::ethernet::Ethernet;
use cara_lm3s6965evb::{arguments, executor, fault, stack, start};
use cara_settings::Network;
use defmt_semihosting as _;
use embassy_executor::Spawner;
use embassy_net::tcp::TcpSocket;
use embassy_net::{Config, Ipv4Cidr, Runner, Stack, StackResources, StaticConfigV4};
use embassy_time::{Duration, Timer};
use embedded_io_async::Write;
use static_cell::ConstStaticCell;

const PORT: u16 = 7777;
const BUFFER: usize = 2048;

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = start();
    executor::run(|spawner| match spawn(spawner) {
        Ok(()) => defmt::info!("started"),
        Err(text) => {
            defmt::error!("{=str}", text);
            semihosting::process::exit(fault::PANICKED)
        }
    })
}

#[inline(never)]
fn spawn(spawner: Spawner) -> Result<(), &'static str> {
    static ETHERNET: ConstStaticCell<Ethernet> = ConstStaticCell::new(Ethernet::new());
    static RESOURCES: ConstStaticCell<StackResources<4>> = ConstStaticCell::new(StackResources::new());
    let told = arguments::read().map_err(|_| "the arguments are no settings")?;
    let ethernet = ETHERNET.take();
    let [.., last] = ethernet.start();
    let config = match told.settings.network {
        Network::Dhcp => Config::dhcpv4(Default::default()),
        Network::Static { address, prefix, gateway } => Config::ipv4_static(StaticConfigV4 {
            address: Ipv4Cidr::new(address, prefix),
            gateway,
            dns_servers: Default::default(),
        }),
    };
    let resources = RESOURCES.take();
    let seed = told.seed.unwrap_or(u64::from(last));
    let (stack, runner) = embassy_net::new(ethernet, config, resources, seed);
    spawner.spawn(network(runner).map_err(|_| "no room for a task")?);
    spawner.spawn(echo(stack).map_err(|_| "no room for a task")?);
    spawner.spawn(report().map_err(|_| "no room for a task")?);
    Ok(())
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, &'static mut Ethernet>) -> ! {
    runner.run().await
}

#[embassy_executor::task]
async fn echo(stack: Stack<'static>) -> ! {
    static RECEIVE: ConstStaticCell<[u8; BUFFER]> = ConstStaticCell::new([0; BUFFER]);
    static SEND: ConstStaticCell<[u8; BUFFER]> = ConstStaticCell::new([0; BUFFER]);
    static PIECE: ConstStaticCell<[u8; BUFFER]> = ConstStaticCell::new([0; BUFFER]);
    let mut socket = TcpSocket::new(stack, RECEIVE.take(), SEND.take());
    let piece = PIECE.take();
    socket.set_nagle_enabled(false);
    loop {
        socket.set_timeout(Some(Duration::from_secs(10)));
        if socket.accept(PORT).await.is_ok() {
            while let Ok(length @ 1..) = socket.read(piece).await {
                if socket.write_all(&piece[..length]).await.is_err() {
                    break;
                }
            }
            socket.close();
            let _ = socket.flush().await;
        }
        socket.abort();
        let _ = socket.flush().await;
    }
}

#[embassy_executor::task]
async fn report() -> ! {
    loop {
        Timer::after(Duration::from_secs(5)).await;
        let stack = stack::used();
        defmt::info!("stack {=usize} of {=usize} bytes", stack.used, stack.size);
    }
}
