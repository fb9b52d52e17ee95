//! Many callers: over one link, over many, with the peer calling back.

use std::sync::atomic::{AtomicBool, Ordering};

use cara_std::{Constraints, Error, Peer};

use crate::support::{ask, fleet, meet, number, pair, service, system, unit, until};

/// Asks for the echo of numbers that no other caller uses; waits a moment where the peer is busy.
fn echo<T: Send + 'static>(peer: &Peer<T>, caller: i64, calls: i64) {
    for call in 0..calls {
        let unique = caller * 1_000_000 + call;
        loop {
            match ask(peer, "echo", unique) {
                Err(Error::Busy) => std::thread::yield_now(),
                outcome => {
                    assert_eq!(outcome, Ok(unique));
                    break;
                }
            }
        }
    }
}

#[test]
fn sixteen_threads_share_a_link_while_the_peer_calls_back() {
    let (manager, agv) = pair();
    manager.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, back) = meet(&manager, &agv);
    std::thread::scope(|scope| {
        for caller in 0..16 {
            let peer = &peer;
            scope.spawn(move || echo(peer, caller, 200));
        }
        for caller in 16..20 {
            let back = &back;
            scope.spawn(move || echo(back, caller, 200));
        }
    });
    for counters in [peer.counters(), back.counters()] {
        assert_eq!(crate::support::counter(&counters, "CallsTimedOut"), 0, "{counters:?}");
    }
}

#[test]
fn sixty_four_callers_have_a_link_each() {
    let fleet = fleet();
    let manager = system(fleet).constraints(Constraints { maximum_nodes: 64, ..Constraints::M_UNIT });
    let manager = manager.build().unwrap();
    manager.start().unwrap();
    let units: Vec<_> = (0..64)
        .map(|id| {
            let agv = unit(&format!("agv{id}"), id, fleet).build().unwrap();
            agv.my_function_list()
                .add_function("echo", &number(0), service(move |number| number + i64::from(id)))
                .unwrap();
            agv.publish_my_function_list().unwrap();
            agv.start().unwrap();
            agv
        })
        .collect();
    until("all have come", || manager.nodes_offering("echo").len() == units.len());
    std::thread::scope(|scope| {
        for peer in manager.s_units() {
            scope.spawn(move || {
                for call in 0..50 {
                    assert_eq!(ask(&peer, "echo", call), Ok(call + i64::from(peer.id())), "{peer:?}");
                }
            });
        }
    });
}

/// Calls of one thread in one class take the state in the order in which they were made, whichever threads read and run them.
#[test]
fn calls_of_a_class_take_the_state_in_order() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = crate::support::unit("agv", 7, fleet).state(-1_i64).build().unwrap();
    let in_order = |last: &mut i64, parameters: cara_std::Parameters| {
        assert_eq!(crate::support::value(&parameters), *last + 1);
        *last += 1;
        parameters
    };
    agv.my_function_list().add_function("in_order", &number(0), in_order).unwrap();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (peer, done) = (&peer, &done);
        // Leaders and pool threads take turns at both ends meanwhile.
        scope.spawn(move || {
            while !done.load(Ordering::Relaxed) {
                let high = cara_std::RequestOptions { priority: Some(cara_std::Priority::High), ..Default::default() };
                let mut parameters = number(1);
                peer.call("echo", &mut parameters).with(high).wait().unwrap();
            }
        });
        for call in 0..2_000 {
            if call % 3 == 0 {
                assert_eq!(ask(peer, "in_order", call), Ok(call));
            } else {
                until("there is room", || peer.request("in_order", &number(call)).is_ok());
            }
        }
        done.store(true, Ordering::Relaxed);
    });
    until("all have run", || agv.with_state(|last| *last) == Ok(1_999));
}
