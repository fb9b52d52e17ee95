//! Each example as processes, in a fleet of its own on loopback, within bounds of time.

use std::path::Path;
use std::time::{Duration, Instant};

use cara_apps::agv::GO_TO_LEASE;
use cara_processes::ticker::unless_held_up;
use cara_processes::{Process, random_fleet};
use cara_test_keys::KeyFolder;

/// How long a step may take on a machine that does other things as well.
const STEP: Duration = Duration::from_secs(30);
/// What is said of an order that was refused as `Busy`.
const BUSY: &str = "failed: the peer is busy";

/// Starts examples of one fleet, which have keys.
struct Fleet {
    number: String,
    keys: KeyFolder,
}

impl Fleet {
    fn new() -> Self {
        let number = random_fleet();
        let nodes = ["AGV_manager/1@m_unit", "zone-1/1@m_unit", "zone-2/2@m_unit", "agv-1/11", "agv-2/12", "seven/7"];
        Self { number: number.to_string(), keys: KeyFolder::draw(number, &nodes).unwrap() }
    }

    fn start(&self, name: &str, program: &str, arguments: &[&str]) -> Process {
        let keys = format!("CARA_KEYS={}", self.keys.path().display());
        let network = ["--loopback", "--fleet", &self.number];
        Process::start(name, Path::new("env"), [keys.as_str(), program].iter().chain(&network).chain(arguments))
            .unwrap()
    }
}

fn ends_well(process: &mut Process) {
    let status = process.wait(STEP).unwrap();
    assert!(status.success(), "{}: {status}", process.name());
}

/// A reset counts from the earliest time at which it can have been asked for: one right behind the stop is refused.
fn resets(manager: &mut Process) {
    let end = Instant::now() + STEP;
    manager.send("reset 0").unwrap();
    while manager.expect("= may drive again", Duration::from_millis(200)).is_err() {
        assert!(Instant::now() < end, "it is not reset: {:?}", manager.lines());
        manager.send("reset 0").unwrap();
    }
}

/// Runs a test in which orders last; again where the host held this process up for so long that a lease may have ended.
fn while_orders_last(test: impl Fn()) {
    unless_held_up(GO_TO_LEASE.into(), test);
}

/// The AGV arrives where the listing has sent it, before its order ends.
fn arrives(agv: &mut Process) {
    let outcome = agv.expect_any(&["arrived at", "the order has ended"], STEP).unwrap();
    assert_eq!(outcome.text, "arrived at [1.000, 2.000]");
}

/// Sends the AGV off. The first call may be told Busy: the link looks at the order that has ended when another one comes, or its
/// lease is over.
fn drives(agv: &mut Process, manager: &mut Process, [x, y]: [u32; 2]) {
    let refusals = |manager: &Process| manager.lines().iter().filter(|line| line.text.contains(BUSY)).count();
    let end = Instant::now() + STEP;
    let mut refused = refusals(manager);
    manager.send(&format!("go_to 0 {x} {y}")).unwrap();
    while agv.expect(&format!("driving to [{x}.000, {y}.000]"), Duration::from_millis(200)).is_err() {
        assert!(Instant::now() < end, "it does not drive: {:?}", manager.lines());
        if refusals(manager) > refused {
            refused = refusals(manager);
            manager.send(&format!("go_to 0 {x} {y}")).unwrap();
        }
    }
    manager.expect(&format!("= accepted [{x}, {y}]"), STEP).unwrap();
}

#[test]
fn the_listing_runs_and_both_end_when_asked_to() {
    while_orders_last(the_listing_runs);
}

fn the_listing_runs() {
    let fleet = Fleet::new();
    let mut manager = fleet.start("manager", env!("CARGO_BIN_EXE_agv_manager"), &[]);
    let mut agv = fleet.start("agv", env!("CARGO_BIN_EXE_agv"), &["--attended"]);
    for (number, outcome) in [(1, "AGV_manager/1"), (2, "started"), (9, "0 is agv-1/11"), (10, "shown")] {
        manager.expect(&format!("line {number}: "), STEP).unwrap();
        assert!(manager.has(outcome), "{outcome}");
    }
    assert!(manager.has("pos_info(position: int[2]) -> (position: int[2])"));
    for line in ["line 15: position [0, 0]", "line 19: accepted", "line 24: published to all"] {
        manager.expect(line, STEP).unwrap();
    }
    agv.seen("driving to [1.000, 2.000]", STEP).unwrap();
    agv.seen("call_mechanic: one comes in 5 minutes", STEP).unwrap();
    arrives(&mut agv);
    manager.seen("go_to at agv-1/11 is finished", STEP).unwrap();

    assert!(manager.terminate(STEP).unwrap().success());
    agv.seen("manager lost", STEP).unwrap();
    agv.end_input();
    ends_well(&mut agv);
    agv.seen("ended at [1.000, 2.000]", STEP).unwrap();
}

