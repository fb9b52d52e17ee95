//! Motion continues only while its caller renews it.

use proptest::prelude::*;

use super::super::Event;
use super::net::Datagrams;
use super::pair::Pair;
use super::setup::Setup;
use super::{none, x};
use crate::distribution::function_list::Slot;
use crate::error::{Error, Limit};
use crate::host::connections::LinkCounter;
use crate::services::heart::Renew;
use crate::services::lease::LeaseEnd;
use crate::services::requests::CallId;
use crate::services::session::RequestOptions;
use crate::time::Duration;

const LEASE: Duration = Duration::from_millis(500);

/// A pair whose manager has called `go()`, and the function's slot. With `renew` the call is renewed.
fn moving(renew: bool) -> (Pair, Slot) {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    let options =
        RequestOptions { renew: if renew { Renew::Process } else { Renew::Never }, ..RequestOptions::default() };
    pair.manager.request_with("go", &none(), &options, true).unwrap();
    pair.settle();
    assert!(pair.agv.is_live(slot));
    (pair, slot)
}

fn expirations(pair: &Pair) -> usize {
    pair.agv.count(|event| matches!(event, Event::LeaseExpired(_)))
}

/// Whether the manager was notified of the end of its first call.
fn is_reported(pair: &Pair, why: LeaseEnd) -> bool {
    pair.manager.is_reported(CallId(1), why)
}

#[test]
fn a_lease_that_is_renewed_goes_on() {
    let (mut pair, slot) = moving(true);
    for _ in 0..100 {
        pair.run(Duration::from_millis(99));
        assert!(pair.agv.is_live(slot));
    }
    assert_eq!(expirations(&pair), 0);
}

/// A lease of 20 ms is renewed as often as needed; a shorter one, which a peer may publish, no more often than that.
#[test]
fn renewals_of_a_short_lease_do_not_fill_the_network() {
    for (millis, lives) in [(5, false), (20, true)] {
        let mut pair = Pair::live();
        let slot = pair.agv.offer_leased("go()", Duration::from_millis(millis));
        pair.publish();
        let before = pair.manager.counter(LinkCounter::DatagramsSent);
        for _ in 0..10 {
            let _ = pair.manager.call("go", &none());
            pair.run(Duration::from_millis(10));
            assert_eq!(pair.agv.is_live(slot), lives);
        }
        let sent = pair.manager.counter(LinkCounter::DatagramsSent) - before;
        assert!(sent <= 40, "{sent} datagrams in 100 ms");
    }
}

#[test]
fn a_lease_that_is_not_renewed_expires_once_in_time() {
    let (mut pair, slot) = moving(false);
    pair.run(LEASE - Duration::from_millis(2));
    assert!(pair.agv.is_live(slot));
    pair.run(Duration::from_millis(2));
    assert!(!pair.agv.is_live(slot));
    pair.run(Duration::from_secs(2));
    assert!(pair.agv.has(&Event::LeaseExpired(slot)));
    assert_eq!((expirations(&pair), pair.agv.counter(LinkCounter::LeasesExpired)), (1, 1));
}

#[test]
fn each_further_request_renews_a_lease() {
    let (mut pair, slot) = moving(false);
    let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    for _ in 0..5 {
        pair.run(LEASE - Duration::from_millis(10));
        assert!(pair.agv.is_live(slot));
        pair.manager.request_with("go", &none(), &options, false).unwrap();
    }
    pair.run(LEASE);
    assert_eq!(expirations(&pair), 1);
}

#[test]
fn a_lease_ends_in_time_when_nothing_comes_through() {
    let (mut pair, slot) = moving(true);
    pair.manager.net.frozen = true;
    pair.manager.net.datagrams = Datagrams::Lost;
    pair.run(LEASE);
    assert!(!pair.agv.is_live(slot));
    assert_eq!(expirations(&pair), 1);
    assert!(pair.agv.session.is_live(), "long before the link is given up");
    pair.manager.net.frozen = false;
    pair.run(Duration::from_secs(1));
    assert!(!pair.agv.is_live(slot), "renewals that were held back revive nothing");
    assert!(is_reported(&pair, LeaseEnd::Expired));
    assert_eq!(expirations(&pair), 1);
}

