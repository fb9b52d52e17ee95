//! Units of the Linux port on loopback: a manager that attackers dial, and vehicles that dial an attacker.

use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_core::distribution::identity::Identity;
use cara_std::access::AccessTable;
use cara_std::control::Control;
use cara_std::{Builder, CommunicationSystem, Constraints, Interfaces, Manager, Threads, Unit};

use crate::event_log::EventLog;
use crate::ground::{Ground, agv, depot};
use crate::speaker::{Claim, PATIENCE};
use crate::tally::Counters;
use crate::target::{Seen, Target, Visit};

/// Between the end of a connection and its last event in the application.
const SETTLING: Duration = Duration::from_millis(4);

/// What is wrong with a unit, on purpose: the attacks must find it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Weakness {
    /// Nothing.
    #[default]
    None,
    /// It is in plain mode, on the port of secured units.
    Plain,
    /// Its access table allows everything.
    Open,
}

/// Makes units of one fleet.
pub struct Linux {
    /// Their keys.
    pub ground: Ground,
    /// Their threads.
    pub threads: Threads,
    /// Their discovery port.
    pub port: u16,
    /// What is wrong with them.
    pub weakness: Weakness,
}

impl Linux {
    /// A fleet with so many vehicles, on a port of its own.
    pub fn new(vehicles: u32, weakness: Weakness) -> Result<Self> {
        let port = std::net::UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?.port();
        Ok(Self { ground: Ground::new(vehicles), threads: Threads::new()?, port, weakness })
    }

    fn prepared<R>(&self, builder: Builder<(), R>, identity: &Identity) -> Builder<(), R> {
        let builder = builder
            .fleet(self.ground.fleet.0)
            .interfaces(Interfaces::Loopback)
            .threads(&self.threads)
            .discovery_port(self.port);
        match self.weakness {
            Weakness::Plain => builder.insecure(),
            _ => builder.keys(self.ground.ring(identity)),
        }
    }

    /// A manager that runs and offers its functions.
    pub fn manager(&self) -> Result<LinuxManager<'_>> {
        // The capacity is below the number of links that attackers hold.
        let constraints = Constraints { maximum_nodes: 64, ..Constraints::M_UNIT };
        let builder = CommunicationSystem::builder("depot", 1)?.constraints(constraints);
        let system = self.prepared(builder, &depot()).control(Control::Off).build()?;
        let log = EventLog::default();
        log.offer(&system.my_function_list())?;
        log.follow(system.events());
        system.publish_my_function_list()?;
        system.start()?;
        Ok(LinuxManager { linux: self, system, log, next: AtomicU32::new(0) })
    }

    /// A vehicle that runs and offers its functions; its manager is at an address, or found by discovery.
    pub fn vehicle(&self, id: u32, manager: Option<SocketAddr>) -> Result<(Unit, EventLog)> {
        let builder = self.prepared(Unit::builder("agv", id, "depot", 1)?, &agv(id));
        let builder = manager.into_iter().fold(builder, Builder::manager_address);
        let unit = builder.build()?;
        let log = EventLog::default();
        log.offer(&unit.my_function_list())?;
        log.follow(unit.events());
        unit.publish_my_function_list()?;
        unit.start()?;
        Ok((unit, log))
    }

    /// The vehicle's claim on a link with its manager.
    pub fn claim_of(&self, vehicle: u32) -> Claim {
        let wanted = Manager::new("depot", 1).ok();
        Claim { fleet: self.ground.fleet, identity: agv(vehicle), wanted }
    }

    /// The manager's claim.
    pub fn claim_of_manager(&self) -> Claim {
        Claim { fleet: self.ground.fleet, identity: depot(), wanted: None }
    }
}

