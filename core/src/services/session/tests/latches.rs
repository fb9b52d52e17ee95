//! Only a reset ends a latch: it survives each change of a vehicle's list of functions.

use std::rc::Rc;
use std::vec;

use super::none;
use super::pair::Pair;
use super::setup::{Handler, Run};
use crate::config::Priority;
use crate::distribution::function::{Attributes, Definition};
use crate::distribution::function_list::{Entry, FunctionList, Slot};
use crate::error::Error;
use crate::services::lease::{Latch, Lease};
use crate::storage::Boxed;
use crate::time::{Duration, Instant};

const LEASE: Duration = Duration::from_millis(500);
/// Longer than the rounding of a latch's time.
const MOMENT: Duration = Duration::from_millis(5);
const STOP: Attributes =
    Attributes { priority: Priority::Emergency, idempotent: true, stop: true, ..Attributes::NORMAL };
const RESET: Attributes = Attributes { priority: Priority::Normal, stop: false, reset: true, ..STOP };
const MOVES: Attributes = Attributes { lease: Some(LEASE), ..Attributes::NORMAL };

/// A vehicle whose `go()` moves the drive; `halt()` stops all, `free()` resets all, `free_drive()` the drive.
fn vehicle() -> (Pair, Slot) {
    let mut pair = Pair::live();
    let go = pair.agv.offer_leased("go()", LEASE);
    pair.agv.offer_control("halt()", STOP, None);
    pair.agv.offer_control("free()", RESET, None);
    pair.agv.offer_control("free_drive()", RESET, Some(go));
    pair.publish();
    (pair, go)
}

fn call(pair: &mut Pair, function: &str) -> Result<(), Error> {
    pair.run(MOMENT);
    let id = pair.manager.call(function, &none()).unwrap();
    pair.settle();
    if !pair.agv.held.is_empty() {
        pair.agv.answer_held(Ok(&none()));
        pair.settle();
    }
    pair.manager.outcome(id).unwrap().map(drop)
}

/// The vehicle stops what this function moves.
fn stop_itself(pair: &Pair, function: Slot) {
    let word = pair.agv.functions.function(function).unwrap().handler.lease.as_ref().unwrap();
    word.inhibit(pair.agv.now, Latch { by: 0, reason: 0 });
}

/// A handler with its own drive.
fn fresh() -> (Handler, Rc<Lease>) {
    let lease = Rc::<Lease>::default();
    (Handler::new(Run::Now(|_| Ok(())), Some(Rc::clone(&lease))), lease)
}

fn stopped(by: u32) -> Result<(), Error> {
    Err(Error::Inhibited { by, reason: 0 })
}

#[test]
fn what_is_added_after_a_stop_of_all_is_stopped_until_a_reset_of_all() {
    let (mut pair, _) = vehicle();
    assert_eq!(call(&mut pair, "halt"), Ok(()));
    pair.agv.offer_leased("lift()", LEASE);
    pair.publish();
    assert_eq!(call(&mut pair, "lift"), stopped(1));
    assert_eq!(call(&mut pair, "free"), Ok(()));
    pair.agv.offer_leased("tilt()", LEASE);
    pair.publish();
    for function in ["go", "lift", "tilt"] {
        assert_eq!(call(&mut pair, function), Ok(()), "{function}");
    }
}

#[test]
fn a_stop_of_all_has_ended_when_each_thing_that_it_stopped_is_reset() {
    let (mut pair, _) = vehicle();
    assert_eq!(call(&mut pair, "halt"), Ok(()));
    let lift = pair.agv.offer_leased("lift()", LEASE);
    pair.agv.offer_control("free_lift()", RESET, Some(lift));
    pair.publish();
    assert_eq!(call(&mut pair, "free_drive"), Ok(()));
    assert_eq!((call(&mut pair, "go"), call(&mut pair, "lift")), (Ok(()), stopped(1)));
    pair.agv.offer_leased("tilt()", LEASE);
    pair.publish();
    assert_eq!(call(&mut pair, "tilt"), stopped(1), "not all is reset");
    assert_eq!((call(&mut pair, "free_lift"), call(&mut pair, "free")), (Ok(()), Ok(())));
    pair.agv.functions.remove("tilt").unwrap();
    pair.agv.offer_leased("tilt()", LEASE);
    pair.publish();
    assert_eq!(call(&mut pair, "tilt"), Ok(()));
}

