//! A lease belongs to one call: the failure of a call ends what it started, and nothing else.

use std::vec::Vec;

use super::super::Event;
use super::super::{Incoming, RequestOptions};
use super::net::Datagrams;
use super::pair::Pair;
use super::{none, x};
use crate::config::{LEASES, Priority};
use crate::distribution::connection_handler::Directive;
use crate::distribution::function_list::Slot;
use crate::distribution::message::{Renewal, SessionBody};
use crate::error::Error;
use crate::host::connections::LinkCounter;
use crate::services::heart::Renew;
use crate::services::lease::LeaseEnd;
use crate::services::requests::CallId;
use crate::time::Duration;

const LEASE: Duration = Duration::from_millis(500);
const TIMEOUT: Duration = Duration::from_millis(300);

fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// A pair whose vehicle offers `go()`; the test answers it.
fn vehicle() -> (Pair, Slot) {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_held_lease("go()", LEASE);
    pair.publish();
    (pair, slot)
}

/// Calls `go()`. Two calls in different classes run side by side.
fn go(pair: &mut Pair, class: Priority, renew: Renew) -> CallId {
    let options = RequestOptions { renew, priority: Some(class), timeout: Some(TIMEOUT), ..RequestOptions::default() };
    pair.manager.request_with("go", &none(), &options, true).unwrap()
}

/// The same, once it has begun; returns what its handler got.
fn started(pair: &mut Pair, class: Priority) -> (CallId, Incoming) {
    let id = go(pair, class, Renew::Process);
    pair.settle();
    (id, *pair.agv.held.last().unwrap())
}

fn expirations(pair: &Pair) -> usize {
    pair.agv.count(|event| matches!(event, Event::LeaseExpired(_)))
}

fn is_reported(pair: &Pair, call: CallId, why: LeaseEnd) -> bool {
    pair.manager.is_reported(call, why)
}

#[test]
fn a_call_that_times_out_is_released_at_once_renewed_or_not() {
    for renew in [Renew::Process, Renew::Never] {
        let (mut pair, slot) = vehicle();
        let id = go(&mut pair, Priority::Normal, renew);
        pair.run(TIMEOUT - millis(1));
        assert!(pair.agv.is_live(slot));
        pair.run(millis(1));
        assert_eq!(pair.manager.outcome(id), Some(Err(Error::TimedOut)));
        assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1), "{renew:?}");
        pair.agv.answer_held(Ok(&*none()));
        pair.run(LEASE.times(2));
        assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1));
        assert_eq!(pair.agv.counter(LinkCounter::RenewalsIgnored), 0, "it is renewed no more");
    }
}

#[test]
fn a_call_whose_answer_does_not_come_through_is_released_at_once() {
    let (mut pair, slot) = vehicle();
    let id = go(&mut pair, Priority::Normal, Renew::Process);
    pair.settle();
    (pair.agv.net.frozen, pair.agv.net.datagrams) = (true, Datagrams::Lost);
    pair.agv.answer_held(Ok(&*none()));
    pair.run(TIMEOUT);
    assert_eq!(pair.manager.outcome(id), Some(Err(Error::TimedOut)));
    assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1));
    pair.agv.net.frozen = false;
    pair.run(LEASE.times(2));
    assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1));
}

#[test]
fn a_cancelled_call_is_released_at_once_waited_for_or_answered_renewed_or_not() {
    for (answered, renew) in
        [(false, Renew::Process), (true, Renew::Process), (false, Renew::Never), (true, Renew::Never)]
    {
        let (mut pair, slot) = vehicle();
        let id = go(&mut pair, Priority::High, renew);
        pair.settle();
        if answered {
            pair.agv.answer_held(Ok(&*none()));
            pair.settle();
        }
        pair.run(millis(100));
        assert!(pair.agv.is_live(slot) && pair.manager.session.holds(id) == (renew == Renew::Process));
        pair.manager.cancel(id);
        pair.settle();
        assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1), "answered: {answered}, {renew:?}");
        assert!(!pair.manager.session.holds(id));
        let sent = pair.manager.counter(LinkCounter::DatagramsSent);
        pair.manager.cancel(id);
        assert_eq!(pair.manager.counter(LinkCounter::DatagramsSent), sent, "it is released once");
        pair.run(LEASE);
        assert_eq!(expirations(&pair), 1);
    }
}

