//! A manager that was written from `docs/wire.md`, in Python, calls the example AGV, and takes part when a link is rekeyed.
//!
//! On loopback, in fleets of their own, which have keys. Every wait is bounded.

use std::path::Path;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use cara_apps::agv::{GO_TO_LEASE, STOP};
use cara_processes::ticker::unless_held_up;
use cara_processes::{Process, random_fleet, skip};
use cara_std::{Definition, Identity, Interfaces, LinkCounter, ParametersView, Priority, Served, ServiceOptions, Unit};
use cara_test_keys::KeyFolder;

const PATIENCE: Duration = Duration::from_secs(20);

/// The manager in Python, which listens, and the keys of its fleet; `None` where there is no Python.
fn manager(fleet: u32) -> Option<(Process, KeyFolder)> {
    let keys = KeyFolder::draw(fleet, &["AGV_manager/1@m_unit", "agv-1/11"]).unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/vectors/caller.py");
    let (fleet, folder) = (fleet.to_string(), keys.path().display().to_string());
    let arguments = [script, "--fleet", &fleet, "--keys", &folder];
    match Process::start("caller.py", Path::new("python3"), arguments) {
        Ok(manager) => {
            manager.seen("listens", PATIENCE).unwrap();
            Some((manager, keys))
        }
        Err(_) => {
            skip("python3 is not installed");
            None
        }
    }
}

/// Sends a command and waits for what it leads to.
fn command(manager: &mut Process, command: &str, outcome: &str) {
    manager.send(command).unwrap();
    manager.expect(outcome, PATIENCE).unwrap();
}

#[test]
fn a_manager_written_from_the_document_calls_the_agv() {
    unless_held_up(GO_TO_LEASE.into(), calls_the_agv);
}

fn calls_the_agv() {
    let fleet = random_fleet();
    let Some((mut manager, keys)) = manager(fleet) else { return };
    let folder = format!("CARA_KEYS={}", keys.path().display());
    let number = fleet.to_string();
    let arguments = [&folder, env!("CARGO_BIN_EXE_agv"), "--loopback", "--fleet", &number, "--attended"];
    let mut agv = Process::start("agv", Path::new("env"), arguments).unwrap();
    agv.expect("started agv-1/11, secured", PATIENCE).unwrap();
    manager.seen("joined agv-1 secured", PATIENCE).unwrap();
    agv.seen("joined AGV_manager/1", PATIENCE).unwrap();
    manager.expect("functions pos_info(position: int[2]) -> (position: int[2])", PATIENCE).unwrap();
    manager.seen("datagrams pass", PATIENCE).unwrap();
    agv.seen("call_mechanic: one comes in 5 minutes", PATIENCE).unwrap();

    // A way of a second, under a lease of 400 ms.
    command(&mut manager, "pos_info 9 9", "pos_info {'position': [0, 0]}");
    command(&mut manager, "go_to 2 0", "go_to {}");
    agv.expect("driving to [2.000, 0.000]", PATIENCE).unwrap();
    agv.expect("arrived at [2.000, 0.000]", PATIENCE).unwrap();
    manager.expect("lease of go_to ended: finished", PATIENCE).unwrap();
    command(&mut manager, "pos_info 9 9", "pos_info {'position': [2, 0]}");

    // A later call takes the place of an earlier one, and is released.
    command(&mut manager, "go_to 2 100", "go_to {}");
    command(&mut manager, "go_to 2 -100", "lease of go_to ended: replaced");
    agv.expect("driving to [2.000, -100.000]", PATIENCE).unwrap();
    manager.send("release").unwrap();
    agv.expect("the order has ended", PATIENCE).unwrap();

    // One that is renewed no more ends by itself.
    command(&mut manager, "go_to 100 0", "go_to {}");
    command(&mut manager, "lapse", "lease of go_to ended: expired");
    agv.seen("lease of go_to expired, held by AGV_manager/1", PATIENCE).unwrap();

    // An emergency, as a datagram and in the stream.
    command(&mut manager, "go_to 100 0", "go_to {}");
    agv.expect("driving to", PATIENCE).unwrap();
    command(&mut manager, "stop", "stop {}");
    agv.expect("AGV_manager/1 said so", PATIENCE).unwrap();
    manager.send("release").unwrap();
    command(&mut manager, "pos_info 9 9", "pos_info {'position': [");
    assert!(!manager.has("failed"), "{:?}", manager.lines());

    manager.end_input();
    agv.expect("manager lost", PATIENCE).unwrap();
    assert!(manager.wait(PATIENCE).unwrap().success());
    assert!(agv.terminate(PATIENCE).unwrap().success());
}

/// The s_unit rekeys its link about once a second. Each emergency is sent twice and runs once. A lease that would outlast the
/// test is released.
#[test]
fn a_manager_written_from_the_document_follows_new_keys() {
    let fleet = random_fleet();
    let Some((mut manager, keys)) = manager(fleet) else { return };
    let file = keys.file(&Identity::s_unit("agv-1", 11).unwrap()).unwrap();
    let agv = Unit::builder("agv-1", 11, "AGV_manager", 1).unwrap().fleet(fleet).interfaces(Interfaces::Loopback);
    let agv = agv.key_file(file).build().unwrap();
    agv.renew_keys_every(Duration::from_secs(1).into());
    let options = ServiceOptions::new().priority(Priority::Emergency);
    let stop = |_: &Served, _: &mut ParametersView| Ok(());
    agv.my_function_list().add_service(&Definition::parse(STOP).unwrap(), options, stop).unwrap();
    let (safe, released) = channel();
    let options = ServiceOptions::new().lease(3 * PATIENCE, move || safe.send(()).unwrap());
    let hold = |_: &Served, _: &mut ParametersView| Ok(());
    agv.my_function_list().add_service(&Definition::parse("hold()").unwrap(), options, hold).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    manager.expect("functions stop(), hold()", PATIENCE).unwrap();
    command(&mut manager, "hold", "hold {}");
    for _ in 0..3 {
        command(&mut manager, "stop", "stop {}");
        manager.expect("new keys", PATIENCE).unwrap();
    }
    manager.send("release").unwrap();
    released.recv_timeout(PATIENCE).unwrap();
    let counted = |counter| agv.counted(counter);
    assert_eq!(counted(LinkCounter::RequestsRun), 4);
    let end = Instant::now() + PATIENCE;
    while counted(LinkCounter::RequestsRepeated) < 3 || counted(LinkCounter::KeysRenewed) < 3 {
        assert!(Instant::now() < end, "{:?}", agv.counters());
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!((counted(LinkCounter::DatagramsForged), counted(LinkCounter::FramesRefused)), (0, 0));
    assert!(agv.manager().unwrap().is_connected());
}
