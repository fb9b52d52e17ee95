//! Tasks that every board spawns as they are. Those of its network, button, LED and watchdog are the board's own,
//! because their types are.

use cara_embassy::Runner;

use crate::{Agv, Vehicle};

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
