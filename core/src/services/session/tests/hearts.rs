//! An order with a heart continues only while the heart beats, and while the callee answers renewals.

use std::boxed::Box;

use super::super::{Event, RequestOptions};
use super::net::Datagrams;
use super::none;
use super::pair::Pair;
use crate::distribution::function_list::Slot;
use crate::error::Error;
use crate::host::connections::LinkCounter;
use crate::services::heart::{Beats, Heart, Renew};
use crate::services::lease::LeaseEnd;
use crate::services::requests::CallId;
use crate::time::{Duration, Instant};

const LEASE: Duration = Duration::from_millis(400);
const PERIOD: Duration = Duration::from_millis(100);

fn heart() -> &'static Heart {
    Box::leak(Box::new(Heart::new(PERIOD)))
}

fn named(beats: Beats) -> RequestOptions {
    RequestOptions::renewing(Renew::Heart(beats))
}

/// A pair whose manager has called a function with the lease `LEASE`.
fn moving(options: &RequestOptions) -> (Pair, Slot, CallId) {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    let call = pair.manager.request_with("go", &none(), options, true).unwrap();
    pair.settle();
    assert!(pair.agv.is_live(slot));
    (pair, slot, call)
}

/// Beats `times` times, once per period.
fn beat(pair: &mut Pair, heart: &Heart, times: u32) {
    for _ in 0..times {
        heart.beat(pair.manager.now);
        pair.run(PERIOD);
    }
}

#[test]
fn a_call_ends_one_lease_behind_the_last_beat_and_that_of_another_heart_goes_on() {
    let (drive, lift) = (heart(), heart());
    let mut pair = Pair::live();
    let slots = ["drive()", "lift()"].map(|function| pair.agv.offer_leased(function, LEASE));
    pair.publish();
    for (function, heart) in [("drive", drive), ("lift", lift)] {
        pair.manager.request_with(function, &none(), &named(heart.beats()), true).unwrap();
    }
    for _ in 0..50 {
        drive.beat(pair.manager.now);
        beat(&mut pair, lift, 1);
        assert_eq!(slots.map(|slot| pair.agv.is_live(slot)), [true, true]);
    }
    let last = pair.manager.now - PERIOD;
    while pair.agv.is_live(slots[0]) {
        lift.beat(pair.manager.now);
        pair.run(Duration::from_millis(1));
    }
    let after = pair.manager.now.since(last);
    assert!(after <= LEASE, "it moved for {after:?} behind the last beat");
    assert!(after + Duration::from_millis(6) > LEASE, "it ended {after:?} behind it");
    beat(&mut pair, lift, 20);
    assert!(pair.agv.is_live(slots[1]));
    assert_eq!(pair.agv.count(|event| *event == Event::LeaseExpired(slots[0])), 1);
}

#[test]
fn a_loop_that_hung_for_longer_than_the_lease_revives_nothing() {
    let heart = heart();
    let (mut pair, slot, call) = moving(&named(heart.beats()));
    beat(&mut pair, heart, 3);
    pair.run(LEASE);
    assert!(!pair.agv.is_live(slot));
    beat(&mut pair, heart, 10);
    assert!(!pair.agv.is_live(slot));
    assert!(pair.manager.is_reported(call, LeaseEnd::Expired));
    assert_eq!(pair.agv.counter(LinkCounter::RenewalsIgnored), 0, "its caller knows, and renews no more");
}

#[test]
fn without_a_heart_a_call_lasts_one_lease() {
    let (mut pair, slot, _) = moving(&RequestOptions::default());
    pair.run(LEASE - Duration::from_millis(2));
    assert!(pair.agv.is_live(slot));
    pair.run(Duration::from_millis(2));
    assert!(!pair.agv.is_live(slot));
}

#[test]
fn a_heart_that_never_beats_renews_nothing() {
    let (mut pair, slot, _) = moving(&named(heart().beats()));
    pair.run(LEASE);
    assert!(!pair.agv.is_live(slot));
}

