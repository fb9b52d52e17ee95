//! The AGV of the examples on the board.

#![no_std]
#![no_main]

use cara_emulated::agv;
use cara_mps2_an386::{motor, reset, start, watchdog, wiring};
use cara_vehicle::LIMITS;
use embassy_net::StackResources;
use static_cell::ConstStaticCell;

#[cortex_m_rt::entry]
fn main() -> ! {
    static SOCKETS: ConstStaticCell<StackResources<{ LIMITS.sockets() }>> = ConstStaticCell::new(StackResources::new());
    start();
    let network = |spawner, settings: &_, noise| wiring::network(spawner, settings, SOCKETS.take(), noise);
    agv::run(motor::start(), reset::reason(), network, watchdog::start)
}
