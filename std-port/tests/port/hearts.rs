//! What a loop of a program wants goes on while that loop runs, over real sockets.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cara_processes::ticker::unless_held_up;
use cara_std::{CommunicationSystem, Error, LeaseEnd, LeaseWatch, Peer, ServiceOptions, Unit, UnitEvent};

use crate::support::{PATIENCE, fleet, has_begun, meet, number, system, unit, until, within};

/// Beyond all patience: what is seen to end has not ended by time.
const LONG: Duration = PATIENCE.saturating_mul(4);
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

/// `lengths` are those of the leases.
fn vehicle(lengths: [Duration; 2]) -> Vehicle {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let services = [("drive(number: int)", lengths[0]), ("lift(number: int)", lengths[1])];
    let leases = services.map(|(definition, length)| {
        let options = ServiceOptions::new().lease(length, || {});
        let moved = |_: &cara_std::Served, _: &mut cara_std::ParametersView| Ok(());
        agv.my_function_list().add_service(&definition.parse().unwrap(), options, moved).unwrap()
    });
    let (peer, _) = meet(&manager, &agv);
    assert!(peer.wait_for_function("lift", PATIENCE));
    Vehicle { manager, _agv: agv, peer, leases }
}

#[test]
fn of_two_loops_the_one_that_hangs_ends_its_motion_and_the_other_goes_on() {
    unless_held_up(LEASE, of_two_loops_one_hangs);
}

fn of_two_loops_one_hangs() {
    let Vehicle { manager, _agv, peer, leases: [drive, lift] } = vehicle([LEASE; 2]);
    let events = manager.events();
    let (hangs, ends) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        for (function, may_hang) in [("drive", true), ("lift", false)] {
            let (manager, peer, hangs, ends) = (&manager, &peer, &hangs, &ends);
            scope.spawn(move || {
                let mut heart = manager.heart(PERIOD);
                heart.beat();
                until("it begins", || has_begun(peer, function, heart.renew()));
                while !ends.load(Ordering::SeqCst) {
                    if !(may_hang && hangs.load(Ordering::SeqCst)) {
                        heart.beat();
                    }
                    std::thread::sleep(Duration::from_millis(20));
                }
            });
        }
        let both_move = || drive.is_live() && lift.is_live();
        let mut goes_on = within(PATIENCE, both_move);
        let began = Instant::now();
        while goes_on && began.elapsed() < 3 * LEASE {
            std::thread::sleep(Duration::from_millis(5));
            goes_on = both_move();
        }
        hangs.store(true, Ordering::SeqCst);
        let has_ended = !goes_on || within(PATIENCE, || !drive.is_live());
        if goes_on {
            std::thread::sleep(2 * LEASE);
            goes_on = lift.is_live();
        }
        ends.store(true, Ordering::SeqCst);
        assert!(has_ended, "not in time: the one that hangs ends");
        assert!(goes_on, "a motion has ended whose loop goes on");
    });
    until("a loop that has ended wants nothing", || !lift.is_live());
    let reported = |event: &UnitEvent| matches!(event, UnitEvent::LeaseEnded { function, why: LeaseEnd::Expired, .. } if function == "drive");
    // A manager that has stood still may see that its renewals are not answered before it is told. Then the whole test begins
    // again.
    until("its end is told", || events.try_iter().any(|event| reported(&event)));
}

#[test]
fn a_guard_that_is_dropped_releases() {
    let Vehicle { manager, _agv, peer, leases: [drive, _] } = vehicle([LONG; 2]);
    let mut heart = manager.heart(LONG / 2);
    heart.beat();
    let held = peer.call("drive", &mut number(1)).renewing(heart.renew()).hold().wait().unwrap();
    assert!(drive.is_live() && held.is_held());
    drop(held);
    until("it is released", || !drive.is_live());
}

#[test]
fn a_heart_that_is_dropped_releases_and_a_slow_one_is_refused() {
    let Vehicle { manager, _agv, peer, leases: [drive, lift] } = vehicle([LONG, LEASE]);
    let mut heart = manager.heart(PERIOD);
    heart.beat();
    let renew = heart.renew();
    until("it begins", || has_begun(&peer, "drive", renew));
    assert!(drive.is_live());
    drop(heart);
    until("what named it is released", || !drive.is_live());
    // Its word is used by the next one, whose beats mean nothing to what names the first.
    let mut next = manager.heart(PERIOD);
    until("it begins", || has_begun(&peer, "lift", renew));
    let began = Instant::now();
    while began.elapsed() < 2 * LEASE {
        next.beat();
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(!lift.is_live());
    let slow = manager.heart(LEASE);
    let refused = peer.call("lift", &mut number(1)).renewing(slow.renew()).wait();
    assert_eq!(refused, Err(Error::SlowHeart { need: 800, have: 1_600 }.into()));
}