/// Counters of a unit.
pub fn named(counters: Vec<(&'static str, u64)>) -> Counters {
    counters.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

/// Waits until `condition` holds; whether it came to.
pub fn wait_for(condition: impl Fn() -> bool) -> bool {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        if Instant::now() > end {
            return false;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    true
}

/// A manager: attackers dial it, as vehicles.
pub struct LinuxManager<'l> {
    linux: &'l Linux,
    /// The unit.
    pub system: CommunicationSystem,
    /// What it has seen.
    pub log: EventLog,
    next: AtomicU32,
}

impl LinuxManager<'_> {
    /// Where it takes connections.
    pub fn address(&self) -> SocketAddr {
        (Ipv4Addr::LOCALHOST, self.system.tcp_port()).into()
    }

    /// The vehicle number that has been unused for the longest time.
    pub fn next_vehicle(&self) -> u32 {
        self.linux.ground.vehicle(self.next.fetch_add(1, Ordering::Relaxed))
    }
}

impl Target for LinuxManager<'_> {
    fn name(&self) -> &str {
        "Linux m_unit"
    }

    fn workers(&self) -> usize {
        8
    }

    fn visit(&self) -> Result<Visit<'_>> {
        let vehicle = self.next_vehicle();
        let who = agv(vehicle);
        let before = self.log.seen(&who);
        let seen = move || {
            std::thread::sleep(SETTLING);
            let Seen { joins, marks } = self.log.seen(&who);
            Ok(Seen { joins: joins - before.joins, marks: marks.into_iter().skip(before.marks.len()).collect() })
        };
        Ok(Visit {
            stream: TcpStream::connect(self.address())?,
            dials: true,
            claim: self.linux.claim_of(vehicle),
            keys: self.linux.ground.keys(vehicle),
            seen: Box::new(seen),
        })
    }

    fn counters(&self) -> Result<Counters> {
        Ok(named(self.system.counters()))
    }
}

/// Vehicles, a new one for each visit: they dial the attacker, as their manager.
pub struct LinuxVehicles<'l> {
    linux: &'l Linux,
    next: AtomicU32,
    /// What vehicles that are gone have counted.
    counted: Mutex<Counters>,
}

impl<'l> LinuxVehicles<'l> {
    /// None yet.
    pub fn new(linux: &'l Linux) -> Self {
        Self { linux, next: AtomicU32::new(0), counted: Mutex::default() }
    }

    /// The vehicle number that has been unused for the longest time.
    pub fn next_vehicle(&self) -> u32 {
        self.linux.ground.vehicle(self.next.fetch_add(1, Ordering::Relaxed))
    }

    /// Stops a vehicle and keeps what it has counted.
    pub fn retire(&self, unit: &Unit) {
        unit.stop();
        let mut counted = self.counted.lock().unwrap_or_else(PoisonError::into_inner);
        for (name, value) in unit.counters() {
            *counted.entry(name.to_owned()).or_default() += value;
        }
    }
}

/// A vehicle that is stopped when the last handle to it is dropped.
struct Guest<'t> {
    unit: Unit,
    log: EventLog,
    vehicles: &'t LinuxVehicles<'t>,
    _listener: TcpListener,
}

impl Drop for Guest<'_> {
    fn drop(&mut self) {
        self.vehicles.retire(&self.unit);
    }
}

impl Target for LinuxVehicles<'_> {
    fn name(&self) -> &str {
        "Linux s_unit"
    }

    fn workers(&self) -> usize {
        40
    }

    fn visit(&self) -> Result<Visit<'_>> {
        let vehicle = self.next_vehicle();
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
        let (unit, log) = self.linux.vehicle(vehicle, Some(listener.local_addr()?))?;
        let stream = accept(&listener).context("a vehicle dials its manager")?;
        let guest = Guest { unit, log, vehicles: self, _listener: listener };
        let seen = move || {
            std::thread::sleep(SETTLING);
            guest.unit.stop();
            Ok(guest.log.all())
        };
        Ok(Visit {
            stream,
            dials: false,
            claim: self.linux.claim_of_manager(),
            keys: self.linux.ground.keys(vehicle),
            seen: Box::new(seen),
        })
    }

    fn counters(&self) -> Result<Counters> {
        Ok(self.counted.lock().unwrap_or_else(PoisonError::into_inner).clone())
    }
}

/// The next connection, within a generous time.
pub fn accept(listener: &TcpListener) -> Result<TcpStream> {
    listener.set_nonblocking(true)?;
    // A vehicle whose link was refused searches again after a back-off of up to 16 s.
    let end = Instant::now() + 4 * PATIENCE;
    loop {
        match listener.accept() {
            Ok((stream, _)) => {
                stream.set_nonblocking(false)?;
                return Ok(stream);
            }
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            Err(error) => return Err(error.into()),
        }
        ensure!(Instant::now() < end, "no connection arrived");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A table for a unit, unless its weakness is that it has none.
pub fn guarded(weakness: Weakness, table: AccessTable) -> Option<AccessTable> {
    (weakness != Weakness::Open).then_some(table)
}
