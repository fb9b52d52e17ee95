//! Limits that change while units run.

use cara_std::{Constraints, Error, Parameters};

use crate::support::{ask, fleet, meet, number, pair, service, system, unit, until, within};

#[test]
fn an_interval_set_while_running_holds_at_both_ends() {
    let (manager, agv) = pair();
    agv.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    assert_eq!((ask(&peer, "f", 1), ask(&peer, "f", 2)), (Ok(1), Ok(2)));
    let interval = cara_std::Duration::from_secs(30);
    agv.set_constraints(Constraints { minimum_interval: interval, ..agv.constraints() }).unwrap();
    // The manager hears of it, and does not send any more.
    until("it is told", || matches!(peer.request("f", &number(1)), Err(Error::TooSoon { .. })));
    agv.set_constraints(Constraints { minimum_interval: cara_std::Duration::ZERO, ..agv.constraints() }).unwrap();
    until("it is told again", || peer.request("f", &number(1)).is_ok());
}

/// By hand, for one of two nodes.
#[test]
fn an_interval_set_for_one_node_holds_for_that_node_alone() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let units = [("first", 1), ("second", 2)].map(|(name, id)| unit(name, id, fleet).build().unwrap());
    let [first, second] = units.each_ref().map(|agv| {
        agv.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
        meet(&manager, agv).0
    });
    let interval = cara_std::Duration::from_secs(30);
    first.set_constraints(Constraints { minimum_interval: interval, ..first.constraints() }).unwrap();
    assert!(first.request("f", &number(1)).is_ok());
    assert!(matches!(first.request("f", &number(2)), Err(Error::TooSoon { wait }) if wait <= interval));
    assert_eq!((ask(&second, "f", 1), ask(&second, "f", 2)), (Ok(1), Ok(2)), "the other one is as it was");
    first.set_constraints(Constraints { minimum_interval: cara_std::Duration::ZERO, ..first.constraints() }).unwrap();
    assert_eq!((ask(&first, "f", 1), ask(&first, "f", 2)), (Ok(1), Ok(2)));
}

/// Larger messages than either unit began with.
#[test]
fn longer_messages_are_allowed_while_running() {
    let fleet = fleet();
    let small = Constraints { message_size: 1024, ..Constraints::M_UNIT };
    let manager = system(fleet).constraints(small).build().unwrap();
    let agv = unit("agv", 7, fleet).constraints(Constraints { maximum_nodes: 1, ..small }).build().unwrap();
    let mut text = Parameters::<100_000>::sized();
    text.add_string("text", 40_000).unwrap();
    let echo = |_: &cara_std::Served, _: &mut cara_std::ParametersView| Ok(());
    let (peer, _) = meet(&manager, &agv);
    let long = "y".repeat(40_000);
    text.set_value("text", long.as_str()).unwrap();
    for message_size in [50_000, 2048, 60_000] {
        manager.set_constraints(Constraints { message_size, ..manager.constraints() }).unwrap();
        agv.set_constraints(Constraints { message_size, ..agv.constraints() }).unwrap();
        let fits = message_size > 40_000;
        if agv.my_function_list().is_empty() {
            agv.my_function_list().add_function("echo", &text, echo).unwrap();
            agv.publish_my_function_list().unwrap();
        }
        let expected = if fits { Ok(()) } else { Err(Error::TooLarge { limit: message_size }) };
        let mut last = Ok(());
        let came = within(crate::support::PATIENCE, || {
            last = peer.block_request("echo", &mut text);
            last == expected
        });
        assert!(came, "{message_size}: {last:?}");
        assert_eq!(text.variable::<&str>("text"), Ok(long.as_str()));
    }
    agv.stop();
    manager.stop();
}

#[test]
fn what_a_unit_cannot_hold_is_refused() {
    let (manager, _) = pair();
    let now = manager.constraints();
    for wrong in [
        Constraints { maximum_nodes: 0, ..now },
        Constraints { message_size: u32::MAX, ..now },
        Constraints { chunk_size: 8, ..now },
        Constraints { keep_alive: cara_std::Duration::ZERO, ..now },
        Constraints { calls_per_peer: 0, ..now },
    ] {
        assert_eq!(manager.set_constraints(wrong), Err(Error::BadConstraint), "{wrong:?}");
    }
    // More than the process may have files open for, where that is fewer than the type holds.
    if cara_std::sys::limits::most_links() < u16::MAX.into() {
        let most = Constraints { maximum_nodes: u16::MAX, ..now };
        assert_eq!(manager.set_constraints(most), Err(Error::BadConstraint));
    }
    assert_eq!(manager.constraints(), now);
}

#[test]
fn a_lower_maximum_of_nodes_refuses_the_next_one() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let first = unit("first", 1, fleet).build().unwrap();
    meet(&manager, &first);
    manager.set_constraints(Constraints { maximum_nodes: 1, ..manager.constraints() }).unwrap();
    let second = unit("second", 2, fleet).build().unwrap();
    second.start().unwrap();
    until("it is refused", || !manager.findings().is_empty());
    assert_eq!(manager.number_of_s_units(), 1);
    assert!(first.is_connected() && !second.is_connected());
    manager.set_constraints(Constraints { maximum_nodes: 2, ..manager.constraints() }).unwrap();
    until("it is taken after all", || {
        second.broadcast();
        manager.number_of_s_units() == 2
    });
}