#[test]
fn what_takes_the_place_of_a_stopped_service_is_stopped_and_only_that() {
    for stops_all in [true, false] {
        let (mut pair, go) = vehicle();
        pair.agv.offer_leased("lift()", LEASE);
        pair.publish();
        if stops_all {
            assert_eq!(call(&mut pair, "halt"), Ok(()));
        } else {
            stop_itself(&pair, go);
        }
        let (handler, drive) = fresh();
        pair.agv.functions.replace(&Definition::parse("go()").unwrap(), MOVES, handler).unwrap();
        pair.publish();
        let by = u32::from(stops_all);
        assert_eq!(call(&mut pair, "go"), stopped(by));
        assert_eq!(call(&mut pair, "lift"), if stops_all { stopped(by) } else { Ok(()) });
        assert_eq!(call(&mut pair, "free"), Ok(()));
        assert!(!drive.is_inhibited());
        assert_eq!(call(&mut pair, "go"), Ok(()));
    }
}

#[test]
fn a_stopped_service_that_is_removed_and_added_again_is_stopped() {
    let (mut pair, go) = vehicle();
    pair.agv.functions.remove("free_drive").unwrap();
    stop_itself(&pair, go);
    pair.agv.functions.remove("go").unwrap();
    pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    assert_eq!(call(&mut pair, "go"), stopped(0));
    assert_eq!((call(&mut pair, "free"), call(&mut pair, "go")), (Ok(()), Ok(())));
}

#[test]
fn a_reset_of_another_actuator_leaves_what_was_removed_stopped() {
    for is_replaced in [false, true] {
        let (mut pair, _) = vehicle();
        let lift = pair.agv.offer_leased("lift()", LEASE);
        stop_itself(&pair, lift);
        if is_replaced {
            let without = Handler::new(Run::Now(|_| Ok(())), None);
            let lift = Definition::parse("lift()").unwrap();
            pair.agv.functions.replace(&lift, Attributes::NORMAL, without).unwrap();
        }
        pair.agv.functions.remove("lift").unwrap();
        pair.publish();
        assert_eq!(call(&mut pair, "free_drive"), Ok(()));
        pair.agv.offer_leased("lift()", LEASE);
        pair.publish();
        assert_eq!(call(&mut pair, "lift"), stopped(0));
        assert_eq!(call(&mut pair, "free"), Ok(()));
        // From here on nothing that was removed is stopped: resets of each actuator end a stop of all again.
        let lift = pair.agv.functions.find("lift").unwrap();
        pair.agv.offer_control("free_lift()", RESET, Some(lift));
        pair.publish();
        for function in ["halt", "free_drive", "free_lift"] {
            assert_eq!(call(&mut pair, function), Ok(()), "{function}");
        }
        pair.agv.offer_leased("tilt()", LEASE);
        pair.publish();
        assert_eq!(call(&mut pair, "tilt"), Ok(()));
    }
}

#[test]
fn a_function_that_stops_moving_leaves_its_actuator_to_the_others() {
    let (mut pair, go) = vehicle();
    pair.agv.offer_sharing("dock()", LEASE, go);
    stop_itself(&pair, go);
    let without = || Handler::new(Run::Now(|_| Ok(())), None);
    let go = Definition::parse("go()").unwrap();
    pair.agv.functions.replace(&go, Attributes::NORMAL, without()).unwrap();
    pair.agv.offer_leased("lift()", LEASE);
    pair.publish();
    assert_eq!((call(&mut pair, "lift"), call(&mut pair, "dock")), (Ok(()), stopped(0)));
    let dock = Definition::parse("dock()").unwrap();
    pair.agv.functions.replace(&dock, Attributes::NORMAL, without()).unwrap();
    pair.agv.offer_leased("tilt()", LEASE);
    pair.publish();
    assert_eq!(call(&mut pair, "tilt"), Ok(()), "its reset is of what was stopped");
    pair.agv.functions.remove("free_drive").unwrap();
    pair.agv.offer_leased("turn()", LEASE);
    pair.publish();
    assert_eq!(call(&mut pair, "turn"), stopped(0), "nothing is of what was stopped");
}

#[test]
fn what_is_added_beside_its_reset_after_a_stop_of_all_is_stopped() {
    for resets_all in [true, false] {
        let (mut pair, _) = vehicle();
        pair.agv.functions.remove("go").unwrap();
        assert_eq!(call(&mut pair, "halt"), Ok(()));
        let reset = pair.agv.functions.find("free_drive").unwrap();
        if resets_all {
            assert_eq!(call(&mut pair, "free"), Ok(()));
        }
        pair.agv.offer_sharing("go()", LEASE, reset);
        pair.publish();
        assert_eq!(call(&mut pair, "go"), if resets_all { Ok(()) } else { stopped(1) });
        assert_eq!((call(&mut pair, "free"), call(&mut pair, "go")), (Ok(()), Ok(())));
    }
}

