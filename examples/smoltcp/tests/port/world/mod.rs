//! A manager and vehicles on one Ethernet switch in memory, in virtual time. Both ends have smoltcp below; the vehicles
//! are the port under test, the manager is the core's machines driven by hand.

pub(crate) mod manager;
pub(crate) mod vehicle;

use std::cell::RefCell;
use std::rc::Rc;

use cara_core::time::{Duration, Instant};
use cara_ethernet::{Faults, Mac, PortId, Switch};
use smoltcp::phy::{self, Device, DeviceCapabilities, Medium};

use manager::Manager;
use vehicle::Vehicle;

/// What a poll costs in virtual time, so that one that is due again at once does not stop the clock.
const POLL: Duration = Duration::from_micros(1);

/// The switch, shared by the nodes that are connected to it.
pub(crate) type SharedSwitch = Rc<RefCell<Switch>>;

/// The network device of one node: a cable to the switch.
pub(crate) struct Cable {
    pub(crate) switch: SharedSwitch,
    pub(crate) port: PortId,
}

/// A received frame.
pub(crate) struct Received(Vec<u8>);

/// A frame to be sent.
pub(crate) struct Sent<'c>(&'c Cable, Instant);

impl Cable {
    /// A cable to a new port.
    pub(crate) fn new(switch: &SharedSwitch, mac: [u8; 6]) -> Self {
        let port = switch.borrow_mut().add_port(Mac(mac));
        Self { switch: Rc::clone(switch), port }
    }
}

impl Device for Cable {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sent<'a>;

    fn receive(&mut self, now: smoltcp::time::Instant) -> Option<(Received, Sent<'_>)> {
        let now = Instant::from_micros(now.total_micros() as u64);
        let frame = self.switch.borrow_mut().receive(now, self.port)?;
        Some((Received(frame), Sent(self, now)))
    }

    fn transmit(&mut self, now: smoltcp::time::Instant) -> Option<Sent<'_>> {
        Some(Sent(self, Instant::from_micros(now.total_micros() as u64)))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = 1_514;
        capabilities
    }
}

impl phy::RxToken for Received {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, take: F) -> R {
        take(&self.0)
    }
}

impl phy::TxToken for Sent<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, fill: F) -> R {
        let mut frame = vec![0; length];
        let result = fill(&mut frame);
        self.0.switch.borrow_mut().send(self.1, self.0.port, &frame);
        result
    }
}

/// Everything that is on one switch.
pub(crate) struct World {
    pub(crate) switch: SharedSwitch,
    pub(crate) now: Instant,
    pub(crate) manager: Option<Manager>,
    pub(crate) vehicles: Vec<Vehicle>,
    seed: u64,
}

impl World {
    /// A manager, and as many vehicles that look for it.
    pub(crate) fn new(seed: u64, vehicles: usize, faults: Faults) -> Self {
        let switch: SharedSwitch = Rc::new(RefCell::new(Switch::new(seed)));
        let now = Instant::from_micros(1_000);
        let manager = Some(Manager::new(now, Cable::new(&switch, manager::mac(manager::HOST)), manager::HOST, seed));
        let vehicle = |number| Vehicle::new(now, &switch, number, seed, vehicle::by_broadcast());
        let vehicles = (1..=vehicles as u8).map(vehicle).collect();
        switch.borrow_mut().set_faults(faults);
        Self { switch, now, manager, vehicles, seed }
    }

    /// Replaces the vehicles by one that dials a fixed address.
    pub(crate) fn dialing(seed: u64) -> Self {
        let mut world = Self::new(seed, 0, Faults::NONE);
        world.vehicles.push(Vehicle::new(world.now, &world.switch, 1, seed, vehicle::by_address()));
        world
    }

    /// Runs until `done` or for `limit`; whether it is done.
    pub(crate) fn run_until(&mut self, limit: Duration, mut done: impl FnMut(&mut Self) -> bool) -> bool {
        let end = self.now + limit;
        loop {
            let next = self.step();
            if done(self) {
                return true;
            }
            if next > end {
                self.now = self.now.max(end);
                return false;
            }
            self.now = next.max(self.now + POLL);
        }
    }

    pub(crate) fn run(&mut self, span: Duration) {
        self.run_until(span, |_| false);
    }

    /// Polls the nodes that are due; returns when the next one is.
    fn step(&mut self) -> Instant {
        let now = self.now;
        for vehicle in self.vehicles.iter_mut().filter(|vehicle| vehicle.next() <= now) {
            vehicle.poll(now);
        }
        if let Some(manager) = self.manager.as_mut().filter(|manager| manager.next() <= now) {
            manager.poll(now);
        }
        let vehicles = self.vehicles.iter().map(Vehicle::next).min().unwrap_or(Instant::FAR_FUTURE);
        vehicles.min(self.manager.as_ref().map_or(Instant::FAR_FUTURE, Manager::next))
    }

    pub(crate) fn all_joined(&mut self) -> bool {
        let count = self.vehicles.len();
        self.vehicles.iter().all(|vehicle| vehicle.unit.is_connected())
            && self.manager.as_ref().is_some_and(|manager| manager.joined() == count)
    }

    /// Runs until all nodes have joined and know each other's functions.
    pub(crate) fn join(&mut self) {
        let seed = self.seed;
        assert!(self.run_until(Duration::from_secs(60), Self::all_joined), "nobody joined, seed {seed}");
        self.run(Duration::from_millis(100));
    }

    pub(crate) fn manager(&mut self) -> &mut Manager {
        self.manager.as_mut().expect("it is there")
    }

    /// Switches the manager off; it is switched on later, as another boot.
    pub(crate) fn power_cut(&mut self) -> Cable {
        self.manager.take().expect("it is there").cable
    }

    pub(crate) fn power_on(&mut self, cable: Cable, seed: u64) {
        // Discards what arrived while it was off.
        while self.switch.borrow_mut().receive(self.now, cable.port).is_some() {}
        self.manager = Some(Manager::new(self.now, cable, manager::HOST, seed));
    }

    /// The manager comes back on another host; the old one stays dark.
    pub(crate) fn power_on_elsewhere(&mut self, seed: u64) {
        let host = manager::HOST + 1;
        let cable = Cable::new(&self.switch, manager::mac(host));
        self.manager = Some(Manager::new(self.now, cable, host, seed));
    }

    pub(crate) fn set_link(&mut self, vehicle: usize, up: bool) {
        let port = self.vehicles[vehicle].cable.port;
        self.switch.borrow_mut().set_link(port, up);
    }

    pub(crate) fn set_faults(&mut self, faults: Faults) {
        self.switch.borrow_mut().set_faults(faults);
    }
}
