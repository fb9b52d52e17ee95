//! An AGV: an s_unit that keeps a position, drives while its manager wants it to, and calls a mechanic.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use cara_apps::agv::{
    BATTERY, BUMPER, CHARGE, Charge, GO_TO, GO_TO_LEASE, POS_INFO, POSE, Pose, Progress, RESET, STOP, TICK,
};
use cara_apps::mechanic;
use cara_examples::{NameAndId, Network, Stop, log_to_stderr, say};
use cara_std::{
    Actuator, Definition, Error, LeaseWatch, ParametersView, Priority, Publisher, Served, ServiceOptions, Unit,
    UnitEvent,
};
use clap::Parser;

/// The vehicle, which keeps the lease of the call that it drives for.
type Agv = cara_apps::agv::Agv<LeaseWatch>;

/// The power of the motors. The safe hook owns it: it takes no lock and writes no line, so nothing holds it up.
static POWER: AtomicBool = AtomicBool::new(false);

/// How often the AGV says where it is.
const POSITION_EVERY: Duration = Duration::from_millis(500);

/// An AGV that joins one manager. With --attended, the lines `press` and `release` on standard input are its bumper.
#[derive(Parser)]
struct Options {
    #[arg(long, default_value = "agv-1")]
    name: String,
    #[arg(long, default_value_t = 11)]
    id: u32,
    /// The manager that it belongs to.
    #[arg(long, value_name = "NAME/ID", default_value = "AGV_manager/1")]
    manager: NameAndId,
    #[command(flatten)]
    network: Network,
}

fn main() -> Result<()> {
    let Options { name, id, manager, network } = Options::parse();
    log_to_stderr();
    let builder = network.place(Unit::builder(&name, id, &manager.name, manager.id)?);
    let unit = builder.build()?;
    let agv = Arc::new(Mutex::new(Agv::new([0, 0])));
    let (drive, streams) = (offer(&unit, &agv)?, Streams::of(&unit)?);
    unit.publish_my_function_list()?;
    let (bumped, motors) = (agv.clone(), drive.clone());
    let stop = Stop::hearing(network.attended, move |line| bumper(line, &bumped, &motors))?;
    unit.on_manager_lost(|()| say!("manager lost"))?;
    follow(&unit);
    unit.start()?;
    say!("started {name}/{id}, {}, at {}", unit.mode().as_str(), lock(&agv).place());
    run_motors(&unit, &agv, &drive, &streams, &stop)?;
    unit.stop();
    say!("ended at {}", lock(&agv).place());
    Ok(())
}

/// Adds the AGV's services. Returns what they move.
fn offer(unit: &Unit, agv: &Arc<Mutex<Agv>>) -> Result<Actuator> {
    let own = || agv.clone();
    let agv = own();
    let pos_info = move |_: &Served, pos: &mut ParametersView| lock(&agv).pos_info(pos);
    let agv = own();
    let go_to = move |call: &Served, pos: &mut ParametersView| {
        let mut agv = lock(&agv);
        call.commit(|| agv.go_to(pos, call.lease.clone()).inspect(|()| POWER.store(true, Ordering::Release)))??;
        agv.target().into_iter().for_each(|target| say!("driving to {target}"));
        Ok(())
    };
    let agv = own();
    let battery = move |_: &Served, charge: &mut ParametersView| lock(&agv).battery(charge);
    // The order has ended before this runs, and the hook makes the vehicle stand.
    let stop = move |call: &Served, _: &mut ParametersView| {
        say!("stop: {} said so", call.caller);
        Ok(())
    };
    let agv = own();
    let reset = move |call: &Served, _: &mut ParametersView| {
        lock(&agv).reset()?;
        say!("reset: {} said so", call.caller);
        Ok(())
    };
    let functions = unit.my_function_list();
    let drive = functions.actuator(|| POWER.store(false, Ordering::Release))?;
    let plain = ServiceOptions::new;
    let stops = plain().idempotent().priority(Priority::Emergency).stops(&drive);
    functions.add_service(&Definition::parse(POS_INFO)?, plain().idempotent(), pos_info)?;
    functions.add_service(&Definition::parse(BATTERY)?, plain().idempotent(), battery)?;
    functions.add_service(&Definition::parse(STOP)?, stops, stop)?;
    functions.add_service(&Definition::parse(RESET)?, plain().idempotent().resets(&drive), reset)?;
    functions.add_service(&Definition::parse(GO_TO)?, plain().moves(&drive, GO_TO_LEASE), go_to)?;
    Ok(drive)
}