#[test]
fn nothing_is_sent_for_an_answered_call_that_the_peer_has_ended() {
    let (mut pair, slot) = vehicle();
    let id = go(&mut pair, Priority::Normal, Renew::Never);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.run(LEASE.times(2));
    assert!(!pair.agv.is_live(slot));
    let sent = pair.manager.counter(LinkCounter::DatagramsSent);
    pair.manager.cancel(id);
    assert_eq!(pair.manager.counter(LinkCounter::DatagramsSent), sent);
}

#[test]
fn answered_calls_of_several_functions_are_released_at_once_however_often_one_of_them_was_called() {
    let mut pair = Pair::live();
    let slots: Vec<Slot> = (0..LEASES).map(|at| pair.agv.offer_leased(&std::format!("go_{at}()"), LEASE)).collect();
    pair.publish();
    let call = |pair: &mut Pair, at: usize| {
        let options = RequestOptions { timeout: Some(TIMEOUT), ..RequestOptions::default() };
        let id = pair.manager.request_with(&std::format!("go_{at}"), &none(), &options, true).unwrap();
        pair.settle();
        id
    };
    let calls: Vec<CallId> = (0..LEASES).map(|at| call(&mut pair, at)).collect();
    // The newest of one function, since the peer has replaced those before it.
    let newest = [1; 6].map(|at| call(&mut pair, at))[5];
    for (at, id) in [(0, calls[0]), (1, newest), (2, calls[2]), (3, calls[3])] {
        assert!(pair.agv.is_live(slots[at]), "go_{at}");
        pair.manager.cancel(id);
        pair.settle();
        assert!(!pair.agv.is_live(slots[at]), "go_{at}");
    }
    assert_eq!(expirations(&pair), 4);
}

#[test]
fn a_call_beyond_the_table_of_orders_is_refused_and_moves_nothing() {
    let mut pair = Pair::live();
    let slots: Vec<Slot> = (0..=LEASES).map(|at| pair.agv.offer_leased(&std::format!("go_{at}()"), LEASE)).collect();
    pair.publish();
    let call = |pair: &mut Pair, at: usize| {
        // What is renewed is refused by its caller's own table.
        let options = RequestOptions { renew: Renew::Never, timeout: Some(TIMEOUT), ..RequestOptions::default() };
        let id = pair.manager.request_with(&std::format!("go_{at}"), &none(), &options, true).unwrap();
        pair.settle();
        pair.manager.outcome(id).unwrap().map(drop)
    };
    assert!((0..LEASES).all(|at| call(&mut pair, at).is_ok()));
    assert_eq!(call(&mut pair, LEASES), Err(Error::Busy));
    let live: Vec<bool> = slots.iter().map(|slot| pair.agv.is_live(*slot)).collect();
    assert_eq!(live, [[true; LEASES].as_slice(), &[false]].concat());
}

#[test]
fn a_renewal_that_overtakes_its_call_ends_nothing() {
    let (mut pair, slot) = vehicle();
    pair.manager.net.frozen = true;
    let id = go(&mut pair, Priority::Normal, Renew::Process);
    pair.run(LEASE.divided_by(2));
    assert!(pair.agv.counter(LinkCounter::RenewalsIgnored) > 0 && pair.manager.session.holds(id));
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(pair.agv.is_live(slot) && pair.manager.session.holds(id));
    assert!(!is_reported(&pair, id, LeaseEnd::Expired));
}

#[test]
fn a_newer_call_replaces_an_older_one_for_ever_and_without_the_hook() {
    let (mut pair, slot) = vehicle();
    let (first, old) = started(&mut pair, Priority::Normal);
    let (second, new) = started(&mut pair, Priority::High);
    assert!(is_reported(&pair, first, LeaseEnd::Replaced));
    assert!(!pair.manager.session.holds(first) && pair.manager.session.holds(second));
    assert!(!pair.agv.continues(&old) && pair.agv.continues(&new));
    // The end of the first order does not affect the second.
    pair.manager.cancel(first);
    pair.settle();
    assert!(pair.agv.continues(&new) && pair.agv.is_live(slot));
    pair.agv.answer_held(Err(Error::Busy));
    pair.settle();
    assert!(pair.agv.continues(&new));
    assert_eq!(expirations(&pair), 0);
    pair.manager.cancel(second);
    pair.settle();
    assert_eq!((pair.agv.continues(&new), expirations(&pair)), (false, 1));
    let (_, third) = started(&mut pair, Priority::Low);
    pair.agv.answer_held(Ok(&*none()));
    pair.run(LEASE.divided_by(2));
    assert!(pair.agv.continues(&third) && !pair.agv.continues(&old) && !pair.agv.continues(&new));
}

