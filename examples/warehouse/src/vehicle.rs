//! A vehicle: its body, and the unit that drives it. The unit may be switched off and on again; the body stays where it is.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use cara_apps::warehouse::{
    self, CHARGE, CHARGE_EVERY, Cell, Charge, FAULT, POSE, POSE_EVERY, Place, Pose, RAMP, STOP, Transport,
    TransportServer,
};
use cara_std::{
    Actuator, AnyCall, Definition, Error, LeaseWatch, LinkCounter, ParametersView, Priority, Publisher, Served,
    ServiceError, ServiceOptions, Threads, Unit,
};

use crate::network::{MANAGER, Network};

/// What lasts while the unit is off.
#[derive(Debug)]
pub struct Vehicle {
    /// Its name in the fleet.
    pub name: String,
    /// What it is and does.
    pub agv: warehouse::Vehicle<LeaseWatch>,
    /// Lines for the log of what really happens.
    pub log: Vec<String>,
}

/// A vehicle that several threads look at.
#[derive(Clone, Debug)]
pub struct Shared(Arc<Mutex<Vehicle>>);

impl Shared {
    /// One that stands, with a full battery or less.
    pub fn new(name: String, at: Cell, charge: f64) -> Self {
        let mut vehicle = Vehicle { name, agv: warehouse::Vehicle::new(at, charge), log: Vec::new() };
        vehicle.note(format_args!("enter {at}"));
        Self(Arc::new(Mutex::new(vehicle)))
    }

    /// Held for some assignments at a time: no service can keep the motors' loop from it.
    pub fn lock(&self) -> MutexGuard<'_, Vehicle> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The time of the machine's clock that all its processes share.
pub fn now() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec as u32)
}

impl Vehicle {
    /// Adds a line to the log.
    pub fn note(&mut self, what: std::fmt::Arguments<'_>) {
        let now = now();
        let line = format!("{}.{:09} {} {what}", now.as_secs(), now.subsec_nanos(), self.name);
        self.log.push(line);
    }

    fn place(&self) -> Place {
        self.agv.place(self.agv.order.as_ref().is_some_and(LeaseWatch::is_live))
    }
}

/// What the typed services get: the unit's state is the vehicle that it shares with the motors' loop.
impl Transport for Shared {
    type Order = LeaseWatch;

    fn advance(&mut self, call: &impl AnyCall<Order = LeaseWatch>, cell: [i64; 2]) -> Result<i64, ServiceError> {
        let mut vehicle = self.lock();
        let entered = call.commit(|| vehicle.agv.advance(cell, call.order()))??;
        if entered.is_new {
            let next = vehicle.agv.body.next();
            vehicle.note(format_args!("enter {next}"));
        }
        Ok(entered.moves)
    }

    fn place(&mut self) -> Place {
        self.lock().place()
    }

    fn load(&mut self, order: i64) -> Result<(), ServiceError> {
        self.lock().agv.load(order)
    }

    fn unload(&mut self, order: i64) -> Result<(), ServiceError> {
        let mut vehicle = self.lock();
        if vehicle.agv.unload(order)? {
            let at = vehicle.agv.body.at();
            vehicle.note(format_args!("deliver {order} {at}"));
        }
        Ok(())
    }

    fn reset(&mut self, mended: bool) -> Result<(), ServiceError> {
        self.lock().agv.reset(mended)
    }
}

/// The unit of a vehicle that is switched on.
pub struct Running {
    unit: Unit<Shared>,
    drive: Actuator,
    /// Whichever order drives it.
    pub watch: LeaseWatch,
    pose: Publisher<Pose, Shared>,
    charge: Publisher<Charge, Shared>,
    said: (Option<Pose>, Option<Instant>),
}

impl Running {
    /// Switches it on.
    pub fn start(vehicle: &Shared, id: u32, network: &Network, threads: &Threads) -> Result<Self> {
        let name = vehicle.lock().name.clone();
        let builder = network.place(Unit::builder(&name, id, MANAGER.0, MANAGER.1)?);
        let unit = builder.threads(threads).state(vehicle.clone()).build()?;
        let functions = unit.my_function_list();
        // The motors' loop looks at the order itself: nothing is left for the hook.
        let drive = functions.actuator(|| ())?.ramp(RAMP);
        functions.serve(TransportServer { drive: drive.clone() })?;
        let stopped = vehicle.clone();
        // The order has ended before this runs.
        let stop = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            stopped.lock().agv.motor.stop(now());
            Ok(())
        };
        let options = ServiceOptions::new().idempotent().priority(Priority::Emergency).stops(&drive);
        functions.add_service(&Definition::parse(STOP)?, options, stop)?;
        let pose = functions.add_stream_of(POSE, POSE_EVERY)?;
        let charge = functions.add_stream_of(CHARGE, CHARGE_EVERY)?;
        if vehicle.lock().agv.is_faulty() {
            drive.inhibit(FAULT);
        }
        unit.publish_my_function_list()?;
        unit.start()?;
        let watch = drive.watch();
        Ok(Self { unit, drive, watch, pose, charge, said: (None, None) })
    }

    /// A wheel has come off: it stops itself, and calls nobody. Its manager sees it.
    pub fn fail(&self, vehicle: &mut Vehicle) {
        vehicle.agv.fail();
        vehicle.agv.motor.stop(now());
        self.drive.inhibit(FAULT);
    }

    /// It has arrived: its order is done.
    pub fn arrived(&self, order: &LeaseWatch) {
        // Where a newer one has begun meanwhile, that one goes on.
        self.unit.end_order(order);
    }

    /// Says where it is: often while it moves, and at once when it has arrived or stands.
    pub fn publish(&mut self, vehicle: &Shared, now: Instant) -> Result<(), Error> {
        let (place, position) = {
            let vehicle = vehicle.lock();
            (vehicle.place(), vehicle.agv.body.position())
        };
        let (said, at) = &mut self.said;
        let age = at.map_or(Duration::MAX, |at| now.saturating_duration_since(at));
        let pose = Pose::of(position, &place);
        let known = |pose: &Pose| Pose { position: [0.0; 2], ..*pose };
        let is_news = said.as_ref().map(known) != Some(known(&pose));
        let every = if place.stands { CHARGE_EVERY } else { 2 * POSE_EVERY };
        if !is_news && age < every {
            return Ok(());
        }
        (*said, *at) = (Some(pose), Some(now));
        self.pose.publish(&pose)?;
        self.charge.publish(&Charge { percent: place.charge })
    }

    /// Messages and datagrams that it has sent.
    pub fn sent(&self) -> [u64; 2] {
        [self.unit.counted(LinkCounter::MessagesSent), self.unit.counted(LinkCounter::DatagramsSent)]
    }

    /// Switches it off. May take as long as a handler runs.
    pub fn stop(self) {
        self.unit.stop();
    }
}
