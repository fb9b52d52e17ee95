//! Membership: which units join, which are refused, and which replace another one.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cara_std::{BuildError, CloseReason, Constraints, Error, Refusal, Threads, Unit, UnitEvent};

use crate::support::{
    PATIENCE, ask, counter, fleet, meet, number, service, system, system_named, unit, unit_of, until,
};

/// Waits for an attempt to join that ends, and returns why.
fn refusal(events: &Receiver<UnitEvent>) -> CloseReason {
    loop {
        if let UnitEvent::NotJoined { reason: reason @ CloseReason::Refused(_), .. } =
            events.recv_timeout(PATIENCE).unwrap()
        {
            return reason;
        }
    }
}

#[test]
fn units_of_other_fleets_and_other_managers_do_not_meet() {
    let (mine, other) = (fleet(), fleet());
    let manager = system(mine).build().unwrap();
    let wrong_fleet = unit("stranger", 1, other).build().unwrap();
    let wrong_manager = unit_of(("another", 1), "astray", 2, mine).build().unwrap();
    manager.start().unwrap();
    wrong_fleet.start().unwrap();
    wrong_manager.start().unwrap();
    // Both have searched, and so has the manager, before one comes that belongs here.
    for _ in 0..3 {
        wrong_fleet.broadcast();
        wrong_manager.broadcast();
        manager.broadcast();
    }
    let right = unit("right", 3, mine).build().unwrap();
    meet(&manager, &right);
    assert_eq!(manager.s_units().len(), 1);
    assert!(wrong_fleet.manager().is_none() && wrong_manager.manager().is_none());
}

/// Dialled by its address, a manager says why it does not take a unit.
#[test]
fn a_full_manager_says_so() {
    let fleet = fleet();
    let manager = system(fleet).constraints(Constraints { maximum_nodes: 1, ..Constraints::M_UNIT });
    let manager = manager.build().unwrap();
    let first = unit("first", 1, fleet).build().unwrap();
    meet(&manager, &first);
    let second = unit("second", 2, fleet).build().unwrap();
    let events = second.events();
    second.start().unwrap();
    assert_eq!(refusal(&events), CloseReason::Refused(Refusal::Full));
    assert_eq!(manager.number_of_s_units(), 1);
    first.stop();
    until("the second has the first one's place", || manager.s_unit("second").is_ok_and(|peer| peer.is_connected()));
    assert_eq!(manager.s_units().len(), 1);
}

/// The tables grow: nothing was made for so many at the start.
#[test]
fn a_full_manager_takes_more_when_its_maximum_is_raised() {
    const NODES: u16 = 40;
    let fleet = fleet();
    let few = Constraints { maximum_nodes: 1, ..Constraints::M_UNIT };
    let manager = system(fleet).constraints(few).build().unwrap();
    let first = unit("first", 1, fleet).build().unwrap();
    let (peer, _) = meet(&manager, &first);
    let threads = Threads::new().unwrap();
    let other = |id: u32| unit(&format!("agv-{id}"), 10 + id, fleet).threads(&threads).build().unwrap();
    let others: Vec<Unit> = (1..NODES.into()).map(other).collect();
    others.iter().for_each(|unit| unit.start().unwrap());
    manager.set_constraints(Constraints { maximum_nodes: NODES, ..few }).unwrap();
    until("all have joined", || manager.number_of_s_units() == usize::from(NODES));
    assert!(peer.is_connected(), "the first is where it was");
    assert_eq!(manager.s_unit("first").unwrap().identity(), peer.identity());
}

#[test]
fn a_second_node_of_one_name_is_refused_while_the_first_lives() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let first = unit("agv", 7, fleet).build().unwrap();
    first.my_function_list().add_function("f", &number(0), service(|_| 1)).unwrap();
    let (peer, _) = meet(&manager, &first);
    let second = unit("agv", 7, fleet).build().unwrap();
    second.my_function_list().add_function("f", &number(0), service(|_| 2)).unwrap();
    second.publish_my_function_list().unwrap();
    let events = second.events();
    second.start().unwrap();
    assert_eq!(refusal(&events), CloseReason::Refused(Refusal::DuplicateIdentity));
    assert_eq!(ask(&peer, "f", 0), Ok(1), "the first one is as it was");
    assert!(first.is_connected());
    first.stop();
    until("the second takes over", || ask(&peer, "f", 0) == Ok(2));
}

#[test]
fn a_node_that_comes_back_has_its_place_and_its_handle() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let build = |name: &str, id: u32, number_of_life: i64| {
        let agv = unit(name, id, fleet).build().unwrap();
        agv.my_function_list().add_function("life", &number(0), service(move |_| number_of_life)).unwrap();
        agv
    };
    let mut first = build("first", 1, 0);
    let second = build("second", 2, 0);
    let (peer, _) = meet(&manager, &first);
    let (other, _) = meet(&manager, &second);
    for life in 1..4 {
        first.stop();
        until("it has left", || !peer.is_connected());
        assert_eq!(ask(&peer, "life", 0), Err(Error::NotConnected));
        assert_eq!(manager.number_of_s_units(), 1);
        first = build("first", 1, life);
        meet(&manager, &first);
        assert_eq!(ask(&peer, "life", 0), Ok(life));
        assert_eq!(ask(&other, "life", 0), Ok(0));
        let names: Vec<_> = manager.s_units().iter().map(|peer| peer.name().to_owned()).collect();
        assert_eq!(names, ["first", "second"]);
    }
}

