//! Networks that break between two hosts while a manager calls its vehicle: what is lost, and how long until calls are answered again.
//! `cargo xtask networks` runs it; it needs root.

mod keyed;

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::Result;
use cara_processes::faults::{self, CALM, Calls, PATIENCE, TIMEOUT, Table};
use cara_processes::network::{self, filter};
use cara_processes::random_fleet;
use cara_processes::switch::Switch;
use cara_std::control::Control;
use cara_std::{CommunicationSystem, Identity, Interfaces, Parameters, RequestOptions, Unit};
use keyed::keyed;

/// What breaks.
struct Fault {
    name: &'static str,
    begin: fn(&Switch, usize) -> Result<()>,
    end: fn(&Switch) -> Result<()>,
}

const MANAGER: usize = 0;
const VEHICLE: usize = 1;
const OTHER: usize = 2;

const FAULTS: [Fault; 12] = [
    Fault { name: "cut both ways", begin: |switch, _| switch.cut(VEHICLE, true, true), end: Switch::mend },
    Fault { name: "cut towards the vehicle", begin: |switch, _| switch.cut(VEHICLE, false, true), end: Switch::mend },
    Fault { name: "cut towards the manager", begin: |switch, _| switch.cut(VEHICLE, true, false), end: Switch::mend },
    Fault {
        name: "30 % of packets lost",
        begin: |switch, _| input(switch, "numgen random mod 100 < 30 drop"),
        end: heal,
    },
    Fault {
        name: "50 % of packets lost",
        begin: |switch, _| input(switch, "numgen random mod 100 < 50 drop"),
        end: heal,
    },
    Fault {
        name: "packets above 200 bytes lost",
        begin: |switch, _| input(switch, "meta length > 200 drop"),
        end: heal,
    },
    Fault { name: "broadcasts lost", begin: |switch, _| input(switch, "meta pkttype broadcast drop"), end: heal },
    Fault { name: "mapping forgotten: streams reset", begin: |switch, _| input(switch, RESET), end: heal },
    Fault { name: "16 kbit/s", begin: slow, end: fast },
    Fault { name: "cable pulled", begin: |switch, _| link(switch, "down"), end: |switch| link(switch, "up") },
    Fault {
        name: "two vehicles with one address",
        begin: |switch, _| address(switch, OTHER, VEHICLE + 1),
        end: |switch| address(switch, OTHER, OTHER + 1),
    },
    Fault {
        name: "another address",
        begin: |switch, number| address(switch, VEHICLE, 10 + number % 200),
        end: |_| Ok(()),
    },
];
/// As a router that has lost its table answers.
const RESET: &str = "meta l4proto tcp reject with tcp reset";

fn input(switch: &Switch, rule: &str) -> Result<()> {
    switch.hosts.iter().try_for_each(|host| host.within(|| filter("inet broken", "input", rule)))
}

fn heal(switch: &Switch) -> Result<()> {
    switch.hosts.iter().try_for_each(|host| host.run("nft delete table inet broken"))
}

fn slow(switch: &Switch, _: usize) -> Result<()> {
    let rule = "tc qdisc add dev wire root tbf rate 16kbit burst 1600 latency 200ms";
    switch.hosts.iter().try_for_each(|host| host.run(rule))
}

fn fast(switch: &Switch) -> Result<()> {
    switch.hosts.iter().try_for_each(|host| host.run("tc qdisc del dev wire root"))
}

fn link(switch: &Switch, state: &str) -> Result<()> {
    switch.hosts[VEHICLE].run(&format!("ip link set wire {state}"))
}

fn address(switch: &Switch, host: usize, last: usize) -> Result<()> {
    switch.hosts[host].run("ip address flush dev wire")?;
    switch.hosts[host].run(&format!("ip address add 10.77.0.{last}/24 broadcast + dev wire"))
}

fn numbered(number: i64) -> Result<Parameters> {
    let mut parameters = Parameters::new();
    parameters.add_int("number", 1)?;
    parameters.set_value("number", number)?;
    Ok(parameters)
}

/// A manager, its vehicle, and another vehicle of it that is never called.
struct Fleet {
    manager: CommunicationSystem,
    _vehicles: [Unit; 2],
    calls: Arc<Mutex<Calls>>,
    next: i64,
}

