//! `cara line` at both ends of a wire of two pseudo-terminals that damages bytes and can be pulled: a vehicle and its manager,
//! which have nothing else in common, since each searches on a port of its own.

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cara_processes::ticker::unless_held_up;
use cara_processes::{Process, discovery_port, random_fleet};
use cara_std::control::Control;
use cara_std::{
    CommunicationSystem, Error, Identity, Interfaces, LeaseWatch, Parameters, ParametersView, Peer, Priority, Renew,
    RequestOptions, Served, ServiceError, ServiceOptions, Unit,
};
use cara_test_keys::KeyFolder;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(60);
const LEASE: Duration = Duration::from_millis(1_600);
const NUMBER: &str = "(number: int[1]) -> (number: int[1])";
const TEXT: &str = "(text: string[4000]) -> (text: string[4000])";

#[track_caller]
fn until(what: &str, condition: impl Fn() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < PATIENCE, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// What happens to the bytes of a wire.
#[derive(Default)]
struct Faults {
    /// Nothing comes through.
    pulled: AtomicBool,
    /// One byte in so many is damaged, and one is lost; 0 for none.
    damaged: AtomicU64,
}

/// Both ends of a line, each with its bridge.
struct Wire {
    faults: Arc<Faults>,
    ports: [u16; 2],
    _bridges: [Process; 2],
}

impl Wire {
    fn new(baud: u32, fleet: u32, more: &[&str]) -> Self {
        let faults = Arc::<Faults>::default();
        let ports = [discovery_port(), discovery_port()];
        let ends = [terminal(), terminal()];
        for (from, to) in [(0, 1), (1, 0)] {
            let [from, to] = [from, to].map(|end: usize| ends[end].0.try_clone().unwrap());
            let faults = faults.clone();
            std::thread::spawn(move || carry(from, to, baud, &faults));
        }
        let bridges = [0, 1].map(|end| {
            let words = ["line", &ends[end].1, "--baud", &baud.to_string()].map(String::from);
            let options =
                ["--fleet", &fleet.to_string(), "--discovery-port", &ports[end].to_string()].map(String::from);
            let words = words.into_iter().chain(options).chain(more.iter().map(ToString::to_string));
            let mut bridge = Process::start("line", Path::new(env!("CARGO_BIN_EXE_cara")), words).unwrap();
            bridge.expect("open", PATIENCE).unwrap();
            bridge
        });
        Self { faults, ports, _bridges: bridges }
    }

    fn pull(&self, is_pulled: bool) {
        self.faults.pulled.store(is_pulled, Ordering::SeqCst);
    }
}

/// A terminal: our end, and the name of the other one.
fn terminal() -> (File, String) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
    (master.into(), name)
}

/// Carries bytes at the wire's rate, until its terminals are gone.
fn carry(mut from: File, mut to: File, baud: u32, faults: &Faults) {
    let mut buffer = [0; 256];
    let mut state = 1_u64;
    let mut is_one_in = move |many: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        many > 0 && (state >> 33).is_multiple_of(many)
    };
    loop {
        let count = match from.read(&mut buffer) {
            Ok(count) => count,
            // The bridge has not opened its end yet, or has closed it.
            Err(_) => {
                std::thread::sleep(Duration::from_millis(10));
                continue;
            }
        };
        // A terminal has a frame at once, a wire when its last bit is out.
        std::thread::sleep(Duration::from_micros(count as u64 * 10_000_000 / u64::from(baud)));
        let damaged = faults.damaged.load(Ordering::SeqCst);
        let mut bytes = buffer[..count].to_vec();
        bytes.iter_mut().filter(|_| is_one_in(damaged)).for_each(|byte| *byte ^= 0x10);
        bytes.retain(|_| !is_one_in(damaged));
        if !faults.pulled.load(Ordering::SeqCst) && to.write_all(&bytes).is_err() {
            return;
        }
    }
}

struct Fleet {
    wire: Wire,
    _manager: CommunicationSystem,
    agv: Unit<i64>,
    peer: Peer,
    lease: LeaseWatch,
    stops: Arc<AtomicUsize>,
}

impl Fleet {
    /// A vehicle that has joined its manager over the line.
    fn new(baud: u32, damaged: u64, keys: bool) -> Self {
        let fleet = random_fleet();
        let wire = Wire::new(baud, fleet, if keys { &[] } else { &["--insecure"] });
        wire.faults.damaged.store(damaged, Ordering::SeqCst);
        let manager = CommunicationSystem::builder("manager", 1).unwrap().fleet(fleet).control(Control::Off);
        let agv = Unit::builder("agv", 7, "manager", 1).unwrap().fleet(fleet);
        let manager = manager.interfaces(Interfaces::Loopback).discovery_port(wire.ports[0]);
        let agv = agv.interfaces(Interfaces::Loopback).discovery_port(wire.ports[1]);
        let (manager, agv) = if keys {
            let keys = KeyFolder::draw(fleet, &["manager/1@m_unit", "agv/7"]).unwrap();
            let file = |identity| keys.file(&identity).unwrap();
            let agv = agv.key_file(file(Identity::s_unit("agv", 7).unwrap()));
            let manager = manager.key_file(file(Identity::m_unit("manager", 1).unwrap()));
            (manager.build().unwrap(), agv.state(0_i64).build().unwrap())
        } else {
            (manager.insecure().build().unwrap(), agv.insecure().state(0_i64).build().unwrap())
        };
        let stops = Arc::new(AtomicUsize::new(0));
        let lease = offer(&agv, &stops);
        let start = Instant::now();
        manager.start().unwrap();
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
        until("the vehicle has joined", || manager.number_of_s_units() == 1);
        let peer = manager.s_unit("agv").unwrap();
        until("its list has come", || peer.their_function_list().len() == agv.my_function_list().len());
        println!("{baud} baud, {}: joined after {:?}", if keys { "secured" } else { "plain" }, start.elapsed());
        Self { wire, _manager: manager, agv, peer, lease, stops }
    }

