//! Actuators: functions share one, one order at a time has it, and a stop ends that order and keeps others from beginning.

use std::vec::Vec;

use super::super::{Event, RequestOptions};
use super::none;
use super::pair::Pair;
use crate::config::{LEASES, Priority};
use crate::distribution::claim;
use crate::distribution::function::Attributes;
use crate::distribution::function_list::Slot;
use crate::error::{Error, Limit, ServiceError};
use crate::services::heart::Renew;
use crate::services::lease::{ActuatorState, Claim, LastOrder, Latch, Lease, LeaseEnd, Service as _};
use crate::services::requests::CallId;
use crate::time::{Duration, Instant};

const LEASE: Duration = Duration::from_millis(500);
/// Longer than the rounding of a latch's time.
const MOMENT: Duration = Duration::from_millis(5);

const STOP: Attributes =
    Attributes { priority: Priority::Emergency, idempotent: true, stop: true, ..Attributes::NORMAL };
const RESET: Attributes = Attributes { priority: Priority::Normal, stop: false, reset: true, ..STOP };

/// A vehicle whose `go()` and `dock()` move the drive, and `lift()` the fork; `halt()` stops all, `free()` resets all.
fn vehicle() -> (Pair, [Slot; 3]) {
    let mut pair = Pair::live();
    let go = pair.agv.offer_leased("go()", LEASE);
    let dock = pair.agv.offer_sharing("dock()", LEASE, go);
    let lift = pair.agv.offer_leased("lift()", LEASE);
    pair.agv.offer_control("halt()", STOP, None);
    pair.agv.offer_control("free()", RESET, None);
    pair.publish();
    (pair, [go, dock, lift])
}

fn call(pair: &mut Pair, function: &str) -> CallId {
    let id = pair.manager.call(function, &none()).unwrap();
    pair.settle();
    id
}

/// The same for a function whose calls the test answers, with this answer.
fn control(pair: &mut Pair, function: &str, answer: Result<(), Error>) -> CallId {
    let id = call(pair, function);
    answer_held(pair, answer);
    id
}

fn answer_held(pair: &mut Pair, answer: Result<(), Error>) {
    let results = none();
    match answer {
        Ok(()) => pair.agv.answer_held(Ok(&results)),
        Err(error) => pair.agv.answer_held(Err(error)),
    }
    pair.settle();
}

fn outcome(pair: &Pair, id: CallId) -> Result<(), Error> {
    pair.manager.outcome(id).expect("it has an outcome").map(|_| ())
}

/// The state of a function's actuator as the manager was last notified.
fn state(pair: &Pair, slot: Slot) -> Option<ActuatorState> {
    let reported = pair.manager.happened.iter().rev();
    reported.copied().find_map(|event| match event {
        Event::Actuator { slot: of, state } => (of == slot).then_some(state),
        _ => None,
    })
}

fn hooks(pair: &Pair) -> usize {
    pair.agv.count(|event| matches!(event, Event::LeaseExpired(_)))
}

fn latch(pair: &Pair, slot: Slot) -> Option<Latch> {
    pair.agv.functions.function(slot).unwrap().handler.lease().unwrap().latch()
}

#[test]
fn a_newer_order_of_the_same_actuator_takes_the_place_of_the_older_one_without_the_hook() {
    let (mut pair, [go, dock, lift]) = vehicle();
    let (first, other) = (call(&mut pair, "go"), call(&mut pair, "lift"));
    let second = call(&mut pair, "dock");
    assert_eq!((outcome(&pair, first), outcome(&pair, second)), (Ok(()), Ok(())));
    assert!(pair.manager.is_reported(first, LeaseEnd::Replaced) && hooks(&pair) == 0);
    pair.run(Duration::from_secs(2));
    assert!(pair.agv.is_live(go) && pair.agv.is_live(dock) && pair.agv.is_live(lift), "{other:?} goes on as well");
    assert!(pair.manager.session.holds(second) && !pair.manager.session.holds(first));
    // The holder releases it: the drive stops, the fork does not.
    pair.manager.release(dock).unwrap();
    pair.settle();
    assert!(!pair.agv.is_live(go) && pair.agv.is_live(lift) && hooks(&pair) == 1);
}