/// No interrupt has read the lease since its end, and the session has not been polled.
#[test]
fn a_renewal_that_comes_after_the_end_revives_nothing() {
    let (mut pair, slot) = moving(true);
    pair.run(LEASE);
    // The end is rounded down to the previous millisecond; the manager has not timed out yet.
    pair.suspend_agv(LEASE - Duration::from_micros(500));
    assert!(!pair.agv.is_live(slot));
    assert!(is_reported(&pair, LeaseEnd::Expired));
    pair.run(Duration::from_secs(1));
    assert_eq!((expirations(&pair), pair.agv.is_live(slot)), (1, false));
}

#[test]
fn what_an_interrupt_has_seen_dead_is_not_renewed() {
    let (mut pair, slot) = moving(true);
    (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
    pair.run(LEASE - Duration::from_millis(50));
    assert!(pair.agv.is_live(slot));
    // The session begins to process a renewal while the lease lasts, and finishes after its end.
    assert!(!pair.agv.is_live_behind(slot, Duration::from_millis(50)));
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(!pair.agv.is_live(slot), "the motors have been switched off, and come on again");
    assert_eq!((expirations(&pair), pair.agv.counter(LinkCounter::LeasesExpired)), (1, 1), "the hook is told");
    assert!(is_reported(&pair, LeaseEnd::Expired));
    pair.run(Duration::from_secs(1));
    assert_eq!((expirations(&pair), pair.agv.is_live(slot)), (1, false));
    pair.manager.notify("go", &none()).unwrap();
    pair.run(Duration::from_millis(1));
    assert!(pair.agv.is_live(slot), "a new order moves it");
}

#[test]
fn an_order_does_not_take_the_place_of_a_motion_that_an_interrupt_has_seen_dead() {
    let (mut pair, slot) = moving(false);
    // The interrupt reads the lease while the request is in flight, so the session receives that before it polls.
    let early = pair.manager.call("go", &none()).unwrap();
    assert!(!pair.agv.is_live_behind(slot, LEASE));
    pair.run(Duration::from_millis(1));
    assert!(pair.manager.has(&Event::Reply(early, Err(Error::Busy))), "the hook comes first");
    assert_eq!((expirations(&pair), pair.agv.is_live(slot)), (1, false));
    pair.manager.notify("go", &none()).unwrap();
    pair.run(Duration::from_millis(1));
    assert_eq!((expirations(&pair), pair.agv.is_live(slot)), (1, true));
}

/// Events in the life of a motion.
#[derive(Clone, Copy, Debug)]
enum Befalls {
    /// Milliseconds pass.
    Time(u64),
    /// An interrupt reads the lease, this many milliseconds later than the session's clock.
    Look(u64),
    Stream(bool),
    Datagrams(bool),
    Order,
}

fn befalls() -> impl Strategy<Value = Befalls> {
    prop_oneof![
        4 => (0..200_u64).prop_map(Befalls::Time),
        4 => (0..300_u64).prop_map(Befalls::Look),
        2 => any::<bool>().prop_map(Befalls::Stream),
        2 => any::<bool>().prop_map(Befalls::Datagrams),
        1 => Just(Befalls::Order),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn motors_that_were_switched_off_come_on_by_an_order_only(story in prop::collection::vec(befalls(), 1..60)) {
        let (mut pair, slot) = moving(true);
        // The orders that were running when the lease was last seen dead.
        let mut dead_at = None;
        for step in story {
            let mut later = Duration::ZERO;
            match step {
                Befalls::Time(millis) => pair.run(Duration::from_millis(millis)),
                Befalls::Look(millis) => later = Duration::from_millis(millis),
                Befalls::Stream(frozen) => pair.manager.net.frozen = frozen,
                Befalls::Datagrams(pass) => {
                    pair.manager.net.datagrams = if pass { Datagrams::Pass } else { Datagrams::Lost };
                }
                Befalls::Order => {
                    let _ = pair.manager.notify("go", &none());
                }
            }
            pair.settle();
            let orders = pair.agv.ran().len();
            if pair.agv.is_live_behind(slot, later) {
                prop_assert!(dead_at.is_none_or(|dead_at| orders > dead_at), "it goes on by itself: {step:?}");
                dead_at = None;
            } else {
                dead_at = Some(orders);
            }
        }
        pair.manager.net.frozen = false;
        pair.settle();
    }
}

#[test]
fn either_way_of_a_renewal_is_enough() {
    let (mut pair, slot) = moving(true);
    pair.manager.net.datagrams = Datagrams::Lost;
    pair.run(Duration::from_secs(2));
    assert!(pair.agv.is_live(slot));
    pair.manager.net.datagrams = Datagrams::Pass;
    pair.manager.net.frozen = true;
    pair.run(Duration::from_secs(2));
    assert!(pair.agv.is_live(slot));
}

#[test]
fn renewals_that_come_late_take_nothing_away() {
    let (mut pair, slot) = moving(true);
    // The stream is slower than the datagrams, and its pipe has capacity for one renewal.
    (pair.manager.net.frozen, pair.manager.net.capacity) = (true, 21);
    pair.run(Duration::from_millis(400));
    pair.manager.net.datagrams = Datagrams::Lost;
    pair.manager.net.frozen = false;
    pair.step();
    pair.manager.net.frozen = true;
    assert_eq!(pair.agv.counter(LinkCounter::RenewalsIgnored), 0);
    // The newest renewal is 25 ms old.
    pair.run(LEASE - Duration::from_millis(30));
    assert!(pair.agv.is_live(slot));
    assert_eq!(expirations(&pair), 0);
}

#[test]
fn a_lease_counts_from_when_the_request_was_made() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    pair.manager.net.frozen = true;
    let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    pair.manager.request_with("go", &none(), &options, false).unwrap();
    pair.run(Duration::from_millis(400));
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(pair.agv.is_live(slot));
    pair.run(Duration::from_millis(100));
    assert!(!pair.agv.is_live(slot));
}

#[test]
fn a_request_older_than_its_lease_is_not_run() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    pair.manager.net.frozen = true;
    let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    let id = pair.manager.request_with("go", &none(), &options, false).unwrap();
    pair.run(LEASE);
    pair.manager.net.frozen = false;
    pair.settle();
    assert!(pair.agv.ran().is_empty() && !pair.agv.is_live(slot));
    assert!(pair.manager.has(&Event::Failed(id, Error::Expired)));
    assert_eq!(pair.agv.session.calls_held(), 0);
}

