//! Leases over real sockets: without renewals, what a call started is stopped.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_processes::ticker::{Ticker, unless_held_up};
use cara_std::{
    CommunicationSystem, Error, LeaseEnd, LeaseWatch, ParametersView, Peer, Renew, Served, ServiceError,
    ServiceOptions, Unit, UnitEvent,
};

use crate::support::{PATIENCE, fleet, has_begun, meet, number, service, system, unit, until};

/// Beyond all patience: what is seen to end has not ended by time.
const LONG: Duration = PATIENCE.saturating_mul(4);
/// Renewed every quarter of it: a thread may be late by the other three.
const LEASE: Duration = Duration::from_millis(1_600);

struct Vehicle {
    manager: CommunicationSystem,
    agv: Unit<i64>,
    peer: Peer,
    lease: LeaseWatch,
    /// That of the last call.
    order: Arc<Mutex<Option<LeaseWatch>>>,
    stops: Arc<AtomicUsize>,
}

/// A manager and a vehicle that offers `go_to` under a lease of this length.
fn vehicle(length: Duration) -> Vehicle {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
    let stops = Arc::new(AtomicUsize::new(0));
    let stopped = stops.clone();
    let safe = move || {
        stopped.fetch_add(1, Ordering::SeqCst);
    };
    let order = Arc::<Mutex<Option<LeaseWatch>>>::default();
    let newest = order.clone();
    let go_to = move |speed: &mut i64, call: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
        *speed = 5;
        newest.lock().unwrap().clone_from(&call.lease);
        Ok(parameters.set_value("number", *speed)?)
    };
    let definition = "go_to(number: int[1]) -> (number: int[1])".parse().unwrap();
    let options = ServiceOptions::new().lease(length, safe).then(|speed: &mut i64| *speed = 0);
    let lease = agv.my_function_list().add_service(&definition, options, go_to).unwrap();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    Vehicle { manager, agv, peer, lease, order, stops }
}

/// A vehicle that has begun to go, and since when it has been asked to. Nobody renews its lease.
fn unrenewed() -> (Vehicle, Instant) {
    let end = Instant::now() + PATIENCE;
    loop {
        let (vehicle, asked) = (vehicle(LEASE), Instant::now());
        assert!(!vehicle.lease.is_live());
        if has_begun(&vehicle.peer, "go_to", Renew::Never) {
            return (vehicle, asked);
        }
        assert!(Instant::now() < end, "not in time: a call comes before its lease would be over");
    }
}

impl Vehicle {
    fn go(&self) {
        assert!(!self.lease.is_live());
        assert!(has_begun(&self.peer, "go_to", Renew::Process));
        assert!(self.lease.is_live());
        assert_eq!(self.speed(), 5);
    }

    fn speed(&self) -> i64 {
        self.agv.with_state(|speed| *speed).unwrap()
    }

    fn stops(&self) -> usize {
        self.stops.load(Ordering::SeqCst)
    }

    /// Stopped once, and not again.
    fn assert_stopped(&self) {
        until("the safe hook has run", || self.stops() == 1);
        assert!(!self.lease.is_live());
        until("what needs the state has run behind it", || self.speed() == 0);
    }
}

#[test]
fn motion_goes_on_while_it_is_renewed_and_ends_when_it_is_released() {
    unless_held_up(LEASE, || {
        let vehicle = vehicle(LEASE);
        vehicle.go();
        let began = Instant::now();
        while began.elapsed() < 3 * LEASE {
            std::thread::sleep(Duration::from_millis(5));
            assert!(vehicle.lease.is_live(), "the lease is renewed");
        }
        assert_eq!((vehicle.stops(), vehicle.speed()), (0, 5));
    });
    let vehicle = vehicle(LONG);
    vehicle.go();
    let events = vehicle.agv.events();
    vehicle.peer.release("go_to").unwrap();
    vehicle.assert_stopped();
    let reported = events.recv_timeout(PATIENCE).unwrap();
    assert!(matches!(reported, UnitEvent::LeaseExpired { ref function, .. } if function == "go_to"), "{reported:?}");
    assert_eq!(vehicle.peer.release("no_such"), Err(Error::UnknownFunction));
}

