//! The port against the Linux manager, through a TAP device in a network namespace that the test makes for itself.

#[path = "../../examples/tap_agv.rs"]
mod tap_agv;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cara_processes::network::{self, ip};
use cara_std::{CommunicationSystem, Interfaces, Parameters, Renew};

/// Long enough for the slowest machine; nothing here is timed.
const LONG: Duration = Duration::from_secs(60);

#[test]
fn a_linux_manager_meets_a_vehicle_on_smoltcp() {
    if network::test("a_linux_manager_meets_a_vehicle_on_smoltcp", &[], true) {
        meet();
    }
}

fn until(what: &str, mut done: impl FnMut() -> bool) {
    let deadline = Instant::now() + LONG;
    while !done() {
        assert!(Instant::now() < deadline, "not in {LONG:?}: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn meet() {
    ip("link set lo up");
    ip("tuntap add tap0 mode tap");
    ip("link add br0 type bridge");
    ip("addr add 10.77.0.1/24 broadcast + dev br0");
    ip("link set tap0 master br0 up");
    ip("link set br0 up");
    let fleet = cara_processes::random_fleet();
    static STOPPED: AtomicBool = AtomicBool::new(false);
    let options = tap_agv::Options {
        tap: "tap0".into(),
        address: [10, 77, 0, 2].into(),
        name: "agv-1".into(),
        id: 11,
        manager: "AGV_manager".into(),
        manager_id: 1,
        fleet,
    };
    let vehicle = std::thread::spawn(move || tap_agv::run(&options, || STOPPED.load(Ordering::Relaxed)));
    let builder = CommunicationSystem::builder("AGV_manager", 1).unwrap();
    let manager = builder.fleet(fleet).interfaces(Interfaces::All).insecure().build().unwrap();
    manager.start().unwrap();
    until("the vehicle joins", || manager.number_of_s_units() == 1);
    talk(&manager, [1, 1]);
    // The cable is pulled long enough for both ends to notice, and the vehicle comes back by itself.
    ip("link set tap0 nomaster");
    until("the manager gives the vehicle up", || manager.number_of_s_units() == 0);
    ip("link set tap0 master br0");
    until("the vehicle comes back", || manager.number_of_s_units() == 1);
    talk(&manager, [0, 1]);
    STOPPED.store(true, Ordering::Relaxed);
    vehicle.join().expect("it ends").expect("without an error");
    manager.stop();
}

/// Sends the vehicle somewhere and sees it arrive.
fn talk(manager: &CommunicationSystem, to: [i64; 2]) {
    let agv = manager.s_unit("agv-1").expect("it has joined");
    assert!(agv.wait_for_function("go_to", LONG), "it publishes what it offers");
    let mut position = Parameters::new();
    position.add_int("position", 2).unwrap();
    position.set_value("position", to).unwrap();
    agv.call("go_to", &mut position).renewing(Renew::Process).wait().unwrap();
    until("the vehicle arrives", || {
        let mut position = Parameters::new();
        position.add_int("position", 2).unwrap();
        agv.block_request("pos_info", &mut position).unwrap();
        position.variable("position") == Ok(to)
    });
    let mut charge = Parameters::new();
    charge.add_float("charge", 1).unwrap();
    agv.block_request("battery", &mut charge).unwrap();
    let [charge]: [f64; 1] = charge.variable("charge").unwrap();
    assert!((90.0..=100.0).contains(&charge), "{charge}");
}
