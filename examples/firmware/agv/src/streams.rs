//! What the vehicle tells of itself, to those that want to know: where it is, with each tick of its motors' loop, and how full
//! its battery is. They are the streams that it has on Linux.

use cara_apps::agv::{CHARGE, Charge, POSE, Pose, TICK};
use cara_core::error::Error;
use cara_core::time::Duration;
use cara_embassy::{Publisher, StreamCell};
use static_cell::ConstStaticCell;

use crate::{Agv, Vehicle};

/// A subscriber gets how full the battery is at most so often.
const CHARGE_EVERY: Duration = Duration::from_millis(500);

/// Its streams.
pub(crate) struct Streams {
    pose: Publisher<Pose, Agv>,
    charge: Publisher<Charge, Agv>,
}

impl Streams {
    /// Adds them to the vehicle's list, once, and publishes it.
    pub(crate) fn add(vehicle: Vehicle) -> Result<Self, Error> {
        static POSE_CELL: ConstStaticCell<StreamCell<16>> = ConstStaticCell::new(StreamCell::new());
        static CHARGE_CELL: ConstStaticCell<StreamCell<8>> = ConstStaticCell::new(StreamCell::new());
        let list = vehicle.my_function_list();
        let pose = list.add_stream_of(POSE, TICK, POSE_CELL.take())?;
        let charge = list.add_stream_of(CHARGE, CHARGE_EVERY, CHARGE_CELL.take())?;
        vehicle.publish_my_function_list()?;
        Ok(Self { pose, charge })
    }

    /// Publishes how it is now.
    pub(crate) fn publish(&self, vehicle: Vehicle) {
        let Ok((position, percent)) = vehicle.with_state(|agv| (agv.place().exact(), agv.charge())) else { return };
        // Publishing fails only when a stream has been removed.
        let _ = self.pose.publish(&Pose { position });
        let _ = self.charge.publish(&Charge { percent });
    }
}