#[test]
fn two_m_units_meet_and_call_each_other() {
    let fleet = fleet();
    let units = [("one", 1), ("two", 2)].map(|(name, id)| {
        let unit = system_named(name, id, fleet).build().unwrap();
        unit.my_function_list().add_function("who", &number(0), service(move |_| i64::from(id))).unwrap();
        unit.publish_my_function_list().unwrap();
        unit.start().unwrap();
        unit
    });
    let [one, two] = &units;
    until("each offers to the other", || units.iter().all(|unit| unit.nodes_offering("who").len() == 1));
    assert_eq!(ask(&one.m_unit("two").unwrap(), "who", 0), Ok(2));
    assert_eq!(ask(&two.m_unit("one").unwrap(), "who", 0), Ok(1));
    assert_eq!((one.number_of_m_units(), two.number_of_s_units()), (1, 0));
}

/// Published to one node only, and it survives that node's reconnection.
#[test]
fn publishing_to_one_node_is_for_that_node() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    let start = |name: &str, id: u32| {
        let agv = unit(name, id, fleet).build().unwrap();
        agv.start().unwrap();
        agv
    };
    let (first, second) = (start("first", 1), start("second", 2));
    until("both have come", || manager.number_of_s_units() == 2);
    until("they know it", || [&first, &second].iter().all(|agv| agv.manager().is_some()));
    manager.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    let span = cara_std::Duration::from_secs(10);
    manager.s_unit("first").unwrap().publish_and_wait(span).unwrap();
    assert!(first.manager().unwrap().their_function_list().contains("f"));
    assert!(second.manager().unwrap().their_function_list().is_empty());
    first.stop();
    until("it has left", || manager.number_of_s_units() == 1);
    let first = start("first", 1);
    until("it knows the function again", || {
        first.manager().is_some_and(|manager| manager.their_function_list().contains("f"))
    });
    assert!(second.manager().unwrap().their_function_list().is_empty());
}

/// Functions that are published while a node joins reach it.
#[test]
fn a_function_published_while_a_node_joins_is_told() {
    for _ in 0..20 {
        let fleet = fleet();
        let manager = system(fleet).build().unwrap();
        manager.start().unwrap();
        let agv = unit("agv", 7, fleet).build().unwrap();
        agv.start().unwrap();
        let mut published = 0;
        while !agv.is_connected() {
            if published < 40 {
                manager.my_function_list().add_function(&format!("f{published}"), &number(0), service(|n| n)).unwrap();
                manager.publish_my_function_list().unwrap();
                published += 1;
            }
            std::thread::sleep(Duration::from_micros(500));
        }
        until("all are known", || agv.manager().unwrap().their_function_list().len() == published);
        assert!(counter(&manager.counters(), "WhoHasHeard") < 1_000);
    }
}

/// Two fleets of one port number would meet by broadcast; this one does not broadcast at all.
#[test]
fn a_fixed_address_needs_no_broadcast() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let port = manager.tcp_port();
    let taken = system(fleet).tcp_port(port).build();
    assert!(matches!(taken, Err(BuildError::Unit(Error::PortInUse))), "the port is taken");
    let agv = unit("agv", 7, fleet).manager_address(([127, 0, 0, 1], port).into()).build().unwrap();
    meet(&manager, &agv);
    assert_eq!(counter(&agv.counters(), "WhoHasSent"), 0);
}

/// Passes on what the vehicle says as a radio of 8 kbit/s would, and what the manager says at once.
fn slow_link(to: SocketAddr) -> SocketAddr {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || -> std::io::Result<()> {
        let (mut vehicle, _) = listener.accept()?;
        let mut manager = TcpStream::connect(to)?;
        manager.set_nodelay(true)?;
        let (mut back, mut forth) = (manager.try_clone()?, vehicle.try_clone()?);
        std::thread::spawn(move || std::io::copy(&mut back, &mut forth));
        let mut few = [0; 16];
        loop {
            let count = vehicle.read(&mut few)?;
            if count == 0 {
                return manager.shutdown(Shutdown::Both);
            }
            manager.write_all(&few[..count])?;
            std::thread::sleep(Duration::from_millis(15));
        }
    });
    address
}

/// Lines 4 to 10 of the listing, whatever the link: the list is there when the node is counted, and one that has not told it
/// keeps out of the way of one that has.
#[test]
fn a_node_counts_once_its_list_has_come_however_slowly() {
    const FUNCTIONS: usize = 30;
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    let relay = slow_link((Ipv4Addr::LOCALHOST, manager.tcp_port()).into());
    let slow = unit("agv-1", 1, fleet).manager_address(relay).build().unwrap();
    for index in 0..FUNCTIONS {
        let name = format!("a_service_with_a_long_name_{index}");
        slow.my_function_list().add_function(&name, &number(0), service(|number| number)).unwrap();
    }
    slow.publish_my_function_list().unwrap();
    slow.start().unwrap();
    until("it has joined", || !manager.s_units().is_empty());
    let quick = unit("agv-2", 2, fleet).build().unwrap();
    quick.start().unwrap();
    until("one is counted", || manager.number_of_s_units() > 0);
    let mut ids = vec![2, 1];
    if manager.s_units()[0].identity().id() == 1 {
        // A machine that is busy enough makes the quick one slower.
        ids.reverse();
    }
    until("both are counted", || manager.number_of_s_units() == 2);
    let units = manager.s_units();
    assert_eq!(units.iter().map(|unit| unit.identity().id()).collect::<Vec<_>>(), ids);
    let lengths = units.iter().map(|unit| (unit.identity().id(), unit.their_function_list().len()));
    assert!(lengths.eq(ids.into_iter().map(|id| (id, if id == 1 { FUNCTIONS } else { 0 }))));
}