#[test]
fn a_call_that_is_released_on_its_way_does_not_begin_and_those_beside_it_do() {
    let (mut pair, slot) = vehicle();
    pair.manager.net.frozen = true;
    let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    let calls = [0; 3].map(|_| pair.manager.request_with("go", &none(), &options, true).unwrap());
    pair.manager.cancel(calls[1]);
    pair.settle();
    assert!(pair.agv.counter(LinkCounter::DatagramsReceived) > 0, "the release overtakes the requests");
    pair.manager.net.frozen = false;
    for _ in 0..2 {
        pair.settle();
        assert!(pair.agv.is_live(slot));
        pair.agv.answer_held(Ok(&*none()));
    }
    pair.settle();
    assert_eq!((pair.agv.ran().len(), pair.agv.held.len()), (2, 0));
    assert!(pair.manager.outcome(calls[0]).unwrap().is_ok() && pair.manager.outcome(calls[2]).unwrap().is_ok());
    assert_eq!(pair.manager.outcome(calls[1]), None);
    pair.run(LEASE);
}

#[test]
fn a_best_effort_call_that_arrives_behind_its_release_does_not_begin() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    let id = pair.manager.session.calling.requests.newest().0 + 1;
    let nonce = pair.agv.session.nonce();
    let release = crate::distribution::message::Release { call: id, class: Priority::Normal };
    pair.agv.hear_datagram(nonce, &SessionBody::release(&release));
    let delivery = super::super::Delivery::BestEffort;
    let options = RequestOptions { delivery, ..RequestOptions::default() };
    pair.manager.request_with("go", &none(), &options, false).unwrap();
    pair.settle();
    assert!(pair.agv.ran().is_empty() && !pair.agv.is_live(slot));
    pair.manager.request_with("go", &none(), &options, false).unwrap();
    pair.settle();
    assert_eq!(pair.agv.ran().len(), 1);
}

#[test]
fn a_release_that_finds_no_room_is_sent_when_there_is_some() {
    for renew in [Renew::Process, Renew::Never] {
        release_without_room(renew);
    }
}

fn release_without_room(renew: Renew) {
    let (mut pair, slot) = vehicle();
    let first = go(&mut pair, Priority::Normal, renew);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    // The stream is stuck and full; no datagram arrives.
    (pair.manager.net.frozen, pair.manager.net.capacity, pair.manager.net.datagrams) = (true, 0, Datagrams::Lost);
    for _ in 0..1_000 {
        pair.manager.direct(Directive::Challenge);
    }
    let withheld = pair.manager.counter(LinkCounter::FramesWithheld);
    let second = go(&mut pair, Priority::High, Renew::Process);
    pair.manager.cancel(first);
    pair.manager.cancel(second);
    assert!(pair.manager.counter(LinkCounter::FramesWithheld) > withheld);
    assert!(!pair.manager.session.holds(first) && !pair.manager.session.holds(second));
    (pair.manager.net.frozen, pair.manager.net.capacity) = (false, 1 << 20);
    pair.settle();
    pair.run(millis(20));
    assert_eq!((pair.agv.ran().len(), pair.agv.is_live(slot)), (1, false));
    assert_eq!(pair.manager.session.calls_in_flight(), 0);
}

#[test]
fn a_call_that_fails_ends_its_own_lease_only() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_picky("go_to(x: int)", LEASE);
    let other = pair.agv.offer_picky("turn_to(x: int)", LEASE);
    pair.publish();
    pair.manager.call("turn_to", &x(1)).unwrap();
    let failed = pair.manager.call("go_to", &x(-1)).unwrap();
    pair.settle();
    assert!(!pair.agv.is_live(slot) && pair.agv.is_live(other));
    assert!(!pair.manager.session.holds(failed));
    pair.run(LEASE.times(2));
    assert!(pair.agv.is_live(other));
    assert_eq!(pair.agv.counter(LinkCounter::RenewalsIgnored), 0);
}