/// What the AGV tells of itself.
struct Streams {
    pose: Publisher<Pose>,
    charge: Publisher<Charge>,
}

impl Streams {
    fn of(unit: &Unit) -> Result<Self> {
        let functions = unit.my_function_list();
        let pose = functions.add_stream_of(POSE, TICK)?;
        Ok(Self { pose, charge: functions.add_stream_of(CHARGE, POSITION_EVERY)? })
    }

    fn publish(&self, position: [f64; 2], percent: f64) -> Result<(), Error> {
        self.pose.publish(&Pose { position })?;
        self.charge.publish(&Charge { percent })
    }
}

/// The bumper, by hand: while it is pressed no reset lets the vehicle drive.
fn bumper(line: &str, agv: &Mutex<Agv>, drive: &Actuator) {
    match line {
        "press" => {
            lock(agv).set_bumper(true);
            drive.inhibit(BUMPER);
            say!("the bumper is pressed");
        }
        "release" => {
            lock(agv).set_bumper(false);
            say!("the bumper is free: a reset lets it drive");
        }
        _ => say!("the bumper is pressed by `press` and freed by `release`"),
    }
}

/// The motors' loop: drives while an order is live.
fn run_motors(unit: &Unit, agv: &Mutex<Agv>, drive: &Actuator, streams: &Streams, stop: &Stop) -> Result<()> {
    let (order, mut last, mut said) = (drive.watch(), Instant::now(), Instant::now());
    loop {
        if let Some(outcome) = stop.wait_for(TICK.into()) {
            return outcome;
        }
        let elapsed = last.elapsed();
        last += elapsed;
        let (progress, place, charge, finished) = {
            let mut agv = lock(agv);
            let drives = order.is_live() && POWER.load(Ordering::Acquire);
            (agv.step(elapsed.into(), drives), agv.place(), agv.charge(), agv.finished())
        };
        streams.publish(place.exact(), charge)?;
        if let Some(order) = finished {
            unit.end_order(&order);
        }
        match progress {
            Some(Progress::Passed(place)) => say!("passed {place}"),
            Some(Progress::Arrived(place)) => say!("arrived at {place}"),
            Some(Progress::Stopped(place)) => say!("stopped at {place}: the order has ended"),
            None => {}
        }
        if said.elapsed() >= POSITION_EVERY {
            said = Instant::now();
            say!("position {place}");
        }
    }
}

/// The vehicle has a lock of its own, held for some assignments at a time: no service can keep the motors' loop from it.
fn lock(agv: &Mutex<Agv>) -> MutexGuard<'_, Agv> {
    agv.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Says what happens, and calls a mechanic, once, when the manager offers to send one.
fn follow(unit: &Unit) {
    let events = unit.events();
    let unit = unit.clone();
    std::thread::spawn(move || {
        let mut called = false;
        for event in events {
            match event {
                UnitEvent::Joined { peer } => say!("joined {peer}"),
                UnitEvent::Left { peer, reason } => say!("left {peer}: {reason}"),
                UnitEvent::LeaseExpired { peer, function } => say!("lease of {function} expired, held by {peer}"),
                UnitEvent::ListChanged { .. } if !called => called = offered(&unit) && call_mechanic(&unit),
                _ => {}
            }
        }
    });
}

fn offered(unit: &Unit) -> bool {
    unit.manager().is_some_and(|manager| manager.their_function_list().contains("call_mechanic"))
}

fn call_mechanic(unit: &Unit) -> bool {
    let answer = || -> Result<i64> {
        let mut arguments = mechanic::arguments()?;
        arguments.set_value("fault", "a wheel squeaks")?;
        unit.block_request("call_mechanic", &mut arguments)?;
        Ok(arguments.variable("minutes")?)
    };
    match answer() {
        Ok(minutes) => say!("call_mechanic: one comes in {minutes} minutes"),
        Err(error) => say!("call_mechanic failed: {error}"),
    }
    true
}
