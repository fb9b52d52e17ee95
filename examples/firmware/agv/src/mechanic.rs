//! The mechanic, whom the AGV calls when its button is pressed: the one function of another node that it uses.

use cara_apps::mechanic;
use cara_core::error::{Cause, Error};

use crate::{Vehicle, info};

/// Calls a mechanic each time that the button is pressed, once the manager offers one.
pub async fn call_mechanic(vehicle: Vehicle, mut pressed: impl AsyncFnMut()) -> ! {
    loop {
        pressed().await;
        vehicle.wait_until(|vehicle| vehicle.nodes_offering("call_mechanic").next().is_some()).await;
        match ask_mechanic(vehicle).await {
            Ok(_minutes) => info!("a mechanic comes in {} minutes", _minutes),
            Err(_error) => info!("no mechanic: ask the {}", who_must_act(&_error)),
        }
    }
}

/// Texts of errors stay out of the image.
fn who_must_act(error: &Error) -> &'static str {
    match error.cause() {
        Cause::Configuration => "programmer",
        Cause::Peer => "manager",
        Cause::Resource => "programmer for more room, or wait",
        Cause::Transport => "network",
    }
}

async fn ask_mechanic(vehicle: Vehicle) -> Result<i64, Error> {
    let mut arguments = mechanic::arguments()?;
    arguments.set_value("fault", "a wheel squeaks")?;
    vehicle.block_request("call_mechanic", &mut arguments).await?;
    arguments.variable("minutes")
}