#[test]
fn without_renewal_motion_ends_with_the_lease() {
    // A lease is rounded down, by 2 ms at most. It counts from the earliest time at which the call can have been made: the
    // vehicle knows that less well where the host held it up before.
    let shortest = LEASE - Duration::from_millis(3);
    let ticker = Ticker::start();
    let (vehicle, began) = unrenewed();
    let goes = vehicle.lease.is_live() && vehicle.speed() == 5;
    assert!(goes || began.elapsed() + ticker.together() >= shortest, "it goes at first");
    let events = vehicle.manager.events();
    vehicle.assert_stopped();
    let took = began.elapsed();
    let held_up = ticker.together();
    assert!(
        took + held_up >= shortest && took < LEASE + Duration::from_secs(1) + held_up,
        "{took:?}, held up for {held_up:?}"
    );
    // The hook has run once, also after a second lease's time and with other work in between.
    let mut parameters = number(4);
    while began.elapsed() < 3 * LEASE {
        vehicle.peer.block_request("echo", &mut parameters).unwrap();
    }
    assert_eq!(vehicle.stops(), 1);
    drop(events);
}

#[test]
fn a_manager_that_goes_away_stops_the_vehicle_at_once() {
    let vehicle = vehicle(LONG);
    vehicle.go();
    let Vehicle { manager, peer, .. } = &vehicle;
    assert!(peer.is_connected());
    manager.stop();
    vehicle.assert_stopped();
    until("the vehicle knows", || !vehicle.agv.is_connected());
    assert_eq!(vehicle.stops(), 1);
}

#[test]
fn what_has_finished_ends_without_the_hook() {
    let vehicle = vehicle(LONG);
    let events = vehicle.manager.events();
    vehicle.go();
    assert!(!vehicle.agv.end_order(&vehicle.lease), "the service's lease is of no call");
    let order = vehicle.order.lock().unwrap().clone().unwrap();
    assert!(vehicle.agv.end_order(&order) && !vehicle.lease.is_live());
    loop {
        if let UnitEvent::LeaseEnded { function, why, .. } = events.recv_timeout(PATIENCE).unwrap() {
            assert_eq!((function.as_str(), why), ("go_to", LeaseEnd::Finished));
            break;
        }
    }
    assert_eq!((vehicle.stops(), vehicle.speed()), (0, 5));
    vehicle.go();
    vehicle.peer.release("go_to").unwrap();
    vehicle.assert_stopped();
}

#[test]
fn what_a_service_has_started_stops_when_it_is_removed_or_replaced() {
    for is_replaced in [false, true] {
        let vehicle = vehicle(LONG);
        vehicle.go();
        let functions = vehicle.agv.my_function_list();
        if is_replaced {
            let definition = "go_to(number: int[1]) -> (number: int[1])".parse().unwrap();
            let options = ServiceOptions::new().lease(LONG, || panic!("it has started nothing"));
            functions.replace(&definition, options, |_: &mut i64, number: cara_std::Parameters| number).unwrap();
        } else {
            functions.remove("go_to").unwrap();
        }
        vehicle.assert_stopped();
        vehicle.agv.stop();
        assert_eq!(vehicle.stops(), 1);
    }
}

#[test]
fn the_loss_of_the_manager_is_told_to_the_hook_once() {
    let vehicle = vehicle(LONG);
    let lost = Arc::new(AtomicUsize::new(0));
    let reported = lost.clone();
    vehicle
        .agv
        .on_manager_lost(move |_| {
            reported.fetch_add(1, Ordering::SeqCst);
        })
        .unwrap();
    vehicle.manager.stop();
    until("the hook has run", || lost.load(Ordering::SeqCst) == 1);
    vehicle.agv.stop();
    assert_eq!(lost.load(Ordering::SeqCst), 1);
}

/// The manager's process is gone without a goodbye: see `processes.rs` for the same with a kill. Here a handler holds the
/// state when the lease ends: the hook does not wait, and what needs the state comes when it is free.
#[test]
fn a_hook_waits_for_nobody_who_holds_the_state() {
    until("the state is held before the lease ends", || {
        let (vehicle, _) = unrenewed();
        let agv = vehicle.agv.clone();
        let was_live = agv.with_state(|speed| {
            // On a slow machine it may be over by now.
            if !vehicle.lease.is_live() {
                return false;
            }
            until("the hook has run", || vehicle.stops() == 1);
            assert!(!vehicle.lease.is_live());
            // The rest goes on meanwhile: the link is kept alive, and calls without the state are served.
            assert_eq!(crate::support::ask(&vehicle.peer, "echo", 3), Ok(3));
            *speed = 5;
            true
        });
        let was_live = was_live.unwrap();
        if was_live {
            vehicle.assert_stopped();
        }
        was_live
    });
}