#[test]
fn a_lease_that_is_released_ends_at_once() {
    let (mut pair, slot) = moving(true);
    pair.manager.release(slot).unwrap();
    pair.settle();
    assert!(!pair.agv.is_live(slot));
    pair.run(Duration::from_secs(2));
    assert_eq!((expirations(&pair), pair.agv.counter(LinkCounter::RenewalsIgnored)), (1, 0));
}

#[test]
fn a_release_ends_the_renewals_of_the_program_and_of_an_operator() {
    for operator in [false, true] {
        let mut pair = Pair::live();
        let slot = pair.agv.offer_leased("go()", LEASE);
        pair.publish();
        let options = RequestOptions { operator, ..RequestOptions::renewing(Renew::Process) };
        let call = pair.manager.request_with("go", &none(), &options, true).unwrap();
        pair.run(LEASE);
        assert!(pair.agv.is_live(slot) && pair.manager.session.holds(call));
        pair.manager.release(slot).unwrap();
        assert!(!pair.manager.session.holds(call), "operator: {operator}");
        pair.run(Duration::from_secs(2));
        assert_eq!((expirations(&pair), pair.agv.counter(LinkCounter::RenewalsIgnored)), (1, 0));
    }
}

#[test]
fn a_motion_that_is_given_up_before_it_began_does_not_begin() {
    let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
    pair.agv.offer_held("work()");
    let slot = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    pair.manager.call("work", &none()).unwrap();
    // One command is queued at the callee, another gathers at the caller: both are released.
    let reported = pair.manager.notify("go", &none()).unwrap();
    pair.run(Duration::from_millis(1));
    let late = pair.manager.notify("go", &none()).unwrap();
    pair.manager.release(slot).unwrap();
    pair.run(Duration::from_millis(1));
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert_eq!((pair.agv.ran().len(), pair.agv.is_live(slot)), (1, false));
    assert!(pair.manager.has(&Event::Failed(reported, Error::Expired)));
    assert!(pair.manager.has(&Event::Failed(late, Error::Expired)));
    pair.manager.notify("go", &none()).unwrap();
    pair.run(Duration::from_millis(1));
    assert_eq!((pair.agv.ran().len(), pair.agv.is_live(slot)), (2, true));
}

