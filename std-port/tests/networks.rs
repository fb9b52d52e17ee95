//! Networks that break between two hosts while a manager calls its vehicle: what is lost, and how long until calls are answered again.
//! `cargo xtask networks` runs it; it needs root.

mod keyed;

use std::collections::HashMap;
use std::fmt::Write;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::Result;
use cara_processes::network::{self, filter};
use cara_processes::random_fleet;
use cara_processes::switch::Switch;
use cara_std::control::Control;
use cara_std::{CommunicationSystem, Interfaces, Parameters, RequestOptions, Unit};

/// How long a call waits for its answer.
const TIMEOUT: Duration = Duration::from_millis(500);
/// A call that goes on for so much longer has no outcome.
const LATE: Duration = Duration::from_secs(2);
/// From the end of a fault until calls are answered.
const PATIENCE: Duration = Duration::from_secs(90);
/// Answered calls before the next fault.
const CALM: usize = 20;
/// How long faults last at least, and how much longer they are from one to the next, up to 12 s.
const SHORTEST: Duration = Duration::from_millis(500);

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

/// How often the vehicle ran the call of each number.
type Runs = Arc<Mutex<HashMap<i64, usize>>>;

struct Pair {
    manager: CommunicationSystem,
    _vehicle: Unit,
    runs: Runs,
    /// Calls by number, and whether they were answered.
    calls: Vec<bool>,
    /// Answers that were another call's, and calls without an outcome.
    wrong: usize,
}

impl Pair {
    fn join(switch: &Switch) -> Result<Self> {
        let (manager, vehicle) = keyed::pair(random_fleet());
        let runs = Runs::default();
        let ran = runs.clone();
        let vehicle = switch.hosts[VEHICLE].within(|| {
            let vehicle = vehicle.interfaces(Interfaces::All).build()?;
            vehicle.my_function_list().add_function("count", &numbered(0)?, move |arguments: Parameters| {
                let number = arguments.variable("number").unwrap_or(-1);
                *ran.lock().unwrap().entry(number).or_default() += 1;
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
        Ok(Self { manager, _vehicle: vehicle, runs, calls: Vec::new(), wrong: 0 })
    }

    /// Whether a call was answered.
    fn call(&mut self) -> bool {
        let number = self.calls.len() as i64;
        let mut arguments = numbered(number).unwrap();
        let options = RequestOptions { timeout: Some(TIMEOUT.into()), ..RequestOptions::default() };
        let began = Instant::now();
        let called = self.manager.s_unit("agv").map(|peer| peer.call("count", &mut arguments).with(options).wait());
        let is_answered = matches!(called, Ok(Ok(())));
        self.wrong += usize::from(began.elapsed() > TIMEOUT + LATE);
        self.wrong += usize::from(is_answered && arguments.variable("number") != Ok(number));
        self.calls.push(is_answered);
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

    /// Calls that ran twice or were answered and never ran, and what else went wrong.
    fn lost(&self) -> usize {
        let runs = self.runs.lock().unwrap();
        let of = |number: usize| runs.get(&(number as i64)).copied().unwrap_or(0);
        let is_wrong = |(number, is_answered): (usize, &bool)| of(number) > 1 || *is_answered && of(number) == 0;
        self.wrong + self.calls.iter().enumerate().filter(|call| is_wrong(*call)).count()
    }
}

#[test]
fn calls_go_on_behind_each_fault() {
    if !network::test("calls_go_on_behind_each_fault", &["nft", "tc"], true) {
        return;
    }
    let each: usize = std::env::var("CARA_EACH").map_or(3, |each| each.parse().unwrap());
    let kind = std::env::var("CARA_KIND").unwrap_or_default();
    let switch = Switch::of(2).unwrap();
    let mut pair = Pair::join(&switch).unwrap();
    pair.recover();
    let mut table = String::from(
        "| fault | injections | calls; not answered | lost | recovery: median | 99 % | worst |\n|---|---|---|---|---|---|---|\n",
    );
    for fault in FAULTS.iter().filter(|fault| fault.name.contains(&kind)) {
        let (first, lost) = (pair.calls.len(), pair.lost());
        let mut took: Vec<_> = (0..each).map(|number| break_once(&mut pair, &switch, fault, number, each)).collect();
        took.sort_unstable();
        let calls = &pair.calls[first..];
        let (count, failed, lost) = (calls.len(), calls.iter().filter(|call| !**call).count(), pair.lost() - lost);
        let at = |percent: usize| took[(took.len() * percent).div_ceil(100) - 1].as_secs_f64();
        let spans = [50, 99, 100].map(at);
        let spans = spans.map(|span| format!("{span:.2} s")).join(" | ");
        writeln!(table, "| {} | {each} | {count}; {failed} | {lost} | {spans} |", fault.name).unwrap();
    }
    println!("{table}");
    assert_eq!(pair.lost(), 0, "calls that ran twice, were answered and never ran, or had no outcome");
}

/// A fault of a length of its own, between 0.5 and 12 s; how long it took from its end until a call was answered.
fn break_once(pair: &mut Pair, switch: &Switch, fault: &Fault, number: usize, each: usize) -> Duration {
    let mut answered = 0;
    while answered < CALM {
        answered = if pair.call() { answered + 1 } else { 0 };
    }
    (fault.begin)(switch, number).unwrap();
    let lasts = SHORTEST + Duration::from_millis(11_500 * number as u64 / each.max(2) as u64);
    let end = Instant::now() + lasts;
    // What an address that changed breaks is over at once.
    while Instant::now() < end && fault.name != "another address" {
        pair.call();
    }
    (fault.end)(switch).unwrap();
    pair.recover()
}
