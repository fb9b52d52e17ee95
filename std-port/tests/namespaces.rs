//! Interfaces that are not there, go and come: each test in a network namespace of its own.
//!
//! A test runs this binary again under `unshare`, as `ip` would need root otherwise. Where that is not possible it says
//! that it was skipped, and with `CI` set it fails.

mod keyed;

use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use cara_processes::network::{self, ip};
use cara_std::control::Control;
use cara_std::{CloseReason, CommunicationSystem, Error, Interfaces, Parameters, Unit, UnitEvent};

const PATIENCE: Duration = Duration::from_secs(30);

/// A pair of interfaces, one of which is the far end of the cable.
fn plug_in() {
    ip("link add eth7 type veth peer name far7");
    ip("addr add 10.77.0.1/24 dev eth7");
    ip("link set far7 up");
    ip("link set eth7 up");
}

/// Without a control socket: its place is the same in all of these networks.
fn manager() -> (CommunicationSystem, Receiver<UnitEvent>) {
    let manager = keyed::pair(0).0.interfaces(Interfaces::All).control(Control::Off).build().unwrap();
    let events = manager.events();
    manager.start().unwrap();
    (manager, events)
}

fn agv() -> (Unit, Receiver<UnitEvent>) {
    let agv = keyed::pair(0).1.interfaces(Interfaces::All).build().unwrap();
    agv.my_function_list().add_function("ping", &Parameters::new(), |parameters: Parameters| parameters).unwrap();
    agv.publish_my_function_list().unwrap();
    let events = agv.events();
    agv.start().unwrap();
    (agv, events)
}

/// Waits until it is told which interfaces are up.
fn reported(events: &Receiver<UnitEvent>) -> Vec<String> {
    let end = Instant::now() + PATIENCE;
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if let UnitEvent::NetworkChanged { up } = events.recv_timeout(left).expect("it is told in time") {
            return up;
        }
    }
}

fn until(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn ping(manager: &CommunicationSystem) -> Result<(), Error> {
    manager.s_unit("agv")?.block_request("ping", &mut Parameters::new())
}

#[test]
fn without_an_interface_a_unit_says_so_once_and_goes_on_when_there_is_one() {
    if !network::test("without_an_interface_a_unit_says_so_once_and_goes_on_when_there_is_one", &[], false) {
        return;
    }
    let (manager, of_manager) = manager();
    let (agv, of_agv) = agv();
    for events in [&of_manager, &of_agv] {
        assert_eq!(reported(events), Vec::<String>::new());
    }
    // It goes on searching, and says nothing more.
    until("the AGV has tried several times", || {
        let counters = agv.counters();
        counters.iter().any(|(name, count)| *name == "SendFailed" && *count >= 3)
    });
    let again = |events: &Receiver<UnitEvent>| {
        events.try_iter().filter(|event| matches!(event, UnitEvent::NetworkChanged { .. })).count()
    };
    assert_eq!((again(&of_manager), again(&of_agv)), (0, 0));
    assert!(!agv.is_connected());

    // Both are on one host here, so loopback is what they meet over. Found or not, it is told that there is no other.
    ip("link set lo up");
    for events in [&of_manager, &of_agv] {
        assert_eq!(reported(events), ["lo"]);
    }
    until("the two meet", || ping(&manager) == Ok(()));
}

#[test]
fn an_interface_goes_and_comes() {
    if !network::test("an_interface_goes_and_comes", &[], false) {
        return;
    }
    ip("link set lo up");
    let (manager, of_manager) = manager();
    let (agv, _of_agv) = agv();
    assert_eq!(reported(&of_manager), ["lo"], "no other host can be reached");
    until("the two meet over loopback", || ping(&manager) == Ok(()));
    agv.stop();
    until("it has left", || manager.number_of_s_units() == 0);

    plug_in();
    assert_eq!(reported(&of_manager), ["eth7", "lo"]);
    ip("link set eth7 down");
    assert_eq!(reported(&of_manager), ["lo"]);
    ip("link set eth7 up");
    assert_eq!(reported(&of_manager), ["eth7", "lo"]);
    let (_second, _events) = self::agv();
    until("the two meet again", || ping(&manager) == Ok(()));
}

/// A vehicle that knows its manager's address has no route to it, and says so each time that it tries.
#[test]
fn a_fixed_address_without_a_route_is_told() {
    if !network::test("a_fixed_address_without_a_route_is_told", &[], false) {
        return;
    }
    ip("link set lo up");
    let (manager, agv) = keyed::pair(0);
    let agv = agv.manager_address(([10, 77, 0, 1], 7_000).into()).build().unwrap();
    let events = agv.events();
    agv.start().unwrap();
    let end = Instant::now() + PATIENCE;
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if let UnitEvent::NotJoined { address, reason, .. } = events.recv_timeout(left).expect("it is told in time") {
            assert_eq!((address, reason), (([10, 77, 0, 1], 7_000).into(), CloseReason::DialFailed));
            break;
        }
    }
    // The manager comes to be there, with the cable.
    plug_in();
    let manager = manager.tcp_port(7_000).control(Control::Off).build().unwrap();
    manager.start().unwrap();
    until("it has joined", || manager.number_of_s_units() == 1);
}
