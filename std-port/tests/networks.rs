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
use cara_std::{CommunicationSystem, Interfaces, Parameters, RequestOptions, Unit};

/// What breaks.
struct Fault {
    name: &'static str,
    begin: fn(&Switch, usize) -> Result<()>,
    end: fn(&Switch) -> Result<()>,
}

const MANAGER: usize = 0;
const VEHICLE: usize = 1;

const FAULTS: [Fault; 10] = [
    Fault { name: "cut both ways", begin: |switch, _| switch.cut(VEHICLE, true, true), end: Switch::mend },
    Fault { name: "cut towards the vehicle", begin: |switch, _| switch.cut(VEHICLE, false, true), end: Switch::mend },
    Fault { name: "cut towards the manager", begin: |switch, _| switch.cut(VEHICLE, true, false), end: Switch::mend },
    Fault {
        name: "30 % of packets lost",
        begin: |switch, _| input(switch, "numgen random mod 100 < 30 drop"),
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
    Fault { name: "another address", begin: roam, end: |_| Ok(()) },
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

fn roam(switch: &Switch, number: usize) -> Result<()> {
    switch.hosts[VEHICLE].run("ip address flush dev wire")?;
    let address = format!("10.77.0.{}/24", 10 + number % 200);
    switch.hosts[VEHICLE].run(&format!("ip address add {address} broadcast + dev wire"))
}

fn numbered(number: i64) -> Result<Parameters> {
    let mut parameters = Parameters::new();
    parameters.add_int("number", 1)?;
    parameters.set_value("number", number)?;
    Ok(parameters)
}

struct Pair {
    manager: CommunicationSystem,
    _vehicle: Unit,
    calls: Arc<Mutex<Calls>>,
    next: i64,
}

impl Pair {
    fn join(switch: &Switch) -> Result<Self> {
        let (manager, vehicle) = keyed::pair(random_fleet());
        let calls = Arc::<Mutex<Calls>>::default();
        let run = calls.clone();
        let vehicle = switch.hosts[VEHICLE].within(|| {
            let vehicle = vehicle.interfaces(Interfaces::All).build()?;
            vehicle.my_function_list().add_function("count", &numbered(0)?, move |arguments: Parameters| {
                let number = arguments.variable("number").unwrap_or(-1);
                run.lock().unwrap().ran(number);
                arguments
            })?;
            vehicle.publish_my_function_list()?;
            vehicle.start()?;
            Ok(vehicle)
        })?;
        let manager = switch.hosts[MANAGER].within(|| {
            let manager = manager.interfaces(Interfaces::All).control(Control::Off).build()?;
            manager.start()?;
            Ok(manager)
        })?;
        Ok(Self { manager, _vehicle: vehicle, calls, next: 0 })
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
    let switch = Switch::of(2).unwrap();
    let mut pair = Pair::join(&switch).unwrap();
    pair.recover();
    let mut table = Table::new(&[]);
    for fault in FAULTS.iter().filter(|fault| fault.name.contains(&kind)) {
        let before = pair.counts();
        let mut took: Vec<_> = (0..each).map(|number| break_once(&mut pair, &switch, fault, number, each)).collect();
        let (count, failed, lost) = pair.counts();
        table.row(fault.name, &mut took, (count - before.0, failed - before.1), lost - before.2, &[]);
    }
    println!("{table}");
    assert_eq!(pair.counts().2, 0, "calls that ran twice, were answered and never ran, or had no outcome");
}

/// A fault of a length of its own, between 0.5 and 12 s; how long it took from its end until a call was answered.
fn break_once(pair: &mut Pair, switch: &Switch, fault: &Fault, number: usize, each: usize) -> Duration {
    let mut answered = 0;
    while answered < CALM {
        answered = if pair.call() { answered + 1 } else { 0 };
    }
    (fault.begin)(switch, number).unwrap();
    let end = Instant::now() + faults::lasts(number, each);
    // What an address that changed breaks is over at once.
    while Instant::now() < end && fault.name != "another address" {
        pair.call();
    }
    (fault.end)(switch).unwrap();
    pair.recover()
}
