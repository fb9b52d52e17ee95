//! Says what the memory of a unit costs on a processor of 32 bits, in all and for each limit, and ends.

#![no_std]
#![no_main]

use cara_embassy::{Limits, resources};
use cara_lm3s6965evb as _;
use cara_vehicle::{Agv, LIMITS, VehicleResources};
use semihosting::println;

const BYTES: usize = VehicleResources::BYTES;

/// What it costs to have one limit larger.
macro_rules! cost {
    ($limit:ident: $value:expr) => {{
        const LARGER: Limits = Limits { $limit: $value, ..LIMITS };
        <resources!(Agv, LARGER)>::BYTES - BYTES
    }};
}

const COSTS: [(&str, usize); 9] = [
    ("links: one more", cost!(links: 2)),
    ("message_size: 2 KiB in place of 1 KiB", cost!(message_size: 2048)),
    ("message_buffers: one more", cost!(message_buffers: 4)),
    ("stream: 512 bytes more in each direction", cost!(stream: 2048)),
    ("functions: one more", cost!(functions: 9)),
    ("their_functions: one more", cost!(their_functions: 9)),
    ("calls: one more in each direction", cost!(calls: 5)),
    ("tasks: one more call that waits for a task", cost!(tasks: 2)),
    ("arguments: 512 bytes more", cost!(arguments: 1024)),
];

#[cortex_m_rt::entry]
fn main() -> ! {
    println!("Resources::BYTES of the AGV: {BYTES}");
    for (what, bytes) in COSTS {
        println!("{what}: {bytes}");
    }
    semihosting::process::exit(0)
}