#[test]
fn an_order_that_fails_leaves_nothing_going_on() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_picky("go_to(x: int)", LEASE);
    pair.publish();
    pair.manager.call("go_to", &x(1)).unwrap();
    pair.settle();
    assert!(pair.agv.is_live(slot));
    // The newest order has replaced the one before, so if it fails, the old motion must not continue.
    let failed = pair.manager.call("go_to", &x(-1)).unwrap();
    pair.settle();
    assert!(!pair.agv.is_live(slot) && !pair.manager.session.holds(failed));
    assert_eq!(expirations(&pair), 1);
    assert!(is_reported(&pair, LeaseEnd::Replaced));
    pair.run(Duration::from_secs(2));
    assert_eq!((expirations(&pair), pair.agv.is_live(slot)), (1, false));
}

#[test]
fn a_motion_that_is_finished_ends_its_lease_without_the_hook() {
    let (mut pair, slot) = moving(true);
    let order = pair.agv.order_of(CallId(1));
    assert!(pair.agv.end_order(slot, order) && !pair.agv.end_order(slot, order));
    pair.settle();
    assert!(!pair.agv.is_live(slot));
    assert!(is_reported(&pair, LeaseEnd::Finished));
    pair.run(Duration::from_secs(2));
    assert_eq!((expirations(&pair), pair.agv.counter(LinkCounter::RenewalsIgnored)), (0, 0));
}

/// The program sees that the first order is done, but reports that only after the next one of the same function has begun.
#[test]
fn what_is_finished_is_the_order_that_was_named_and_not_the_newer_one() {
    let (mut pair, slot) = moving(true);
    let older = pair.agv.order_of(CallId(1));
    let newer = pair.manager.call("go", &none()).unwrap();
    pair.settle();
    assert!(!pair.agv.end_order(slot, older), "it was replaced");
    pair.run(Duration::from_secs(2));
    assert!(pair.agv.is_live(slot) && pair.manager.session.holds(newer), "the newer one goes on");
    assert!(is_reported(&pair, LeaseEnd::Replaced) && !pair.manager.is_reported(newer, LeaseEnd::Finished));
    let order = pair.agv.order_of(newer);
    assert!(pair.agv.end_order(slot, order));
    pair.settle();
    assert!(!pair.agv.is_live(slot) && pair.manager.is_reported(newer, LeaseEnd::Finished));
    assert_eq!(expirations(&pair), 0);
}

#[test]
fn no_more_leases_are_held_than_there_is_room_for() {
    let mut pair = Pair::live();
    for at in 0..5 {
        pair.agv.offer_leased(&std::format!("go_{at}(x: int)"), LEASE);
    }
    pair.publish();
    for at in 0..4 {
        pair.manager.call(&std::format!("go_{at}"), &x(at)).unwrap();
    }
    assert_eq!(pair.manager.call("go_4", &x(4)), Err(Error::Full(Limit::Leases)));
    pair.settle();
    assert_eq!(pair.agv.ran().len(), 4);
    pair.manager.release(Slot(0)).unwrap();
    pair.settle();
    assert!(pair.manager.call("go_4", &x(4)).is_ok());
}

#[test]
fn a_replaced_function_is_not_kept_alive_by_renewals_of_the_old_one() {
    let (mut pair, slot) = moving(true);
    pair.agv.replace("go()");
    pair.run(Duration::from_secs(2));
    assert!(!pair.agv.is_live(slot));
}