#[test]
fn functions_that_move_the_same_thing_are_published_with_the_same_number() {
    let (pair, slots) = vehicle();
    let theirs = pair.manager.session.their_function_list();
    let number = |slot| theirs.function(slot).unwrap().attributes.actuator;
    let [go, dock, lift] = slots.map(number);
    assert!(go != 0 && go == dock && lift == 0, "it shares its own with none");
    assert_eq!(number(theirs.named("halt").unwrap().slot), 0);
}

#[test]
fn what_another_caller_moves_is_held_unless_it_is_taken_over() {
    let (mut pair, [go, ..]) = vehicle();
    let word = pair.agv.functions.function(go).unwrap().handler.lease.clone().unwrap();
    let other = Claim {
        holder: 77,
        replaces: None,
        takes_over: false,
        operator: false,
        link: 0,
        call: 0,
        under: claim::Claim::NONE,
        made: pair.agv.now,
    };
    let order = word.claim(pair.agv.now, pair.agv.now + LEASE, &other).unwrap();
    let refused = call(&mut pair, "dock");
    assert_eq!(outcome(&pair, refused), Err(Error::Held { by: 77, operator: false }));
    assert!(word.is_live_for(order, pair.agv.now));
    let options = RequestOptions { take_over: true, ..RequestOptions::default() };
    let taken = pair.manager.request_with("dock", &none(), &options, true).unwrap();
    pair.settle();
    assert_eq!(outcome(&pair, taken), Ok(()));
    assert!(!word.is_live_for(order, pair.agv.now) && pair.agv.is_live(go));
    assert!(!word.renew(order, pair.agv.now + LEASE), "it is dead for ever");
    let refused = word.claim(pair.agv.now, pair.agv.now + LEASE, &other);
    assert_eq!(refused, Err(Error::Held { by: 1, operator: false }), "the manager's ID");
}

/// A call of `function`, renewed until it is released.
fn call_of(pair: &mut Pair, operator: bool, take_over: bool, function: &str) -> CallId {
    let options = RequestOptions { operator, take_over, ..RequestOptions::renewing(Renew::Process) };
    let id = pair.manager.request_with(function, &none(), &options, true).unwrap();
    pair.settle();
    id
}

#[test]
fn an_operator_and_the_program_of_one_unit_hold_for_themselves() {
    for operator in [true, false] {
        let (mut pair, [go, ..]) = vehicle();
        let first = call_of(&mut pair, operator, false, "go");
        let refused = call_of(&mut pair, !operator, false, "dock");
        assert_eq!(outcome(&pair, refused), Err(Error::Held { by: 1, operator }));
        pair.run(Duration::from_secs(2));
        assert!(pair.agv.is_live(go) && pair.manager.session.holds(first) && hooks(&pair) == 0, "it goes on");
        // A call of the same holder replaces it, without a hook.
        let newer = call_of(&mut pair, operator, false, "dock");
        assert_eq!(outcome(&pair, newer), Ok(()));
        assert!(pair.manager.is_reported(first, LeaseEnd::Replaced));
        let taken = call_of(&mut pair, !operator, true, "go");
        assert_eq!(outcome(&pair, taken), Ok(()));
        assert!(pair.manager.is_reported(newer, LeaseEnd::Replaced) && !pair.manager.session.holds(newer));
        let refused = call_of(&mut pair, operator, false, "go");
        assert_eq!(outcome(&pair, refused), Err(Error::Held { by: 1, operator: !operator }));
        pair.run(Duration::from_secs(2));
        assert!(pair.agv.is_live(go) && pair.manager.session.holds(taken) && hooks(&pair) == 0);
        // An order that has ended holds nothing.
        pair.manager.release(go).unwrap();
        pair.settle();
        assert!(!pair.agv.is_live(go) && hooks(&pair) == 1);
        let next = call_of(&mut pair, operator, false, "go");
        assert_eq!(outcome(&pair, next), Ok(()));
    }
}

