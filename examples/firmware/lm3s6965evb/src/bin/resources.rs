//! Says what the memory of a unit costs on a processor of 32 bits, in all and for each capacity, and ends.

#![no_std]
#![no_main]

use cara_apps::agv::Agv;
use cara_embassy::{Resources, message_buffer};
use cara_lm3s6965evb as _;
use semihosting::println;

type Unit<
    const LINKS: usize = 1,
    const MESSAGE: usize = { message_buffer(1024) },
    const BUFFERS: usize = 3,
    const STREAM: usize = 1536,
    const FUNCTIONS: usize = 8,
    const THEIR: usize = 8,
    const CALLS: usize = 4,
    const TASKS: usize = 1,
    const ARGUMENTS: usize = 512,
> = Resources<Agv, LINKS, MESSAGE, BUFFERS, STREAM, FUNCTIONS, THEIR, CALLS, TASKS, ARGUMENTS>;

const BYTES: usize = Unit::<1>::BYTES;
const MESSAGE: usize = message_buffer(1024);
const LONGER: usize = message_buffer(2048);

/// What each capacity costs, as the difference that a change of it makes.
const COSTS: [(&str, usize); 9] = [
    ("LINKS: one more link", Unit::<2>::BYTES - BYTES),
    ("MESSAGE: messages of 2 KiB in place of 1 KiB", Unit::<1, LONGER>::BYTES - BYTES),
    ("BUFFERS: one more message buffer", Unit::<1, MESSAGE, 4>::BYTES - BYTES),
    ("STREAM: 512 bytes more in each direction", Unit::<1, MESSAGE, 3, 2048>::BYTES - BYTES),
    ("FUNCTIONS: one more function of its own", Unit::<1, MESSAGE, 3, 1536, 9>::BYTES - BYTES),
    ("THEIR: one more function of a peer", Unit::<1, MESSAGE, 3, 1536, 8, 9>::BYTES - BYTES),
    ("CALLS: one more call in each direction", Unit::<1, MESSAGE, 3, 1536, 8, 8, 5>::BYTES - BYTES),
    ("TASKS: one more call that waits for a task", Unit::<1, MESSAGE, 3, 1536, 8, 8, 4, 2>::BYTES - BYTES),
    ("ARGUMENTS: 512 bytes more", Unit::<1, MESSAGE, 3, 1536, 8, 8, 4, 1, 1024>::BYTES - BYTES),
];

#[cortex_m_rt::entry]
fn main() -> ! {
    println!("Resources::BYTES of the AGV: {BYTES}");
    for (what, bytes) in COSTS {
        println!("{what}: {bytes}");
    }
    semihosting::process::exit(0)
}