impl Fleet {
    fn join(switch: &Switch) -> Result<Self> {
        let fleet = random_fleet();
        let nodes = [Identity::m_unit("manager", 1)?, Identity::s_unit("agv", 7)?, Identity::s_unit("cart", 8)?];
        let calls = Arc::<Mutex<Calls>>::default();
        let vehicle = |own: &Identity, host: usize, ran: fn(&mut Calls, i64)| {
            let run = calls.clone();
            switch.hosts[host].within(|| {
                let vehicle = Unit::builder(own.name(), own.id(), "manager", 1)?.interfaces(Interfaces::All);
                let vehicle = keyed(vehicle, fleet, own, &nodes).build()?;
                vehicle.my_function_list().add_function("count", &numbered(0)?, move |arguments: Parameters| {
                    let number = arguments.variable("number").unwrap_or(-1);
                    ran(&mut run.lock().unwrap(), number);
                    arguments
                })?;
                vehicle.publish_my_function_list()?;
                vehicle.start()?;
                Ok(vehicle)
            })
        };
        let vehicles = [vehicle(&nodes[1], VEHICLE, Calls::ran)?, vehicle(&nodes[2], OTHER, Calls::strayed)?];
        let manager = switch.hosts[MANAGER].within(|| {
            let manager = CommunicationSystem::builder("manager", 1)?.interfaces(Interfaces::All).control(Control::Off);
            let manager = keyed(manager, fleet, &nodes[0], &nodes).build()?;
            manager.start()?;
            Ok(manager)
        })?;
        Ok(Self { manager, _vehicles: vehicles, calls, next: 0 })
    }

    /// Whether a call was answered.
    fn call(&mut self) -> bool {
        let number = self.next;
        self.next += 1;
        let mut arguments = numbered(number).unwrap();
        let options = RequestOptions { timeout: Some(TIMEOUT.into()), ..RequestOptions::default() };
        let began = Instant::now();
        let called = self.manager.s_unit("agv").map(|peer| peer.call("count", &mut arguments).with(options).wait());
        let is_answered = matches!(called, Ok(Ok(())));
        let answer = is_answered.then(|| arguments.variable("number").unwrap_or(-1));
        self.calls.lock().unwrap().ended(number, answer, began.elapsed(), Duration::ZERO);
        std::thread::sleep(Duration::from_millis(2));
        is_answered
    }

    /// Until a call is answered.
    fn recover(&mut self) -> Duration {
        let began = Instant::now();
        while !self.call() {
            assert!(began.elapsed() < PATIENCE, "no call is answered {PATIENCE:?} behind the fault");
        }
        began.elapsed()
    }

    /// How many calls there were, how many of them were not answered, and how many were lost.
    fn counts(&self) -> (usize, usize, usize) {
        let calls = self.calls.lock().unwrap();
        let (count, failed) = calls.counts();
        (count, failed, calls.lost())
    }
}

#[test]
fn calls_go_on_behind_each_fault() {
    if !network::test("calls_go_on_behind_each_fault", &["nft", "tc"], true) {
        return;
    }
    let (each, kind) = faults::options();
    let switch = Switch::of(3).unwrap();
    let mut fleet = Fleet::join(&switch).unwrap();
    fleet.recover();
    let mut table = Table::new(&[]);
    for fault in FAULTS.iter().filter(|fault| fault.name.contains(&kind)) {
        let before = fleet.counts();
        let mut took: Vec<_> = (0..each).map(|number| break_once(&mut fleet, &switch, fault, number, each)).collect();
        let (count, failed, lost) = fleet.counts();
        table.row(fault.name, &mut took, (count - before.0, failed - before.1), lost - before.2, &[]);
    }
    println!("{table}");
    assert_eq!(
        fleet.counts().2,
        0,
        "calls that ran twice or elsewhere, were answered and never ran, or had no outcome"
    );
}

/// A fault of a length of its own, between 0.5 and 12 s; how long it took from its end until a call was answered.
fn break_once(fleet: &mut Fleet, switch: &Switch, fault: &Fault, number: usize, each: usize) -> Duration {
    let mut answered = 0;
    while answered < CALM {
        answered = if fleet.call() { answered + 1 } else { 0 };
    }
    (fault.begin)(switch, number).unwrap();
    let end = Instant::now() + faults::lasts(number, each);
    // What an address that changed breaks is over at once.
    while Instant::now() < end && fault.name != "another address" {
        fleet.call();
    }
    (fault.end)(switch).unwrap();
    fleet.recover()
}