#[test]
fn a_reset_of_one_actuator_leaves_the_others_stopped_though_nothing_moves_yet() {
    let (mut pair, _) = vehicle();
    let lift = pair.agv.offer_leased("lift()", LEASE);
    let free_lift = pair.agv.offer_control("free_lift()", RESET, Some(lift));
    for function in ["go", "lift"] {
        pair.agv.functions.remove(function).unwrap();
    }
    assert_eq!((call(&mut pair, "halt"), call(&mut pair, "free_drive")), (Ok(()), Ok(())));
    pair.agv.offer_leased("tilt()", LEASE);
    pair.agv.offer_sharing("lift()", LEASE, free_lift);
    let free_drive = pair.agv.functions.find("free_drive").unwrap();
    pair.agv.offer_sharing("go()", LEASE, free_drive);
    pair.publish();
    assert_eq!(["tilt", "lift", "go"].map(|function| call(&mut pair, function)), [stopped(1), stopped(1), Ok(())]);
}

#[test]
fn what_is_removed_and_added_beside_its_reset_is_stopped_and_only_that() {
    let (mut pair, go) = vehicle();
    pair.agv.offer_sharing("dock()", LEASE, go);
    stop_itself(&pair, go);
    for function in ["go", "dock"] {
        pair.agv.functions.remove(function).unwrap();
    }
    pair.agv.offer_leased("lift()", LEASE);
    let reset = pair.agv.functions.find("free_drive").unwrap();
    for function in ["go()", "dock()"] {
        pair.agv.offer_sharing(function, LEASE, reset);
    }
    pair.publish();
    assert_eq!(["lift", "go", "dock"].map(|function| call(&mut pair, function)), [Ok(()), stopped(0), stopped(0)]);
    assert_eq!(["free_drive", "go", "dock"].map(|function| call(&mut pair, function)), [Ok(()), Ok(()), Ok(())]);
}

#[test]
fn what_moves_in_place_of_a_stop_is_stopped_where_that_was_of_something_stopped() {
    let (mut pair, go) = vehicle();
    pair.agv.offer_control("halt_drive()", STOP, Some(go));
    stop_itself(&pair, go);
    let (handler, drive) = fresh();
    pair.agv.functions.replace(&Definition::parse("halt_drive()").unwrap(), MOVES, handler).unwrap();
    pair.publish();
    assert_eq!(call(&mut pair, "halt_drive"), stopped(0));
    assert_eq!((call(&mut pair, "free_drive"), drive.is_inhibited()), (Ok(()), true));
    assert_eq!((call(&mut pair, "free"), call(&mut pair, "halt_drive")), (Ok(()), Ok(())));
}

/// As without the change: what takes the place of a drive that was reset is no news.
#[test]
fn what_takes_the_place_of_what_was_reset_is_not_stopped_and_a_stop_in_its_place_is() {
    let (mut pair, go) = vehicle();
    pair.agv.offer_control("halt_drive()", STOP, Some(go));
    pair.agv.offer_leased("lift()", LEASE);
    pair.publish();
    assert_eq!((call(&mut pair, "halt"), call(&mut pair, "free_drive")), (Ok(()), Ok(())));
    for (function, attributes, is_stopped) in
        [("go()", MOVES, false), ("go()", STOP, true), ("halt_drive()", MOVES, true)]
    {
        let (handler, drive) = fresh();
        pair.agv.functions.replace(&Definition::parse(function).unwrap(), attributes, handler).unwrap();
        assert_eq!(drive.is_inhibited(), is_stopped, "{function} {attributes:?}");
    }
}

#[test]
fn a_stop_in_place_of_what_moves_leaves_the_unit_stopped() {
    let (mut pair, go) = vehicle();
    pair.agv.functions.remove("free_drive").unwrap();
    stop_itself(&pair, go);
    let (handler, other) = fresh();
    pair.agv.functions.replace(&Definition::parse("go()").unwrap(), STOP, handler).unwrap();
    pair.agv.offer_leased("lift()", LEASE);
    // It is of an actuator that has come into the list later.
    pair.agv.offer_sharing("tilt()", LEASE, go);
    pair.publish();
    assert!(other.is_inhibited());
    assert_eq!((call(&mut pair, "lift"), call(&mut pair, "tilt")), (stopped(0), stopped(0)));
    assert_eq!(["free", "lift", "tilt"].map(|function| call(&mut pair, function)), [Ok(()); 3]);
}

