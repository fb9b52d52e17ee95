//! What a loop of a program wants goes on while that loop runs, over real sockets.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cara_std::{
    CommunicationSystem, Error, LeaseEnd, LeaseWatch, Peer, RequestOptions, ServiceOptions, Unit, UnitEvent,
};

use crate::support::{PATIENCE, fleet, meet, number, system, unit, until};

const LEASE: Duration = Duration::from_millis(1_600);
/// A loop may be late by three of them.
const PERIOD: Duration = Duration::from_millis(400);

/// A manager and a vehicle that has a drive and a lift.
struct Vehicle {
    manager: CommunicationSystem,
    _agv: Unit,
    peer: Peer,
    leases: [LeaseWatch; 2],
}

fn vehicle() -> Vehicle {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let leases = ["drive(number: int)", "lift(number: int)"].map(|definition| {
        let options = ServiceOptions::new().lease(LEASE, || {});
        let moved = |_: &cara_std::Served, _: &mut cara_std::ParametersView| Ok(());
        agv.my_function_list().add_service(&definition.parse().unwrap(), options, moved).unwrap()
    });
    let (peer, _) = meet(&manager, &agv);
    assert!(peer.wait_for_function("lift", PATIENCE));
    Vehicle { manager, _agv: agv, peer, leases }
}

#[test]
fn of_two_loops_the_one_that_hangs_ends_its_motion_and_the_other_goes_on() {
    let Vehicle { manager, _agv, peer, leases: [drive, lift] } = vehicle();
    let events = manager.events();
    let hangs = Arc::new(AtomicBool::new(false));
    std::thread::scope(|scope| {
        let ends = Arc::new(AtomicBool::new(false));
        for (function, may_hang) in [("drive", true), ("lift", false)] {
            let (manager, peer, hangs, ends) = (&manager, &peer, hangs.clone(), ends.clone());
            scope.spawn(move || {
                let mut heart = manager.heart(PERIOD);
                heart.beat();
                let wanted = RequestOptions::renewing(heart.renew());
                peer.call(function, &mut number(1)).with(wanted).wait().unwrap();
                while !ends.load(Ordering::SeqCst) {
                    if !(may_hang && hangs.load(Ordering::SeqCst)) {
                        heart.beat();
                    }
                    std::thread::sleep(Duration::from_millis(20));
                }
            });
        }
        until("both move", || drive.is_live() && lift.is_live());
        let began = Instant::now();
        while began.elapsed() < 3 * LEASE {
            assert!(drive.is_live() && lift.is_live());
            std::thread::sleep(Duration::from_millis(5));
        }
        hangs.store(true, Ordering::SeqCst);
        until("the one that hangs ends", || !drive.is_live());
        std::thread::sleep(2 * LEASE);
        assert!(lift.is_live());
        ends.store(true, Ordering::SeqCst);
    });
    until("a loop that has ended wants nothing", || !lift.is_live());
    let reported = |event: &UnitEvent| matches!(event, UnitEvent::LeaseEnded { function, why: LeaseEnd::Expired, .. } if function == "drive");
    until("its end is told", || events.try_iter().any(|event| reported(&event)));
}

#[test]
fn a_guard_that_is_dropped_releases() {
    let Vehicle { manager, _agv, peer, leases: [drive, _] } = vehicle();
    let mut heart = manager.heart(PERIOD);
    heart.beat();
    let held = peer.call("drive", &mut number(1)).renewing(heart.renew()).hold().wait().unwrap();
    assert!(drive.is_live() && held.is_held());
    drop(held);
    until("it is released", || !drive.is_live());
}

#[test]
fn a_heart_that_is_dropped_releases_and_a_slow_one_is_refused() {
    let Vehicle { manager, _agv, peer, leases: [drive, lift] } = vehicle();
    let mut heart = manager.heart(PERIOD);
    heart.beat();
    let renew = heart.renew();
    peer.call("drive", &mut number(1)).renewing(renew).wait().unwrap();
    assert!(drive.is_live());
    drop(heart);
    until("what named it is released", || !drive.is_live());
    // Its word is used by the next one, whose beats mean nothing to what names the first.
    let mut next = manager.heart(PERIOD);
    let began = Instant::now();
    peer.call("lift", &mut number(1)).renewing(renew).wait().unwrap();
    while began.elapsed() < 2 * LEASE {
        next.beat();
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(!lift.is_live());
    let slow = manager.heart(LEASE);
    let refused = peer.call("drive", &mut number(1)).renewing(slow.renew()).wait();
    assert_eq!(refused, Err(Error::SlowHeart { need: 800, have: 1_600 }.into()));
}