#[test]
fn a_lost_link_ends_every_order() {
    let (mut pair, slot) = vehicle();
    let (_, old) = started(&mut pair, Priority::Normal);
    let (_, new) = started(&mut pair, Priority::High);
    pair.cut();
    assert!(!pair.agv.is_live(slot) && !pair.agv.continues(&old) && !pair.agv.continues(&new));
    assert_eq!(expirations(&pair), 1);
}

#[test]
fn in_a_full_table_the_oldest_call_of_the_function_gives_way() {
    let (mut pair, _) = vehicle();
    pair.manager.net.frozen = true;
    let calls = [0; 5].map(|_| go(&mut pair, Priority::Normal, Renew::Process));
    assert_eq!(calls.map(|call| pair.manager.session.holds(call)), [false, true, true, true, true]);
    assert_eq!(pair.manager.counter(LinkCounter::RenewalsStopped), 1);
    calls.into_iter().for_each(|call| pair.manager.cancel(call));
    pair.manager.net.frozen = false;
    pair.settle();
    assert_eq!(pair.agv.ran().len(), 0);
}

/// The table of renewed calls is full. The older call of a function is dropped while the newer one is in flight.
#[test]
fn what_gives_way_in_a_full_table_is_released_at_once_when_its_caller_drops_it() {
    let (mut pair, slot) = vehicle();
    for at in 1..LEASES {
        pair.agv.offer_leased(&std::format!("lift_{at}()"), LEASE);
    }
    pair.publish();
    let (older, _) = started(&mut pair, Priority::Normal);
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    for at in 1..LEASES {
        pair.manager.call(&std::format!("lift_{at}"), &none()).unwrap();
    }
    pair.settle();
    pair.manager.net.frozen = true;
    let newer = go(&mut pair, Priority::High, Renew::Process);
    assert_eq!([older, newer].map(|call| pair.manager.session.holds(call)), [false, true]);
    pair.run(millis(1));
    assert!(pair.agv.is_live(slot));
    pair.manager.cancel(older);
    pair.run(millis(1));
    assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1));
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(pair.agv.is_live(slot), "the newer one begins");
}

/// A renewal of this age arrives at the vehicle.
fn renewal_arrives(pair: &mut Pair, call: CallId, class: Priority, age: Duration) {
    let stamp = (pair.agv.now - age).as_micros();
    let renewal = Renewal { call: call.0, class, stamp, since: Duration::ZERO, age: Duration::ZERO };
    let nonce = pair.agv.session.nonce();
    pair.agv.hear_datagram(nonce, &SessionBody::renewal(&renewal));
}

#[test]
fn a_renewal_of_an_older_call_does_not_prolong_the_newer() {
    let (mut pair, slot) = vehicle();
    let old = go(&mut pair, Priority::Normal, Renew::Never);
    pair.settle();
    let new = go(&mut pair, Priority::High, Renew::Never);
    pair.settle();
    (0..2).for_each(|_| pair.agv.answer_held(Ok(&*none())));
    pair.run(millis(400));
    renewal_arrives(&mut pair, old, Priority::Normal, Duration::ZERO);
    pair.run(millis(99));
    assert!(!pair.agv.is_live(slot), "the renewal of the older call has prolonged the newer");
    assert!(pair.agv.counter(LinkCounter::RenewalsIgnored) == 1 && expirations(&pair) == 1);
    renewal_arrives(&mut pair, new, Priority::High, Duration::ZERO);
    assert!(!pair.agv.is_live(slot), "and nothing revives it");
}

#[test]
fn a_renewal_counts_from_when_it_was_made_and_not_from_its_arrival() {
    let (mut pair, slot) = vehicle();
    let call = go(&mut pair, Priority::Normal, Renew::Never);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.run(millis(400));
    renewal_arrives(&mut pair, call, Priority::Normal, millis(300));
    // The renewal was made 100 ms after the call, so the order lasts until 600 ms after the call.
    pair.run(millis(190));
    assert!(pair.agv.is_live(slot));
    pair.run(millis(10));
    assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1));
}

#[test]
fn a_renewal_does_nothing_for_a_function_that_was_replaced_since() {
    let (mut pair, _) = vehicle();
    let call = go(&mut pair, Priority::Normal, Renew::Never);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.agv.replace("go()");
    pair.run(millis(400));
    renewal_arrives(&mut pair, call, Priority::Normal, Duration::ZERO);
    assert_eq!(pair.agv.counter(LinkCounter::RenewalsIgnored), 1);
    pair.run(millis(100));
    assert!(pair.agv.session.granting.granted.is_empty(), "the lease of the function before was prolonged");
    assert_eq!(expirations(&pair), 0, "the hook of the function that is there now runs");
}