#[test]
fn a_manager_takes_over_from_another_one() {
    let fleet = Fleet::new();
    let mut first = fleet.start("first", env!("CARGO_BIN_EXE_agv_manager"), &[]);
    let mut agv = fleet.start("agv", env!("CARGO_BIN_EXE_agv"), &["--attended"]);
    first.expect("line 24: published to all", STEP).unwrap();
    let mut second = fleet.start("second", env!("CARGO_BIN_EXE_agv_manager"), &["--take-over"]);
    second.expect("line 24: published to all", STEP).unwrap();
    assert_eq!(first.wait(STEP).unwrap().code(), Some(6));
    first.seen("commands with the claim ", STEP).unwrap();
    agv.end_input();
    ends_well(&mut agv);
    assert!(second.terminate(STEP).unwrap().success());
}

#[test]
fn a_manager_that_finds_nobody_ends_when_asked_to() {
    let fleet = Fleet::new();
    let mut manager = fleet.start("manager", env!("CARGO_BIN_EXE_agv_manager"), &[]);
    manager.expect("line 6: searching", STEP).unwrap();
    assert!(manager.terminate(STEP).unwrap().success());
}

#[test]
fn the_console_answers_each_command() {
    while_orders_last(|| {
        let fleet = Fleet::new();
        let mut manager = fleet.start("manager", env!("CARGO_BIN_EXE_agv_manager"), &["--console"]);
        let mut agv = fleet.start("agv", env!("CARGO_BIN_EXE_agv"), &["--name", "seven", "--id", "7", "--attended"]);
        for number in [1, 2, 3, 9, 10, 12, 13, 15, 18, 19, 22, 23, 24] {
            manager.expect(&format!("line {number}: "), STEP).unwrap();
            manager.send("").unwrap();
        }
        manager.expect("console: ", STEP).unwrap();
        arrives(&mut agv);
        for (command, answer) in [
            ("units", "= 1 s_units; 0 is seven/7, epoch "),
            ("functions 0", "= pos_info, battery, stop, reset, go_to"),
            ("pos_info 0", "= position [1, 2]"),
            ("battery 0", "= charge 99.9 %"),
            ("go_to 0 100 100", "= accepted [100, 100]"),
        ] {
            manager.send(command).unwrap();
            manager.expect(answer, STEP).unwrap();
        }
        agv.seen("driving to [100.000, 100.000]", STEP).unwrap();
        manager.send("stop 0").unwrap();
        manager.expect("= stopped", STEP).unwrap();
        agv.seen("stop: AGV_manager/1 said so", STEP).unwrap();
        resets(&mut manager);
        drives(&mut agv, &mut manager, [50, 50]);
        for mistake in ["pos_info 1", "pos_info", "go_to 0 a b", "dance"] {
            manager.send(mistake).unwrap();
            manager.expect("! ", STEP).unwrap();
        }
        manager.send("go_to 0 100000 0").unwrap();
        manager.expect("request to seven/7 failed: ", STEP).unwrap();
        manager.send("quit").unwrap();
        ends_well(&mut manager);
        assert!(agv.terminate(STEP).unwrap().success());
    });
}

#[test]
fn a_released_lease_stops_the_motion() {
    while_orders_last(|| {
        let fleet = Fleet::new();
        let mut manager = fleet.start("manager", env!("CARGO_BIN_EXE_agv_manager"), &["--console"]);
        let mut agv = fleet.start("agv", env!("CARGO_BIN_EXE_agv"), &[]);
        for _ in 0..13 {
            manager.expect("line ", STEP).unwrap();
            manager.send("").unwrap();
        }
        arrives(&mut agv);
        drives(&mut agv, &mut manager, [100, 100]);
        manager.send("release 0").unwrap();
        agv.expect("the order has ended", STEP).unwrap();
    });
}

/// The bumper stops the vehicle, and a reset does nothing while it is pressed.
#[test]
fn the_bumper_stops_the_motion_until_a_reset() {
    while_orders_last(|| {
        let fleet = Fleet::new();
        let mut manager = fleet.start("manager", env!("CARGO_BIN_EXE_agv_manager"), &["--console"]);
        let mut agv = fleet.start("agv", env!("CARGO_BIN_EXE_agv"), &["--attended"]);
        for _ in 0..13 {
            manager.expect("line ", STEP).unwrap();
            manager.send("").unwrap();
        }
        arrives(&mut agv);
        drives(&mut agv, &mut manager, [100, 100]);
        let mut notify = |command: &str, answer: &str| {
            manager.send(command).unwrap();
            manager.expect(answer, STEP).unwrap();
        };
        agv.send("press").unwrap();
        agv.expect("the order has ended", STEP).unwrap();
        notify("reset 0", "! the service failed with code 2");
        notify("go_to 0 70 70", "request to agv-1/11 failed: what it moves was stopped");
        agv.send("release").unwrap();
        agv.expect("the bumper is free", STEP).unwrap();
        notify("go_to 0 70 70", "request to agv-1/11 failed: what it moves was stopped");
        resets(&mut manager);
        drives(&mut agv, &mut manager, [50, 50]);
        assert!(!agv.has("driving to [70"));
    });
}