#[test]
fn a_stop_ends_the_order_of_an_operator_and_of_the_program_alike() {
    for operator in [true, false] {
        let (mut pair, [go, ..]) = vehicle();
        let driving = call_of(&mut pair, operator, false, "go");
        let options = RequestOptions { operator: !operator, ..RequestOptions::new() };
        pair.manager.request_with("halt", &none(), &options, true).unwrap();
        pair.settle();
        assert!(!pair.agv.is_live(go) && pair.manager.is_reported(driving, LeaseEnd::Stopped));
        let refused = call_of(&mut pair, operator, true, "go");
        assert_eq!(outcome(&pair, refused), Err(Error::Inhibited { by: 1, reason: 0 }));
    }
}

#[test]
fn calls_of_an_operator_do_not_give_way_to_those_of_the_program() {
    let (mut pair, _) = vehicle();
    // The vehicle's notifications of replaced orders do not arrive.
    pair.manager.net.frozen = true;
    let options = |operator| RequestOptions { operator, ..RequestOptions::renewing(Renew::Process) };
    let request = |pair: &mut Pair, operator| pair.manager.request_with("go", &none(), &options(operator), false);
    let first = request(&mut pair, true).unwrap();
    let others: Vec<_> = (1..LEASES).map(|_| request(&mut pair, false).unwrap()).collect();
    let newest = request(&mut pair, false).unwrap();
    let held = |id: &CallId| pair.manager.session.holds(*id);
    assert!(held(&first) && held(&newest) && !held(&others[0]) && others[1..].iter().all(held));
    let (mut pair, _) = vehicle();
    pair.manager.net.frozen = true;
    let all: Vec<_> = (0..LEASES).map(|_| request(&mut pair, false).unwrap()).collect();
    assert_eq!(request(&mut pair, true), Err(Error::Full(Limit::Leases)));
    assert!(all.iter().all(|id| pair.manager.session.holds(*id)));
}

#[test]
fn a_stop_ends_all_orders_before_its_handler_runs_and_lets_none_begin() {
    let (mut pair, [go, _, lift]) = vehicle();
    let (driving, lifting) = (call(&mut pair, "go"), call(&mut pair, "lift"));
    pair.run(MOMENT);
    let stopping = call(&mut pair, "halt");
    assert!(pair.manager.outcome(stopping).is_none(), "its handler has not answered");
    assert!(!pair.agv.is_live(go) && !pair.agv.is_live(lift) && hooks(&pair) == 2);
    let before = &pair.agv.happened[..pair.agv.ran.last().unwrap().happened];
    let expired = before.iter().filter(|event| matches!(event, Event::LeaseExpired(_)));
    assert_eq!(expired.count(), 2, "both hooks have run when the handler does");
    assert!(
        pair.manager.is_reported(driving, LeaseEnd::Stopped) && pair.manager.is_reported(lifting, LeaseEnd::Stopped)
    );
    let refused = call(&mut pair, "dock");
    assert_eq!(outcome(&pair, refused), Err(Error::Inhibited { by: 1, reason: 0 }));
    // The latch lasts until a reset, whatever becomes of the link and of the stop's own handler.
    answer_held(&mut pair, Ok(()));
    pair.run(Duration::from_secs(60));
    let refused = call(&mut pair, "go");
    assert_eq!(outcome(&pair, refused), Err(Error::Inhibited { by: 1, reason: 0 }));
    assert_eq!(control(&mut pair, "free", Ok(())), CallId(refused.0 + 1));
    let moving = call(&mut pair, "go");
    assert_eq!(outcome(&pair, moving), Ok(()));
    assert!(pair.agv.is_live(go) && hooks(&pair) == 2);
}

