//! Two units on a serial line without IP.

use std::cell::RefCell;
use std::rc::Rc;

use cara_core::config::LINE_FRAME_BYTES;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::Lease;
use cara_core::time::Duration;
use cara_embassy::line::{self, Line, Memory};
use cara_embassy::{Config, Handle, Handler, Limits, Security, ServiceOptions, resources};
use cara_embassy_host::{Bench, Board, Wire};

const BAUD: u32 = 115_200;
const LONG: Duration = Duration::from_secs(60);
const LEASE: Duration = Duration::from_millis(400);
const LIMITS: Limits = Limits { message_size: 512, ..Limits::S_UNIT };

/// A unit at an end, with its line.
fn start(wire: &Wire, end: usize, board: &Board, seed: u64, config: Config) -> (Handle, Line) {
    let line = wire.line(end, board, seed);
    let memory = Box::leak(Box::new(<resources!((), LIMITS)>::new()));
    let (unit, mut runner) = cara_embassy::new(line, memory, config, ()).unwrap();
    board.spawn(async move { runner.run().await });
    (unit, line)
}

fn start_manager(wire: &Wire, board: &Board, seed: u64) -> Handle {
    let (unit, _) = start(wire, 0, board, seed, Config::m_unit("manager", 1, Security::insecure(seed)).unwrap());
    unit
}

fn start_agv(wire: &Wire, board: &Board, seed: u64, lease: &'static Lease) -> (Handle, Line) {
    let config = Config::s_unit("agv", 7, "manager", 1, Security::insecure(seed)).unwrap();
    let (unit, line) = start(wire, 1, board, seed, config);
    let list = unit.my_function_list();
    let done = || Handler::method(&|(), _, _| Ok(()));
    list.add_service("go(n: int) -> (n: int)", ServiceOptions::new().lease(LEASE, lease, &|| {}), done()).unwrap();
    list.add_service("echo(n: int) -> (n: int)", ServiceOptions::new(), done()).unwrap();
    unit.publish_my_function_list().unwrap();
    (unit, line)
}

fn knows(unit: Handle) -> bool {
    unit.nodes_offering("echo").next().is_some()
}

/// Calls the vehicle, and lets time pass until that is over.
fn ask(bench: &Bench, board: &Board, manager: Handle, function: &'static str) -> Result<i64, Error> {
    let peer = manager.peer("agv").unwrap();
    let result = Rc::new(RefCell::new(None));
    let reported = Rc::clone(&result);
    board.spawn(async move {
        let mut parameters = Parameters::<512>::sized();
        let asked = async {
            parameters.add_int("n", 1)?;
            parameters.set_value("n", 5)?;
            peer.call(function, &mut parameters).renewing(Renew::Process).await?;
            parameters.variable("n")
        };
        let ended = asked.await;
        reported.replace(Some(ended));
    });
    assert!(bench.run_until(|| result.borrow().is_some(), LONG), "it ends");
    result.take().unwrap()
}

#[test]
fn units_on_a_line_join_and_call_and_a_pulled_line_ends_the_lease() {
    static GO: Lease = Lease::new();
    let (bench, wire) = (Bench::new(31), Wire::new(BAUD, 31));
    let (depot, board) = (bench.board(), bench.board());
    let (manager, (agv, _)) = (start_manager(&wire, &depot, 1), start_agv(&wire, &board, 2, &GO));
    assert!(bench.run_until(|| knows(manager) && agv.is_connected(), LONG));
    assert_eq!(manager.peer("agv").unwrap().address().map(|address| *address.ip()), Some(line::PEER));
    let asked = bench.now();
    assert_eq!(ask(&bench, &depot, manager, "echo"), Ok(5));
    let took = bench.now().since(asked);
    assert!(took < Duration::from_millis(25), "whatever comes wakes the unit: {took:?}");
    assert_eq!(ask(&bench, &depot, manager, "go"), Ok(5));
    bench.run_for(Duration::from_secs(2));
    let is_live = || GO.is_live(cara_embassy::now());
    assert!(is_live(), "the manager renews it");
    (0..2).for_each(|end| wire.pull(end, true));
    let pulled = bench.now();
    assert!(bench.run_until(|| !is_live(), LONG));
    assert!(bench.now().since(pulled) <= LEASE, "the bound is the lease");
    assert!(bench.run_until(|| !manager.is_connected() && !agv.is_connected(), LONG));
    (0..2).for_each(|end| wire.pull(end, false));
    assert!(bench.run_until(|| knows(manager), LONG));
    assert_eq!(ask(&bench, &depot, manager, "echo"), Ok(5));
    assert!(!is_live());
}

