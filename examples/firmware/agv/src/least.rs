//! The least s_unit: one service, and memory for no more than that. It is how small a unit can be, and what CARA itself
//! takes of a board when nothing else is there.

use cara_core::error::{Error, ServiceError};
use cara_embassy::{Handler, Resources, Runner, ServiceOptions, message_buffer};
use cara_settings::Settings;
use embassy_net::Stack;

use crate::{VehicleError, unit_config};

/// The longest message.
const MESSAGE: usize = message_buffer(1024);

/// Its memory.
pub type LeastResources = Resources<(), 1, MESSAGE>;

/// Sockets of the network stack that it needs, with one for DHCP.
pub const SOCKETS: usize = LeastResources::SOCKETS + 1;

/// Makes the unit, whose one service adds two numbers.
pub fn unit(
    stack: Stack<'static>,
    resources: &'static mut LeastResources,
    settings: &Settings,
    seed: u64,
) -> Result<Runner<()>, VehicleError> {
    let (unit, runner) = cara_embassy::new(stack, resources, unit_config(settings, seed)?, ())?;
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