#[test]
fn a_stop_of_one_actuator_leaves_the_others() {
    let mut pair = Pair::live();
    let go = pair.agv.offer_leased("go()", LEASE);
    let lift = pair.agv.offer_leased("lift()", LEASE);
    pair.agv.offer_control("halt_drive()", STOP, Some(go));
    pair.agv.offer_control("free_drive()", RESET, Some(go));
    pair.publish();
    let lifting = call(&mut pair, "lift");
    call(&mut pair, "go");
    pair.run(MOMENT);
    control(&mut pair, "halt_drive", Ok(()));
    assert!(!pair.agv.is_live(go) && pair.agv.is_live(lift) && pair.manager.session.holds(lifting));
    let theirs = pair.manager.session.their_function_list();
    let number = |name: &str| theirs.named(name).unwrap().attributes.actuator;
    assert_eq!((number("halt_drive"), number("free_drive")), (number("go"), number("go")));
    pair.run(MOMENT);
    control(&mut pair, "free_drive", Ok(()));
    assert_eq!(latch(&pair, go), None);
}

#[test]
fn a_reset_that_its_service_refuses_lifts_nothing() {
    let (mut pair, [go, ..]) = vehicle();
    control(&mut pair, "halt", Ok(()));
    pair.run(MOMENT);
    control(&mut pair, "free", Err(Error::Service(ServiceError::Failed(3))));
    assert_eq!(latch(&pair, go), Some(Latch { by: 1, reason: 0 }));
    control(&mut pair, "free", Ok(()));
    assert_eq!(latch(&pair, go), None);
}

#[test]
fn a_reset_does_not_undo_a_stop_that_came_while_it_ran() {
    let (mut pair, [go, ..]) = vehicle();
    control(&mut pair, "halt", Ok(()));
    pair.run(MOMENT);
    let resetting = call(&mut pair, "free");
    pair.run(MOMENT);
    // The vehicle stops itself, as by a bumper. The first reason stays.
    let now = pair.agv.now;
    let function = pair.agv.functions.function(go).unwrap();
    function.handler.inhibit(now, Latch { by: 0, reason: 9 });
    answer_held(&mut pair, Ok(()));
    assert_eq!(outcome(&pair, resetting), Err(Error::Inhibited { by: 1, reason: 0 }), "its caller is told");
    assert_eq!(latch(&pair, go), Some(Latch { by: 1, reason: 0 }));
}

#[test]
fn the_vehicles_own_latch_is_told_with_its_reason() {
    let (mut pair, [go, ..]) = vehicle();
    let driving = call(&mut pair, "go");
    let now = pair.agv.now;
    pair.agv.functions.function(go).unwrap().handler.inhibit(now, Latch { by: 0, reason: 9 });
    assert!(!pair.agv.is_live(go), "at once");
    pair.run(LEASE);
    assert!(pair.manager.is_reported(driving, LeaseEnd::Stopped) && hooks(&pair) == 1);
    let refused = call(&mut pair, "go");
    assert_eq!(outcome(&pair, refused), Err(Error::Inhibited { by: 0, reason: 9 }));
}

#[test]
fn a_stop_is_noticed_on_a_link_that_has_nothing_to_do() {
    let mut pair = Pair::live();
    let go = pair.agv.offer_leased("go()", Duration::from_secs(600));
    pair.publish();
    let driving = call(&mut pair, "go");
    let now = pair.agv.now;
    pair.agv.functions.function(go).unwrap().handler.inhibit(now, Latch { by: 0, reason: 9 });
    // One keep-alive interval later.
    pair.run(Duration::from_millis(1_001));
    assert!(pair.manager.is_reported(driving, LeaseEnd::Stopped) && hooks(&pair) == 1);
}

#[test]
fn a_call_that_was_made_before_the_stop_does_not_begin_after_the_reset() {
    let (mut pair, [go, ..]) = vehicle();
    // The stop overtakes the call: it is in another class, and the stream is stuck.
    pair.manager.net.frozen = true;
    let old = pair.manager.call("go", &none()).unwrap();
    pair.manager.call("halt", &none()).unwrap();
    pair.settle();
    assert!(!pair.agv.held.is_empty(), "the datagram of the stop has come");
    is_older_than_the_stop(&mut pair, go, old);
}

