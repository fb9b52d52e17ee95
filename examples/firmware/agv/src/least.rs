//! The least s_unit: one service, and memory for no more than that. It is how small a unit can be, and what CARA itself
//! takes of a board when nothing else is there.

use cara_core::error::{Error, ServiceError};
use cara_embassy::{Handler, Resources, Runner, Security, ServiceOptions, message_buffer};
use cara_settings::Settings;
use embassy_net::Stack;

use crate::{VehicleError, unit_config};

/// One manager, messages of 1 KiB, two functions of its own and two of the manager's. What it gives up for being small:
/// a best-effort request above 480 bytes is lost, results above 512 bytes are refused when they come back, and no call
/// can wait for a task.
const LINKS: usize = 1;
const MESSAGE: usize = message_buffer(1024);
const BUFFERS: usize = 2;
const STREAM: usize = 1024;
const FUNCTIONS: usize = 2;
const THEIR: usize = 2;
const CALLS: usize = 3;
const TASKS: usize = 0;
const ARGUMENTS: usize = 256;
const DATAGRAM: usize = 512;
const REPLY: usize = 512;

/// Its memory.
pub type LeastResources =
    Resources<(), LINKS, MESSAGE, BUFFERS, STREAM, FUNCTIONS, THEIR, CALLS, TASKS, ARGUMENTS, DATAGRAM, REPLY>;

/// Sockets of the network stack that it needs, with one for DHCP.
pub const SOCKETS: usize = LeastResources::SOCKETS + 1;

/// Makes the unit, whose one service adds two numbers.
pub fn unit(
    stack: Stack<'static>,
    resources: &'static mut LeastResources,
    settings: &Settings,
    security: Security,
) -> Result<Runner<()>, VehicleError> {
    let (unit, runner) = cara_embassy::new(stack, resources, unit_config(settings, security)?, ())?;
    let add = Handler::method(&|(), _, numbers| {
        let mut sum = || {
            let (a, b): (i64, i64) = (numbers.variable("a")?, numbers.variable("b")?);
            numbers.set_value("sum", a.wrapping_add(b))
        };
        sum().map_err(|_: Error| ServiceError::BadResults)
    });
    unit.add_service("add(a: int, b: int) -> (sum: int)", ServiceOptions::new(), add)?;
    unit.publish_my_function_list()?;
    Ok(runner)
}