#[test]
fn m_units_call_each_other() {
    let fleet = Fleet::new();
    let program = env!("CARGO_BIN_EXE_peers");
    let mut one = fleet.start("zone-1", program, &["--name", "zone-1", "--id", "1", "--calls", "3"]);
    let mut two = fleet.start("zone-2", program, &["--name", "zone-2", "--id", "2", "--calls", "3"]);
    ends_well(&mut one);
    ends_well(&mut two);
    assert!(one.has("called zone-2/2: agv 2 taken over: true") && one.has("made 3 calls, served 3"));
    assert!(two.has("called zone-1/1: agv 2 taken over: true") && two.has("made 3 calls, served 3"));
}

#[test]
fn an_s_unit_joins_only_its_own_manager() {
    let mut process = Fleet::new().start("two managers", env!("CARGO_BIN_EXE_two_managers"), &[]);
    ends_well(&mut process);
    assert!(process.has("north has 0 s_units [] and 1 m_units"));
    assert!(process.has("south has 1 s_units [agv-1/11] and 1 m_units"));
    assert!(process.has("the manager of agv-1 is Some(south/2)"));
}

#[test]
fn methods_are_services() {
    let mut process = Fleet::new().start("depot", env!("CARGO_BIN_EXE_method_service"), &[]);
    ends_well(&mut process);
    process.expect("store 5: 5 parcels are there", Duration::ZERO).unwrap();
    process.expect("take 3: 2 parcels are there", Duration::ZERO).unwrap();
    process.expect("take 3: the service is not ready", Duration::ZERO).unwrap();
    process.expect("Depot { parcels: 2 }", Duration::ZERO).unwrap();
}

#[test]
fn the_typed_listing_runs_and_is_short() {
    let mut process = Fleet::new().start("typed", env!("CARGO_BIN_EXE_typed"), &[]);
    ends_well(&mut process);
    for said in [
        "pos_info() -> (position: int[2])",
        "go_to(position: int[2]) progress (left: int) fails (at: int[2])",
        "position [0, 0]",
        "driving to [1, 2]",
        "call_mechanic: a wheel squeaks",
        "a mechanic comes in 5 minutes",
        " m to go",
        "arrived at [4, 6]",
        "the hall ends before (code 1): Some(Blocked { at: [4, 6] })",
        "ended at [4, 6]",
    ] {
        process.seen(said, Duration::ZERO).unwrap();
    }
    let source = include_str!("../src/bin/typed.rs");
    let listing =
        source.split("// The listing begins.\n").nth(1).and_then(|rest| rest.split("    // The listing ends.").next());
    assert!((10..=15).contains(&listing.unwrap().lines().count()), "{listing:?}");
}

#[test]
fn a_manager_on_tokio_drives_its_vehicles_side_by_side() {
    let fleet = Fleet::new();
    let mut manager = fleet.start("manager", env!("CARGO_BIN_EXE_async_manager"), &[]);
    let program = env!("CARGO_BIN_EXE_agv");
    let mut agvs = [("agv-1", "11"), ("agv-2", "12")]
        .map(|(name, id)| fleet.start(name, program, &["--attended", "--name", name, "--id", id]));
    ends_well(&mut manager);
    for node in ["agv-1/11", "agv-2/12"] {
        for line in [format!("joined {node}"), format!("{node} drives"), format!("left {node}")] {
            assert!(manager.has(&line), "{line}: {:?}", manager.lines());
        }
        assert!(manager.has(&format!("{node} stands, its order is over")), "{node}: {:?}", manager.lines());
    }
    let at = |line: &str| manager.lines().iter().position(|shown| shown.text.contains(line)).unwrap();
    assert!(["agv-1/11", "agv-2/12"].iter().all(|node| at(&format!("{node} drives")) < at("stands")), "side by side");
    for agv in &mut agvs {
        agv.seen("driving to [50.000, 0.000]", STEP).unwrap();
        agv.seen("the order has ended", STEP).unwrap();
        agv.end_input();
        ends_well(agv);
    }
}

#[test]
fn a_best_effort_stream_arrives() {
    let fleet = Fleet::new();
    let program = env!("CARGO_BIN_EXE_telemetry");
    let mut receiver = fleet.start("receiver", program, &["receive"]);
    let mut sender = fleet.start("sender", program, &["send", "--count", "100"]);
    ends_well(&mut sender);
    ends_well(&mut receiver);
    assert!(sender.has("sent 100, refused here 0"));
    let shown = receiver.lines().into_iter().rev().find(|line| line.text.starts_with("received ")).unwrap().text;
    let count: u32 = shown["received ".len()..].split(',').next().unwrap().parse().unwrap();
    // Datagrams may be lost, on a busy machine also on loopback; most are not.
    assert!((50..=100).contains(&count), "{shown}");
}