    fn call(&self, function: &str, parameters: &mut ParametersView, renew: Renew) -> Result<(), Error> {
        let options = RequestOptions { timeout: Some(PATIENCE.into()), renew, ..RequestOptions::default() };
        self.peer.call(function, parameters).with(options).wait().map(drop).map_err(Error::from)
    }

    fn speed(&self) -> i64 {
        self.agv.with_state(|speed| *speed).unwrap()
    }

    /// Drives for two leases, and goes on driving.
    fn drive(&self) {
        self.call("drive", &mut number(5), Renew::Process).unwrap();
        let start = Instant::now();
        while start.elapsed() < 2 * LEASE {
            assert!(self.lease.is_live() && self.speed() == 5);
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// `drive` under a lease, `echo`, and an emergency.
fn offer(agv: &Unit<i64>, stops: &Arc<AtomicUsize>) -> LeaseWatch {
    let list = agv.my_function_list();
    let stopped = stops.clone();
    let safe = move || {
        stopped.fetch_add(1, Ordering::SeqCst);
    };
    let drive = |speed: &mut i64, _: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
        *speed = parameters.variable("number")?;
        Ok(())
    };
    let echo = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let options = ServiceOptions::new().lease(LEASE, safe).then(|speed: &mut i64| *speed = 0);
    let lease = list.add_service(&format!("drive{NUMBER}").parse().unwrap(), options, drive).unwrap();
    list.add_service(&format!("echo{TEXT}").parse().unwrap(), ServiceOptions::new(), echo).unwrap();
    let urgent = ServiceOptions::new().priority(Priority::Emergency);
    list.add_service(&format!("urgent{NUMBER}").parse().unwrap(), urgent, echo).unwrap();
    lease
}

fn number(value: i64) -> Parameters {
    let mut parameters = Parameters::new();
    parameters.add_int("number", 1).unwrap();
    parameters.set_value("number", value).unwrap();
    parameters
}

fn text(length: usize) -> Parameters<5_000> {
    let mut parameters = Parameters::sized();
    parameters.add_string("text", 4_000).unwrap();
    parameters.set_value("text", "x".repeat(length).as_str()).unwrap();
    parameters
}

#[test]
fn a_vehicle_on_a_bad_line_joins_is_called_and_drives() {
    unless_held_up(LEASE, || {
        let fleet = Fleet::new(115_200, 3_000, false);
        for length in [0, 100, 4_000] {
            let mut parameters = text(length);
            fleet.call("echo", &mut parameters, Renew::Never).unwrap();
            let came: &str = parameters.variable("text").unwrap();
            assert_eq!(came.len(), length);
        }
        fleet.call("urgent", &mut number(1), Renew::Never).unwrap();
        fleet.wire.faults.damaged.store(0, Ordering::SeqCst);
        fleet.drive();
    });
}

#[test]
fn a_vehicle_whose_line_is_pulled_stops_with_its_lease_and_comes_back() {
    unless_held_up(LEASE, || {
        let fleet = Fleet::new(115_200, 0, true);
        fleet.drive();
        assert_eq!(fleet.stops.load(Ordering::SeqCst), 0);
        let pulled = Instant::now();
        fleet.wire.pull(true);
        until("the safe hook has run", || fleet.stops.load(Ordering::SeqCst) == 1);
        let after = pulled.elapsed();
        assert!(!fleet.lease.is_live() && after < LEASE + Duration::from_secs(10), "{after:?}");
        until("what needs the state has run behind it", || fleet.speed() == 0);
        until("the vehicle has lost its manager", || !fleet.agv.is_connected());
        fleet.wire.pull(false);
        until("it is back", || fleet.agv.is_connected() && fleet.peer.is_connected());
        until("it is called again", || fleet.call("echo", &mut text(1), Renew::Never).is_ok());
        assert_eq!((fleet.speed(), fleet.stops.load(Ordering::SeqCst)), (0, 1));
    });
}

#[test]
fn a_device_that_cannot_be_opened_is_named() {
    let ran = Command::new(env!("CARGO_BIN_EXE_cara")).args(["line", "/nowhere/tty"]).output().unwrap();
    let said = String::from_utf8(ran.stderr).unwrap();
    assert!(ran.status.code() == Some(1) && said.contains("/nowhere/tty cannot be used at 115200 baud"), "{said}");
}

/// How long calls take, alone and an emergency beside a long message, and which of the two is done first.
fn emergency_beside_bulk(baud: u32) -> bool {
    let fleet = Fleet::new(baud, 0, false);
    let start = Instant::now();
    fleet.call("echo", &mut text(20), Renew::Never).unwrap();
    let call = start.elapsed();
    std::thread::scope(|scope| {
        let bulk = scope.spawn(|| fleet.call("echo", &mut text(4_000), Renew::Never).unwrap());
        // The message is on the wire by then, and takes another thirty frames each way.
        std::thread::sleep(Duration::from_micros(5 * 1_280_000_000 / u64::from(baud)));
        let start = Instant::now();
        fleet.call("urgent", &mut number(1), Renew::Never).unwrap();
        println!("{baud} baud: a call {call:?}, an emergency beside a long message {:?}", start.elapsed());
        !bulk.is_finished()
    })
}

#[test]
fn an_emergency_overtakes_a_long_message() {
    assert!(emergency_beside_bulk(19_200), "the long message was done first");
}

#[test]
#[ignore = "prints figures"]
fn figures() {
    for baud in [19_200, 115_200, 1_000_000] {
        emergency_beside_bulk(baud);
    }
}
