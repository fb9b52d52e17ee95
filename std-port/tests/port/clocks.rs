//! How far the clocks of vehicles are from the manager's.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use cara_std::{ParametersView, Served, ServiceError, ServiceOptions, Unit};

use crate::support::{Gate, ask, counter, fleet, meet, number, service, system, unit, until};

const CLOCK: &str = "clock() -> (unix_us: int)";

/// Microseconds that the clocks of one host may differ by besides the error: each time is rounded.
const ROUNDED: i64 = 10;

/// Adds a clock that is ahead by so much.
fn add_shifted(agv: &Unit, ahead_us: i64) {
    let tell = move |_: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_micros() as i64;
        Ok(parameters.set_value("unix_us", now + ahead_us)?)
    };
    agv.my_function_list().add_service(&CLOCK.parse().unwrap(), ServiceOptions::new(), tell).unwrap();
}

#[test]
fn a_vehicle_that_tells_its_clock_is_shown_with_its_offset_and_others_with_none() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let [ahead, behind, right, silent] =
        ["agv1", "agv2", "agv3", "agv4"].map(|name| unit(name, name[3..].parse().unwrap(), fleet).build().unwrap());
    add_shifted(&ahead, 5_000_000);
    add_shifted(&behind, -7_000_000);
    right.my_function_list().add_clock().unwrap();
    silent.my_function_list().add_function("number", &number(0), service(|number| number)).unwrap();
    let peers = [&ahead, &behind, &right, &silent].map(|agv| meet(&manager, agv).0);
    for (peer, shift) in peers.iter().zip([5_000_000, -7_000_000, 0]) {
        until("the few calls are over", || counter(&peer.counters(), "RequestsSent") >= 4);
        until("one is answered", || peer.clock_offset().is_some());
        let offset = peer.clock_offset().unwrap();
        let off = (offset.offset_us - shift).unsigned_abs() as i64;
        assert!(off <= offset.error.as_micros() as i64 + ROUNDED, "{} by {shift}: {offset:?}", peer.name());
    }
    assert_eq!(peers[3].clock_offset(), None);
    assert_eq!(ask(&peers[3], "number", 1), Ok(1));
    assert_eq!(counter(&peers[3].counters(), "RequestsSent"), 1, "nothing is asked of a vehicle that does not tell");
    // A vehicle does not ask its manager.
    assert_eq!(ahead.manager().unwrap().clock_offset(), None);
    ahead.stop();
    until("it has left", || !peers[0].is_connected());
    assert_eq!(peers[0].clock_offset(), None, "what left is not known any more");
}

#[test]
fn a_vehicle_that_hangs_in_its_clock_holds_nothing_up() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    let gate = Arc::new(Gate::default());
    let at_gate = gate.clone();
    let hang = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        at_gate.pass();
        Ok(())
    };
    agv.my_function_list().add_service(&CLOCK.parse().unwrap(), ServiceOptions::new(), hang).unwrap();
    agv.my_function_list().add_function("number", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    until("it is asked", || counter(&peer.counters(), "RequestsSent") == 1);
    for value in 0..100 {
        assert_eq!(ask(&peer, "number", value), Ok(value));
    }
    until("the call is given up", || counter(&peer.counters(), "CallsTimedOut") >= 1);
    until("it has no slot", || counter(&manager.counters(), "CallsInFlight") == 0);
    assert_eq!(peer.clock_offset(), None);
    assert_eq!(ask(&peer, "number", 1), Ok(1));
    gate.open();
}

/// A function of the same name that moves something, or says something else, is not called.
#[test]
fn a_function_that_only_has_the_name_of_the_clock_is_not_called() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let offer = |name: &str, id, signature: &str, options| {
        let agv = unit(name, id, fleet).build().unwrap();
        let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        agv.my_function_list().add_service(&signature.parse().unwrap(), options, nothing).unwrap();
        let peer = meet(&manager, &agv).0;
        (agv, peer)
    };
    let others = [
        offer("agv1", 1, "clock() -> (unix_ms: int)", ServiceOptions::new()),
        offer("agv2", 2, "clock(unix_us: int) -> (unix_us: int)", ServiceOptions::new()),
        offer("agv3", 3, CLOCK, ServiceOptions::new().stops_all()),
    ];
    // Its list came last.
    let (_told, last) = offer("agv4", 4, CLOCK, ServiceOptions::new());
    until("one is asked", || last.clock_offset().is_some());
    for (agv, peer) in &others {
        assert_eq!((counter(&peer.counters(), "RequestsSent"), peer.clock_offset()), (0, None), "{:?}", agv.identity());
    }
}
