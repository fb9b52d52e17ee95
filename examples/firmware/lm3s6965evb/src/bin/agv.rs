//! The AGV of the examples on the emulated board.

#![no_std]
#![no_main]

use cara_emulated::agv;
use cara_lm3s6965evb::wiring::{self, Sockets};
use cara_lm3s6965evb::{motor, reset, start, watchdog};
use cara_vehicle::LIMITS;
use static_cell::ConstStaticCell;

#[cortex_m_rt::entry]
fn main() -> ! {
    static SOCKETS: ConstStaticCell<Sockets<{ LIMITS.sockets() }>> = ConstStaticCell::new(Sockets::new());
    let _core = start();
    let network = |spawner, settings: &_, noise| wiring::network(spawner, settings, SOCKETS.take(), noise);
    agv::run(motor::start(), reset::reason(), network, watchdog::start)
}