#[test]
fn a_heart_that_is_too_slow_for_the_lease_is_refused_before_anything_is_sent() {
    let mut pair = Pair::live();
    pair.agv.offer_leased("go()", LEASE);
    pair.agv.offer("ask()", |_| Ok(()));
    pair.publish();
    let slow: &'static Heart = Box::leak(Box::new(Heart::new(Duration::from_millis(201))));
    let options = named(slow.beats());
    let refused = pair.manager.request_with("go", &none(), &options, true);
    assert_eq!(refused, Err(Error::SlowHeart { need: 200, have: 201 }));
    pair.settle();
    assert!(pair.agv.ran().is_empty());
    assert!(pair.manager.request_with("ask", &none(), &options, true).is_ok(), "it has no lease");
    slow.set_period(Duration::from_millis(200));
    assert!(pair.manager.request_with("go", &none(), &options, true).is_ok());
}

#[test]
fn a_heart_that_stops_releases_at_once_and_its_next_owner_renews_nothing_of_it() {
    let heart = heart();
    let (mut pair, slot, call) = moving(&named(heart.beats()));
    let before = heart.beats();
    heart.stop();
    pair.manager.release_beats(before);
    pair.settle();
    assert!(!pair.agv.is_live(slot) && !pair.manager.session.holds(call));
    pair.manager.request_with("go", &none(), &named(before), true).unwrap();
    pair.settle();
    assert!(pair.agv.is_live(slot));
    beat(&mut pair, heart, 4);
    assert!(!pair.agv.is_live(slot), "beats of the next owner renew it");
}

#[test]
fn a_heart_that_stops_releases_all_that_it_renewed() {
    let (dropped, kept) = (heart(), heart());
    let mut pair = Pair::live();
    let hearts = [("drive", dropped), ("lift", kept), ("tilt", dropped)];
    let slots = hearts.map(|(name, _)| pair.agv.offer_leased(&std::format!("{name}()"), LEASE));
    pair.publish();
    for (function, heart) in hearts {
        pair.manager.request_with(function, &none(), &named(heart.beats()), true).unwrap();
    }
    pair.settle();
    let before = dropped.beats();
    dropped.stop();
    pair.manager.release_beats(before);
    pair.settle();
    assert_eq!(slots.map(|slot| pair.agv.is_live(slot)), [false, true, false]);
}

/// Nothing arrives from the vehicle; the manager's renewals arrive there.
fn cut_from_the_vehicle(pair: &mut Pair) -> Instant {
    (pair.agv.net.frozen, pair.agv.net.datagrams) = (true, Datagrams::Lost);
    pair.manager.now
}

#[test]
fn what_is_not_answered_for_one_lease_is_released() {
    let wanted = RequestOptions::renewing(Renew::Process);
    let (mut pair, slot, call) = moving(&wanted);
    pair.run(LEASE.times(5));
    let cut = cut_from_the_vehicle(&mut pair);
    while pair.agv.is_live(slot) {
        pair.run(Duration::from_millis(1));
    }
    let after = pair.manager.now.since(cut);
    assert!(after <= LEASE + LEASE.divided_by(4), "it moved for {after:?}");
    assert!(pair.manager.is_reported(call, LeaseEnd::Unanswered));
    pair.run(LEASE);
    assert_eq!(pair.manager.counter(LinkCounter::RenewalsUnanswered), 1);
    assert!(pair.manager.session.is_live() && !pair.manager.session.holds(call));
}

#[test]
fn with_both_ways_cut_it_ends_within_two_leases() {
    let wanted = RequestOptions::renewing(Renew::Process);
    let (mut pair, slot, _) = moving(&wanted);
    let cut = cut_from_the_vehicle(&mut pair);
    // The release is lost, too.
    pair.run(LEASE - Duration::from_millis(1));
    (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
    while pair.agv.is_live(slot) {
        pair.run(Duration::from_millis(1));
    }
    assert!(pair.manager.now.since(cut) <= LEASE.times(2));
}

#[test]
fn an_answer_on_either_way_keeps_it() {
    let wanted = RequestOptions::renewing(Renew::Process);
    for (frozen, datagrams) in [(true, Datagrams::Pass), (false, Datagrams::Lost)] {
        let (mut pair, slot, _) = moving(&wanted);
        (pair.agv.net.frozen, pair.agv.net.datagrams) = (frozen, datagrams);
        pair.run(LEASE.times(5));
        assert!(pair.agv.is_live(slot), "{datagrams:?}");
    }
}
