//! An AGV on smoltcp behind a TAP device: the same vehicle as `agv`, without the system's sockets, and in one loop.
//!
//! ```text
//! ip tuntap add tap0 mode tap user $USER && ip addr add 10.77.0.1/24 broadcast + dev tap0 && ip link set tap0 up
//! cargo run -p cara-smoltcp --example tap_agv -- --tap tap0 --address 10.77.0.2 --manager AGV_manager
//! ```

use std::os::fd::AsRawFd;
use std::time;

use anyhow::{Context, Result};
use cara_apps::agv::{Agv, BATTERY, GO_TO, GO_TO_LEASE, POS_INFO, Progress, RESET, STOP, TICK};
use cara_core::config::Priority;
use cara_core::distribution::connection_handler::Target;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::Fleet;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::ServiceError;
use cara_core::services::lease::{Lease, Order};
use cara_core::services::session::{Event, Incoming};
use cara_core::time::{Duration, Instant};
use cara_smoltcp::{Outcome, Program, Resources, SUnit, Settings};
use clap::Parser;
use smoltcp::phy::{Medium, TunTapInterface, wait};

/// An AGV on smoltcp behind a TAP device.
#[derive(Parser)]
pub(crate) struct Options {
    /// The device, as made by `ip tuntap add NAME mode tap`.
    #[arg(long, default_value = "tap0")]
    pub(crate) tap: String,
    /// The AGV's address, in a network of /24.
    #[arg(long, default_value = "10.77.0.2")]
    pub(crate) address: std::net::Ipv4Addr,
    /// The AGV's name.
    #[arg(long, default_value = "agv-1")]
    pub(crate) name: String,
    /// The AGV's id.
    #[arg(long, default_value_t = 11)]
    pub(crate) id: u32,
    /// The name of its manager.
    #[arg(long, default_value = "AGV_manager")]
    pub(crate) manager: String,
    /// The id of its manager.
    #[arg(long, default_value_t = 1)]
    pub(crate) manager_id: u32,
    /// The fleet of both.
    #[arg(long, default_value_t = 0)]
    pub(crate) fleet: u32,
}

/// The functions by their slots, and the vehicle that they move.
struct Vehicle {
    agv: Agv<Order>,
    pos_info: Slot,
    battery: Slot,
    stop: Slot,
    reset: Slot,
    lease: &'static Lease,
}

impl Program for Vehicle {
    fn serve(&mut self, call: &Incoming, parameters: &mut ParametersView) -> Outcome {
        Outcome::Now(self.outcome(call, parameters))
    }

    fn make_safe(&mut self, _: Slot) {
        if let Some(place) = self.agv.stop() {
            println!("stopped at {place}: the order has ended");
        }
    }

    fn hear(&mut self, event: Event) {
        println!("{event:?}");
    }
}

impl Vehicle {
    fn outcome(&mut self, call: &Incoming, parameters: &mut ParametersView) -> Result<(), ServiceError> {
        let function = call.slot;
        if function == self.pos_info {
            self.agv.pos_info(parameters)
        } else if function == self.battery {
            self.agv.battery(parameters)
        } else if function == self.stop {
            self.agv.stop();
            Ok(())
        } else if function == self.reset {
            self.agv.reset()
        } else {
            self.agv.go_to(parameters, call.order)
        }
    }
}

// Tests run it in a thread of their own.
#[allow(dead_code, reason = "an example's main")]
fn main() -> Result<()> {
    run(&Options::parse(), || false)
}

/// Drives until `stopped`.
pub(crate) fn run(options: &Options, stopped: impl Fn() -> bool) -> Result<()> {
    let began = time::Instant::now();
    let now = || Instant::START + began.elapsed().into();
    let opened = TunTapInterface::new(&options.tap, Medium::Ethernet);
    let mut device = opened.with_context(|| format!("cannot open {}: does it exist, and is it yours?", options.tap))?;
    let epoch = time::SystemTime::now().duration_since(time::UNIX_EPOCH)?.as_nanos() as u64;
    let manager = Target::Manager(Manager::new(&options.manager, options.manager_id)?);
    let mut settings = Settings::new(&options.name, options.id, manager, options.address.octets(), 24, epoch)?;
    settings.node.fleet = Fleet(options.fleet);
    let [_, _, third, fourth] = options.address.octets();
    let resources: &'static mut Resources = Box::leak(Box::default());
    let mut unit = SUnit::new(now(), settings, [2, 0xCA, 0x7A, 0, third, fourth], &mut device, resources);
    let mut vehicle = offer(&mut unit, now())?;
    let mut ticked = now();
    while !stopped() {
        let due = unit.poll(now(), &mut device, &mut vehicle);
        let ticks = now();
        if ticks >= ticked + TICK {
            let live = vehicle.lease.is_live(ticks);
            if let Some(Progress::Arrived(place)) = vehicle.agv.step(ticks.since(ticked), live) {
                println!("arrived at {place}");
            }
            if let Some(order) = vehicle.agv.finished() {
                unit.end_order(now(), vehicle.lease, order);
            }
            ticked = ticks;
        }
        sleep(&device, due.min(ticked + TICK).since(now()))?;
    }
    Ok(())
}

fn offer(unit: &mut SUnit, now: Instant) -> Result<Vehicle> {
    static LEASE: Lease = Lease::new();
    let plain = Attributes::default();
    let vehicle = Vehicle {
        agv: Agv::new([0, 0]),
        pos_info: unit.offer(now, &Definition::parse(POS_INFO)?, plain, None)?,
        battery: unit.offer(now, &Definition::parse(BATTERY)?, plain, None)?,
        stop: unit.offer(
            now,
            &Definition::parse(STOP)?,
            Attributes { priority: Priority::Emergency, stop: true, ..plain },
            None,
        )?,
        reset: unit.offer(now, &Definition::parse(RESET)?, Attributes { reset: true, ..plain }, None)?,
        lease: &LEASE,
    };
    let leased = Attributes { lease: Some(GO_TO_LEASE), ..plain };
    unit.offer(now, &Definition::parse(GO_TO)?, leased, Some(&LEASE))?;
    Ok(vehicle)
}

/// Waits for a frame, at most for `span`.
fn sleep(device: &TunTapInterface, span: Duration) -> Result<()> {
    if span > Duration::ZERO {
        let span = smoltcp::time::Duration::from_micros(span.as_micros());
        wait(device.as_raw_fd(), Some(span)).context("cannot wait for the device")?;
    }
    Ok(())
}