/// The stop is reset, and then a call that was made before the stop arrives.
fn is_older_than_the_stop(pair: &mut Pair, go: Slot, old: CallId) {
    pair.run(MOMENT);
    let word = pair.agv.functions.function(go).unwrap().handler.lease.clone().unwrap();
    word.reset(pair.agv.now, pair.agv.now);
    assert!(!word.is_inhibited());
    pair.manager.net.frozen = false;
    pair.settle();
    assert_eq!(outcome(pair, old), Err(Error::Expired));
    assert!(!pair.agv.is_live(go));
}

/// A call that is older than a stop begins on no link, whichever link brought the stop.
#[test]
fn a_call_of_another_unit_that_was_made_before_the_stop_does_not_begin_after_the_reset() {
    let (mut pair, [go, ..]) = vehicle();
    pair.manager.net.frozen = true;
    let old = pair.manager.call("go", &none()).unwrap();
    pair.settle();
    pair.run(MOMENT);
    let word = pair.agv.functions.function(go).unwrap().handler.lease.clone().unwrap();
    word.inhibit(pair.agv.now, Latch { by: 77, reason: 0 });
    is_older_than_the_stop(&mut pair, go, old);
    let new = call(&mut pair, "go");
    assert!(pair.agv.is_live(go), "{:?}", outcome(&pair, new));
}

/// A stop from an interrupt may come between the two steps of a reset, and within the same millisecond as the stop before.
#[test]
fn a_reset_lifts_no_stop_but_the_one_that_it_saw() {
    let (lease, now) = (Lease::new(), Instant::from_micros(1_000_000));
    for _ in 0..3 {
        lease.inhibit(now, Latch { by: 0, reason: 1 });
        assert!(lease.is_inhibited());
        lease.reset(now + MOMENT, now + MOMENT);
        assert!(!lease.is_inhibited());
    }
}

/// Orders of two actuators may have the same number.
#[test]
fn what_is_finished_is_an_order_of_the_actuator_that_was_named() {
    let (mut pair, [go, dock, lift]) = vehicle();
    let (drives, lifts) = (call(&mut pair, "go"), call(&mut pair, "lift"));
    let [driving, lifting] = [drives, lifts].map(|call| pair.agv.order_of(call));
    assert_eq!(driving, lifting);
    assert!(pair.agv.end_order(lift, lifting) && !pair.agv.end_order(lift, driving));
    pair.run(LEASE);
    assert!(pair.agv.is_live(go) && !pair.agv.is_live(lift));
    assert!(pair.manager.is_reported(lifts, LeaseEnd::Finished) && pair.manager.session.holds(drives));
    // By any function of the actuator: the order belongs to the actuator.
    assert!(pair.agv.end_order(dock, driving));
    pair.run(LEASE);
    assert!(pair.manager.is_reported(drives, LeaseEnd::Finished) && hooks(&pair) == 0);
}

/// A stopped order is not finished, even if its program reports that before the session has looked at the lease.
#[test]
fn what_was_stopped_is_made_safe_and_not_finished() {
    let (mut pair, [go, ..]) = vehicle();
    let driving = call(&mut pair, "go");
    let now = pair.agv.now;
    pair.agv.functions.function(go).unwrap().handler.inhibit(now, Latch { by: 0, reason: 9 });
    let order = pair.agv.order_of(driving);
    assert!(!pair.agv.end_order(go, order));
    pair.run(LEASE);
    assert!(pair.manager.is_reported(driving, LeaseEnd::Stopped) && hooks(&pair) == 1);
}