/// The port has run the hook when it removed the function.
#[test]
fn who_holds_a_lease_of_a_function_that_is_removed_is_told_at_once() {
    let (mut pair, slot) = vehicle();
    let call = go(&mut pair, Priority::Normal, Renew::Process);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert!(pair.manager.session.holds(call));
    pair.agv.functions.remove("go").unwrap();
    pair.agv.withdraw(slot);
    pair.settle();
    assert_eq!((is_reported(&pair, call, LeaseEnd::Expired), expirations(&pair)), (true, 0));
    assert!(!pair.manager.session.holds(call), "it is renewed no more");
}

/// If motors read a lease, it refuses the new call; otherwise the unit's own check does.
#[test]
fn a_new_call_never_takes_the_place_of_a_dead_lease_before_its_hook_has_run() {
    for has_word in [true, false] {
        let mut pair = Pair::live();
        let slot = pair.agv.offer_leased("go()", LEASE);
        pair.agv.functions.function(slot).unwrap().handler.has_word.set(has_word);
        pair.publish();
        let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
        pair.manager.request_with("go", &none(), &options, false).unwrap();
        pair.run(LEASE - millis(10));
        let early = pair.manager.request_with("go", &none(), &options, false).unwrap();
        // The request arrives at a vehicle that was not polled since the lease ended.
        let (stream, _) = pair.manager.net.deliver();
        pair.manager.flush_gathered();
        let (more, _) = pair.manager.net.deliver();
        pair.agv.now = pair.agv.now + millis(10);
        pair.agv.hear(&[stream, more].concat());
        pair.agv.work(std::vec::Vec::new());
        assert_eq!((pair.agv.ran().len(), expirations(&pair)), (1, 1), "with a word: {has_word}");
        assert!(!has_word || !pair.agv.is_live(slot));
        pair.settle();
        assert!(pair.manager.has(&Event::Failed(early, Error::Busy)));
    }
}

#[test]
fn the_unit_ends_a_lease_not_later_than_the_motor_sees_it_dead() {
    for late in 0..4 {
        let (mut pair, slot) = vehicle();
        pair.run(millis(late));
        go(&mut pair, Priority::Normal, Renew::Never);
        pair.settle();
        pair.agv.answer_held(Ok(&*none()));
        while pair.agv.is_live_behind(slot, Duration::ZERO) {
            assert_eq!(expirations(&pair), 0);
            pair.run(Duration::from_micros(250));
        }
        assert_eq!(expirations(&pair), 1, "the motor has stopped, and the unit does not know");
    }
}

#[test]
fn an_answered_call_may_hold_until_it_is_given_up() {
    for renew in [Renew::Process, Renew::Never] {
        let (mut pair, _) = vehicle();
        let id = go(&mut pair, Priority::Normal, renew);
        pair.settle();
        assert_eq!(pair.manager.session.may_hold(id), renew == Renew::Process);
        pair.agv.answer_held(Ok(&*none()));
        pair.settle();
        assert!(pair.manager.session.may_hold(id), "{renew:?}");
        assert!(!pair.manager.session.may_hold(CallId(id.0 + 1)));
        pair.manager.cancel(id);
        assert!(!pair.manager.session.may_hold(id));
    }
}

#[test]
fn what_fails_stops_at_once_though_its_caller_does_not_hear_of_it() {
    for (renew, waits) in [(Renew::Process, true), (Renew::Never, true), (Renew::Process, false), (Renew::Never, false)]
    {
        let (mut pair, slot) = vehicle();
        let options = RequestOptions { renew, ..RequestOptions::default() };
        pair.manager.request_with("go", &none(), &options, waits).unwrap();
        pair.run(millis(1));
        assert!(pair.agv.is_live(slot));
        (pair.agv.net.frozen, pair.agv.net.datagrams) = (true, Datagrams::Lost);
        pair.agv.answer_held(Err(Error::Busy));
        pair.settle();
        assert_eq!((pair.agv.is_live(slot), expirations(&pair)), (false, 1), "{renew:?} {waits}");
    }
}
