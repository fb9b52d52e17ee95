//! A vehicle of the warehouse as firmware, whatever the board: what it is and does is [`cara_apps::warehouse`], as in the
//! warehouse's processes on Linux. Its motors brake while its order is stopping, and are cut when that is over.

use core::fmt;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use cara_apps::warehouse::{
    self, CHARGE, CHARGE_EVERY, Cell, Charge, POSE, POSE_EVERY, Place, Pose, RAMP, STOP, TICK, Transport,
    TransportServer,
};
use cara_core::config::Priority;
use cara_core::error::{Error, ServiceError};
use cara_core::time::{Duration, Instant};
use cara_embassy::{
    Actuator, AnyCall, Handle, Handler, LeaseWatch, Publisher, Runner, Security, ServiceOptions, StreamCell, now,
    resources,
};
use cara_settings::Settings;
use embassy_time::Ticker;
use static_cell::ConstStaticCell;

use crate::{DRIVING, HAS_TARGET, LIMITS, RULES, VehicleError, unit_config};

/// Writes a line of what really happens.
pub type Note = fn(fmt::Arguments<'_>);

/// The vehicle, and its log.
#[derive(Debug)]
pub struct Agv {
    vehicle: warehouse::Vehicle<LeaseWatch>,
    note: Note,
}

/// Its unit.
pub type Vehicle = Handle<Agv>;
/// Its memory.
pub type VehicleResources = resources!(Agv, LIMITS);

/// A service had it stop, which the motors' loop has not seen.
static IS_REPORTED: AtomicBool = AtomicBool::new(false);
/// When that was, in microseconds, without those above 32 bits.
static REPORTED_AT: AtomicU32 = AtomicU32::new(0);

impl Transport for Agv {
    type Order = LeaseWatch;

    fn advance(&mut self, call: &impl AnyCall<Order = LeaseWatch>, cell: [i64; 2]) -> Result<i64, ServiceError> {
        let entered = call.commit(|| self.vehicle.advance(cell, call.order()))??;
        HAS_TARGET.store(true, Ordering::Release);
        if entered.is_new {
            (self.note)(format_args!("enter {}", self.vehicle.body.next()));
        }
        Ok(entered.moves)
    }

    fn place(&mut self) -> Place {
        self.vehicle.place(self.vehicle.order.as_ref().is_some_and(LeaseWatch::is_live))
    }

    fn load(&mut self, order: i64) -> Result<(), ServiceError> {
        self.vehicle.load(order)
    }

    fn unload(&mut self, order: i64) -> Result<(), ServiceError> {
        if self.vehicle.unload(order)? {
            (self.note)(format_args!("deliver {order} {}", self.vehicle.body.at()));
        }
        Ok(())
    }

    fn reset(&mut self, mended: bool) -> Result<(), ServiceError> {
        self.vehicle.reset(mended)
    }
}

impl Agv {
    /// A turn of the motors' loop, `elapsed` behind the last one; the order that is done.
    fn turn(&mut self, now: Instant, elapsed: Duration) -> Option<LeaseWatch> {
        let warehouse::Vehicle { body, motor, .. } = &mut self.vehicle;
        let time = |micros: u64| core::time::Duration::from_micros(micros);
        if IS_REPORTED.swap(false, Ordering::AcqRel) {
            let ago = (now.as_micros() as u32).wrapping_sub(REPORTED_AT.load(Ordering::Acquire));
            motor.stop(time(now.as_micros().saturating_sub(ago.into())));
        }
        let before = body.at();
        let lease = (DRIVING.stage(now), DRIVING.left(now).map(|left| time(left.as_micros())));
        // It has no map, and charges wherever it stands.
        let station = true;
        let turned = motor.turn(time(now.as_micros()), time(elapsed.as_micros()), lease, None, station, body);
        HAS_TARGET.store(body.at() != body.next(), Ordering::Release);
        if turned.arrived {
            (self.note)(format_args!("leave {before}"));
        }
        if let Some(stop) = turned.stopped {
            (self.note)(format_args!("{stop}"));
        }
        if turned.arrived { self.vehicle.order.take() } else { None }
    }
}

/// Makes the vehicle that the settings describe, which stands in a cell; `security` proves its identity.
pub fn vehicle(
    transport: impl cara_embassy::Transport,
    resources: &'static mut VehicleResources,
    settings: &Settings,
    security: Security,
    at: Cell,
    note: Note,
) -> Result<(Vehicle, Runner<Agv>), VehicleError> {
    let config = unit_config(settings, security)?.access(&RULES);
    DRIVING.set_ramp(RAMP.into());
    let agv = Agv { vehicle: warehouse::Vehicle::new(at, 100.0), note };
    note(format_args!("enter {at}"));
    let (vehicle, runner) = cara_embassy::new(transport, resources, config, agv)?;
    offer(vehicle)?;
    Ok((vehicle, runner))
}

fn offer(vehicle: Vehicle) -> Result<(), Error> {
    let list = vehicle.my_function_list();
    // The motors brake then. Their interrupt cuts them when they have had the time to, or when they stand.
    list.serve(TransportServer { drive: Actuator::new(&DRIVING, &|| ()) })?;
    // The order has ended before this runs.
    let stop = Handler::free(&|_, _| {
        REPORTED_AT.store(now().as_micros() as u32, Ordering::Release);
        IS_REPORTED.store(true, Ordering::Release);
        Ok(())
    });
    let stops = ServiceOptions::new().idempotent().priority(Priority::Emergency).stops(&DRIVING);
    list.add_service(STOP, stops, stop)
}

struct Streams {
    pose: Publisher<Pose, Agv>,
    charge: Publisher<Charge, Agv>,
}

impl Streams {
    /// Adds them to the vehicle's list, once, and publishes it.
    fn add(vehicle: Vehicle) -> Result<Self, Error> {
        static POSE_CELL: ConstStaticCell<StreamCell<64>> = ConstStaticCell::new(StreamCell::new());
        static CHARGE_CELL: ConstStaticCell<StreamCell<8>> = ConstStaticCell::new(StreamCell::new());
        let list = vehicle.my_function_list();
        let pose = list.add_stream_of(POSE, POSE_EVERY.into(), POSE_CELL.take())?;
        let charge = list.add_stream_of(CHARGE, CHARGE_EVERY.into(), CHARGE_CELL.take())?;
        vehicle.publish_my_function_list()?;
        Ok(Self { pose, charge })
    }
}

/// The motors' loop: drives while the lease is live, and says where it is.
pub async fn drive(vehicle: Vehicle) -> ! {
    let streams = Streams::add(vehicle).inspect_err(|_| crate::error!("no room for the streams")).ok();
    let mut ticker = Ticker::every(embassy_time::Duration::from_micros(TICK.as_micros() as u64));
    let mut last = now();
    loop {
        ticker.next().await;
        let (now, elapsed) = (now(), now().since(last));
        last = now;
        // The state is lent to services between awaits only, so it is free here.
        let turned = vehicle.with_state(|agv| {
            let finished = agv.turn(now, elapsed);
            let (place, position) = (agv.place(), agv.vehicle.body.position());
            (finished, Pose::of(position, &place), Charge { percent: place.charge })
        });
        let Ok((finished, pose, charge)) = turned else { continue };
        if let Some(order) = finished {
            vehicle.end_order(&order);
        }
        if let Some(streams) = &streams {
            // Publishing fails only when a stream has been removed.
            let _ = streams.pose.publish(&pose);
            let _ = streams.charge.publish(&charge);
        }
    }
}
