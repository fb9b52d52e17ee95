//! How every board starts its AGV, and the tasks that are the same on all. Those of its network, button, LED and watchdog are the board's own,
//! because their types are.

use cara_embassy::{Runner, Security, Transport};
use cara_settings::Settings;
use embassy_executor::{SpawnError, Spawner};
use static_cell::StaticCell;

use crate::{Agv, Vehicle, VehicleResources};

/// Why a board does not start: its executor has no room for a task.
pub const NO_ROOM: &str = "no room for a task";

/// Makes the AGV of the settings and starts its tasks. Once per image: its memory is a static here. On an error the text says why.
pub fn start(
    spawner: Spawner,
    transport: impl Transport,
    settings: &Settings,
    security: Security,
) -> Result<Vehicle, &'static str> {
    static RESOURCES: StaticCell<VehicleResources> = StaticCell::new();
    let made = crate::vehicle(transport, RESOURCES.init_with(VehicleResources::new), settings, security);
    let (vehicle, runner) = made.map_err(|_| "the settings are of no vehicle")?;
    crate::info!("{=str}/{=u32}", settings.identity.name(), settings.identity.id());
    let has_no_room = |_: SpawnError| NO_ROOM;
    spawner.spawn(unit(runner).map_err(has_no_room)?);
    spawner.spawn(drive(vehicle).map_err(has_no_room)?);
    Ok(vehicle)
}

/// The unit's task, which the watchdog looks at.
#[embassy_executor::task]
pub async fn unit(mut runner: Runner<Agv>) -> ! {
    cara_board::watched(runner.run()).await
}

/// The motors' task.
#[embassy_executor::task]
pub async fn drive(vehicle: Vehicle) -> ! {
    crate::drive(vehicle).await
}