#[test]
fn either_end_of_a_line_may_restart() {
    static GO: Lease = Lease::new();
    let (bench, wire) = (Bench::new(32), Wire::new(BAUD, 32));
    let (depot, board) = (bench.board(), bench.board());
    let (manager, _) = (start_manager(&wire, &depot, 1), start_agv(&wire, &board, 2, &GO));
    assert!(bench.run_until(|| knows(manager), LONG));
    // The vehicle's old link is not missed yet when it dials again.
    board.cut_power();
    let board = board.reboot();
    let (agv, _) = start_agv(&wire, &board, 3, &GO);
    assert!(
        bench.run_until(|| !manager.is_connected(), Duration::from_millis(500)),
        "its end comes with the next dial"
    );
    assert!(bench.run_until(|| agv.is_connected() && knows(manager), LONG));
    depot.cut_power();
    let depot = depot.reboot();
    let manager = start_manager(&wire, &depot, 4);
    assert!(bench.run_until(|| knows(manager), LONG));
    assert_eq!(ask(&bench, &depot, manager, "echo"), Ok(5));
}

#[test]
fn noise_on_a_line_changes_no_call() {
    static GO: Lease = Lease::new();
    let (bench, wire) = (Bench::new(33), Wire::new(BAUD, 33));
    wire.set_damage(701);
    let (depot, board) = (bench.board(), bench.board());
    let (manager, (_, line)) = (start_manager(&wire, &depot, 1), start_agv(&wire, &board, 2, &GO));
    assert!(bench.run_until(|| knows(manager), LONG));
    while line.counters().bad < 10 {
        assert_eq!(ask(&bench, &depot, manager, "echo"), Ok(5));
    }
}

/// The UART's driver has buffered what comes while other tasks ran.
#[test]
fn datagrams_wait_until_the_unit_takes_them() {
    static GO: Lease = Lease::new();
    let (bench, wire) = (Bench::new(34), Wire::new(BAUD, 34));
    let (depot, board) = (bench.board(), bench.board());
    let (manager, (_, line)) = (start_manager(&wire, &depot, 1), start_agv(&wire, &board, 2, &GO));
    assert!(bench.run_until(|| knows(manager), LONG));
    bench.run_for(Duration::from_secs(5));
    let before = wire.counts().bytes;
    board.suspend(Duration::from_millis(60));
    for _ in 0..4 {
        manager.broadcast();
        bench.run_for(Duration::from_millis(14));
    }
    bench.run_for(Duration::from_millis(100));
    assert!(wire.counts().bytes - before > 100, "searches have come");
    assert_eq!(line.counters().dropped, 0);
}

#[test]
fn a_datagram_to_another_port_is_counted() {
    let (bench, wire) = (Bench::new(35), Wire::new(BAUD, 35));
    let board = bench.board();
    let manager = start_manager(&wire, &board, 1);
    bench.run_for(Duration::from_secs(1));
    let (mut other, mut frame) = (cara_core::host::line::Line::new(BAUD, 2), [0; LINE_FRAME_BYTES]);
    assert!(other.send_datagram(9, 1, b"to nobody"));
    wire.inject(0, other.transmit(bench.now(), &mut frame));
    bench.run_for(Duration::from_secs(1));
    assert_eq!(manager.node_counted(NodeCounter::DatagramMalformed), 1);
}

#[test]
fn a_line_carries_one_link() {
    let (line, ..) = line::new(Box::leak(Box::new(Memory::new())), BAUD, 1);
    let memory = Box::leak(Box::new(<resources!((), Limits::M_UNIT)>::new()));
    let config = Config::m_unit("manager", 1, Security::insecure(1)).unwrap();
    assert_eq!(cara_embassy::new(line, memory, config, ()).err(), Some(Error::BadConstraint));
}
