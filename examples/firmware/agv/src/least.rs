//! The least s_unit: one service, and memory for no more than that. It is how small a unit can be, and what CARA itself
//! takes of a board when nothing else is there.

use cara_embassy::{Limits, Runner, Security, Transport, interface, resources};
use cara_settings::Settings;

use crate::{VehicleError, unit_config};

/// One manager, messages of 1 KiB, two functions of its own and two of the manager's. What it gives up for being small:
/// a best-effort request above 480 bytes is lost, results above 512 bytes are refused when they come back, and no call
/// can wait for a task.
pub const LIMITS: Limits = Limits {
    message_buffers: 2,
    stream: 1024,
    functions: 2,
    their_functions: 2,
    calls: 3,
    calls_waiting: 0,
    tasks: 0,
    arguments: 256,
    datagram: Some(512),
    reply: Some(512),
    ..Limits::S_UNIT
};

/// Its memory.
pub type LeastResources = resources!((), LIMITS);

/// What it serves.
#[interface]
pub trait Add {
    /// Adds two numbers.
    #[returns(sum)]
    fn add(&mut self, a: i64, b: i64) -> i64;
}

/// It has no state.
impl Add for () {
    fn add(&mut self, a: i64, b: i64) -> i64 {
        a.wrapping_add(b)
    }
}

/// Makes the unit, whose one service adds two numbers.
pub fn unit(
    transport: impl Transport,
    resources: &'static mut LeastResources,
    settings: &Settings,
    security: Security,
) -> Result<Runner<()>, VehicleError> {
    let (unit, runner) = cara_embassy::new(transport, resources, unit_config(settings, security)?, ())?;
    unit.my_function_list().serve(AddServer)?;
    unit.publish_my_function_list()?;
    Ok(runner)
}