#[test]
fn what_could_not_be_replaced_leaves_the_unit_as_it_was() {
    let entries = (0..2).map(|_| Entry::empty()).collect();
    let mut functions = FunctionList::<Boxed, _>::new(entries, vec![0; 16].into_boxed_slice());
    let (handler, drive) = fresh();
    functions.add_signature(Definition::parse("go()").unwrap().signature(), MOVES, handler).unwrap();
    drive.inhibit(Instant::from_micros(9_000_000), Latch { by: 0, reason: 0 });
    let longer = Definition::parse("go(where_to: float[2])").unwrap();
    let without = Handler::new(Run::Now(|_| Ok(())), None);
    assert!(matches!(functions.replace(&longer, Attributes::NORMAL, without), Err(Error::Full(_))));
    assert!(!functions.stopped().is_inhibited());
}

#[test]
fn a_stop_of_all_ends_with_the_last_reset_and_not_before() {
    for shares in [true, false] {
        let (mut pair, go) = vehicle();
        let lift = pair.agv.offer_leased("lift()", LEASE);
        pair.agv.offer_control("free_lift()", RESET, Some(lift));
        if shares {
            pair.agv.offer_sharing("dock()", LEASE, go);
        }
        pair.publish();
        assert_eq!((call(&mut pair, "halt"), call(&mut pair, "free_lift")), (Ok(()), Ok(())));
        if !shares {
            assert_eq!(call(&mut pair, "free_drive"), Ok(()));
        }
        pair.agv.offer_leased("tilt()", LEASE);
        pair.publish();
        assert_eq!(call(&mut pair, "tilt"), if shares { stopped(1) } else { Ok(()) });
    }
}

#[test]
fn a_reset_whose_function_is_gone_when_it_is_answered_resets_nothing() {
    for is_removed in [true, false] {
        let (mut pair, go) = vehicle();
        pair.agv.offer_leased("lift()", LEASE);
        pair.publish();
        assert_eq!(call(&mut pair, "halt"), Ok(()));
        pair.run(MOMENT);
        let id = pair.manager.call("free_drive", &none()).unwrap();
        pair.settle();
        assert!(!pair.agv.held.is_empty());
        pair.agv.functions.remove("free_drive").unwrap();
        if !is_removed {
            pair.agv.offer_control("free_drive()", RESET, Some(go));
        }
        pair.agv.answer_held(Ok(&none()));
        pair.settle();
        assert_eq!(pair.manager.outcome(id).unwrap().map(drop), Err(Error::StaleFunction));
        assert_eq!((call(&mut pair, "go"), call(&mut pair, "lift")), (stopped(1), stopped(1)));
        assert_eq!((call(&mut pair, "free"), call(&mut pair, "go"), call(&mut pair, "lift")), (Ok(()), Ok(()), Ok(())));
    }
}

#[test]
fn a_drive_that_was_reset_by_itself_is_not_stopped_again_by_what_comes_to_move_it() {
    let (mut pair, go) = vehicle();
    assert_eq!((call(&mut pair, "halt"), call(&mut pair, "free_drive")), (Ok(()), Ok(())));
    pair.agv.offer_sharing("dock()", LEASE, go);
    pair.publish();
    assert_eq!((call(&mut pair, "dock"), call(&mut pair, "go")), (Ok(()), Ok(())));
}

/// A vehicle that was stopped when it lost power, and either stores one bit or has a program that says so.
#[test]
fn a_unit_that_starts_stopped_stops_all_that_it_adds() {
    let mut pair = Pair::live();
    pair.agv.functions.stopped().inhibit(pair.agv.now, Latch { by: 0, reason: 7 });
    pair.agv.offer_leased("go()", LEASE);
    pair.agv.offer_control("free()", RESET, None);
    pair.publish();
    assert_eq!(call(&mut pair, "go"), Err(Error::Inhibited { by: 0, reason: 7 }));
    assert_eq!((call(&mut pair, "free"), call(&mut pair, "go")), (Ok(()), Ok(())));
}

/// A stop of all also stops functions that its caller cannot see.
#[test]
fn a_stop_of_all_stops_what_is_shown_to_other_nodes() {
    let (mut pair, _) = vehicle();
    let (handler, drive) = fresh();
    pair.agv.functions.add_function(&Definition::parse("hidden()").unwrap(), MOVES, handler).unwrap();
    assert_eq!(call(&mut pair, "halt"), Ok(()));
    assert!(drive.is_inhibited());
}