#[test]
fn nothing_comes_alive_under_a_latch() {
    let (lease, now) = (Lease::new(), Instant::from_micros(1_000_000));
    let claim = Claim {
        holder: 1,
        replaces: None,
        takes_over: true,
        operator: false,
        link: 0,
        call: 0,
        under: claim::Claim::NONE,
        made: now,
    };
    let order = lease.claim(now, now + LEASE, &claim).unwrap();
    lease.inhibit(now, Latch { by: 0, reason: 1 });
    assert!(!lease.is_live(now) && !lease.lasts_beyond(now) && !lease.renew(order, now + LEASE));
    assert_eq!(lease.claim(now, now + LEASE, &claim), Err(Error::Inhibited { by: 0, reason: 1 }));
    assert_eq!(lease.begin(now, now + LEASE), None);
    // The hook still has to run after the reset.
    lease.reset(now + MOMENT, now + MOMENT);
    assert_eq!(lease.latch(), None);
    assert_eq!(lease.claim(now + MOMENT, now + LEASE, &claim), Err(Error::Expired), "it was made before the stop");
    let claim = Claim { made: now + MOMENT, ..claim };
    assert_eq!(lease.claim(now + MOMENT, now + LEASE, &claim), Err(Error::Busy));
    assert!(!lease.is_live_for(order, now + MOMENT));
    assert!(lease.end(now, order, LeaseEnd::Expired) && lease.claim(now + MOMENT, now + LEASE, &claim).is_ok());
}

#[test]
fn a_reset_counts_from_when_it_was_made_however_long_the_latch_is_old() {
    let day = Duration::from_secs(24 * 3_600);
    for days in [0, 1, 24, 25, 26, 49] {
        let (lease, now) = (Lease::new(), Instant::from_micros(7_000_000));
        lease.inhibit(now, Latch { by: 0, reason: 1 });
        let later = now + day.times(days) + Duration::from_secs(10);
        lease.reset(later, now);
        assert!(lease.is_inhibited(), "after {days} days: it was made when the stop was");
        lease.reset(later, later);
        assert!(!lease.is_inhibited(), "after {days} days");
    }
}

#[test]
fn the_caller_is_told_the_state_of_what_it_moves() {
    let (mut pair, [go, dock, lift]) = vehicle();
    pair.run(Duration::from_secs(3));
    assert_eq!([go, dock, lift].map(|slot| state(&pair, slot)), [None; 3], "there is nothing to say");
    let moves = call(&mut pair, "go");
    pair.run(Duration::from_secs(1));
    let link = pair.manager.session.wire.nonce as u32;
    let last = LastOrder { holder: 1, link, call: moves.0, claim: claim::Claim::NONE, end: None };
    assert_eq!([go, dock].map(|slot| state(&pair, slot)), [Some(ActuatorState { latch: None, last: Some(last) }); 2]);
    assert_eq!(state(&pair, lift), Some(ActuatorState::default()));
    let events = pair.manager.happened.len();
    pair.run(Duration::from_secs(5));
    assert_eq!(pair.manager.happened.len(), events, "what has not changed is not told again");
    let order = pair.agv.order_of(moves);
    assert!(pair.agv.end_order(go, order));
    pair.run(Duration::from_secs(1));
    let last = LastOrder { end: Some(LeaseEnd::Finished), ..last };
    assert_eq!(state(&pair, dock).unwrap().last, Some(last));
}

#[test]
fn what_its_caller_gave_up_is_told_as_released() {
    let (mut pair, [go, dock, _]) = vehicle();
    let ended = |pair: &Pair| state(pair, dock).and_then(|reported| reported.last).and_then(|last| last.end);
    let moves = call(&mut pair, "go");
    pair.manager.cancel(moves);
    pair.run(Duration::from_secs(1));
    assert_eq!((ended(&pair), hooks(&pair)), (Some(LeaseEnd::Released), 1));
    call(&mut pair, "go");
    pair.manager.release(go).unwrap();
    pair.run(Duration::from_secs(1));
    assert_eq!((ended(&pair), hooks(&pair)), (Some(LeaseEnd::Released), 2));
    // The session of its link processes the release before it checks for other stops.
    let moves = call(&mut pair, "go");
    let now = pair.agv.now;
    pair.agv.functions.function(go).unwrap().handler.inhibit(now, Latch { by: 0, reason: 9 });
    pair.manager.cancel(moves);
    pair.run(Duration::from_secs(1));
    assert_eq!((ended(&pair), hooks(&pair)), (Some(LeaseEnd::Stopped), 3));
}

#[test]
fn a_latch_and_its_end_are_told_at_once() {
    let (mut pair, [go, _, lift]) = vehicle();
    let lifts = call(&mut pair, "lift");
    control(&mut pair, "halt", Ok(()));
    let latch = Some(Latch { by: 1, reason: 0 });
    let reported = state(&pair, lift).unwrap();
    assert_eq!((reported.latch, state(&pair, go).unwrap().latch), (latch, latch));
    let last = reported.last.unwrap();
    assert_eq!((last.call, last.end), (lifts.0, Some(LeaseEnd::Stopped)));
    pair.run(MOMENT);
    control(&mut pair, "free", Ok(()));
    assert_eq!(state(&pair, go).unwrap().latch, None);
}

#[test]
fn the_vehicles_own_latch_is_told_within_a_keep_alive() {
    let (mut pair, [go, ..]) = vehicle();
    let latch = Latch { by: 0, reason: 7 };
    pair.agv.functions.function(go).unwrap().handler.inhibit(pair.agv.now, latch);
    pair.run(crate::config::Constraints::S_UNIT.keep_alive);
    assert_eq!(state(&pair, go), Some(ActuatorState { latch: Some(latch), last: None }));
}

/// In plain mode the link's nonce is a secret.
#[test]
fn who_moves_it_is_told_to_others_but_not_by_which_link() {
    let (mut pair, [go, ..]) = vehicle();
    let word = pair.agv.functions.function(go).unwrap().handler.lease.clone().unwrap();
    let other = Claim {
        holder: 77,
        replaces: None,
        takes_over: false,
        operator: false,
        link: 5,
        call: 6,
        under: claim::Claim::NONE,
        made: pair.agv.now,
    };
    word.claim(pair.agv.now, pair.agv.now + LEASE, &other).unwrap();
    pair.run(crate::config::Constraints::S_UNIT.keep_alive);
    let last = state(&pair, go).unwrap().last.unwrap();
    assert_eq!(last, LastOrder { holder: 77, link: 0, call: 0, claim: claim::Claim::NONE, end: None });
}

#[test]
fn what_the_peer_may_call_later_is_told_as_well() {
    let (mut pair, [go, ..]) = vehicle();
    call(&mut pair, "go");
    pair.run(Duration::from_secs(2));
    let park = pair.agv.offer_sharing("park()", LEASE, go);
    pair.publish();
    assert!(state(&pair, park).unwrap().last.is_some());
}

#[test]
fn a_reset_whose_caller_has_seen_it_fail_lifts_nothing() {
    for late in [None, Some(Duration::ZERO), Some(MOMENT)] {
        let (mut pair, [go, ..]) = vehicle();
        control(&mut pair, "halt", Ok(()));
        pair.run(MOMENT);
        let free = call(&mut pair, "free");
        match late {
            Some(late) => pair.agv.now = pair.agv.held[0].deadline + late,
            None if cfg!(feature = "details") => {
                pair.manager.cancel(free);
                pair.settle();
            }
            None => continue,
        }
        answer_held(&mut pair, Ok(()));
        assert_eq!(latch(&pair, go), Some(Latch { by: 1, reason: 0 }), "{late:?}");
    }
}

#[test]
fn a_release_ends_what_its_function_moves_and_nothing_else() {
    let (mut pair, [go, _, lift]) = vehicle();
    let (driving, lifting) = (call(&mut pair, "go"), call(&mut pair, "lift"));
    pair.manager.release(lift).unwrap();
    pair.settle();
    assert!(pair.agv.is_live(go) && !pair.agv.is_live(lift));
    pair.run(LEASE.times(4));
    assert!(pair.agv.is_live(go) && hooks(&pair) == 1);
    assert!(pair.manager.session.holds(driving) && !pair.manager.session.holds(lifting));
}
