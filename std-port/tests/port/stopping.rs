//! Stopping a unit, from wherever.

use std::sync::{Arc, OnceLock};
use std::time::Instant;

use cara_std::{Error, Unit, UnitEvent};

use crate::support::{Gate, PATIENCE, ask, fleet, held, meet, number, pair, service, system, unit, until};

#[test]
fn a_waiting_caller_returns_at_once_when_its_unit_stops() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    agv.my_function_list().add_function("slow", &number(0), held(&gate)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    std::thread::scope(|scope| {
        // One leads, the others wait for it.
        let callers: Vec<_> = (0..4)
            .map(|number| {
                scope.spawn({
                    let peer = &peer;
                    move || {
                        let options = cara_std::RequestOptions { timeout: Some(PATIENCE.into()), ..Default::default() };
                        let mut parameters = crate::support::number(number);
                        peer.call("slow", &mut parameters).with(options).wait()
                    }
                })
            })
            .collect();
        until("they run side by side", || gate.came() == 4);
        until("all have asked", || crate::support::counter(&peer.counters(), "RequestsSent") == 4);
        manager.stop();
        for caller in callers {
            assert_eq!(caller.join().unwrap(), Err(Error::Interrupted.into()));
        }
        gate.open();
    });
    assert_eq!(ask(&peer, "slow", 1), Err(Error::NotConnected));
}

#[test]
fn a_handler_may_stop_its_own_unit() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let own: Arc<OnceLock<Unit<i64>>> = Arc::default();
    let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
    let unit = own.clone();
    let stop = move |_: &mut i64, parameters: cara_std::Parameters| {
        unit.get().unwrap().stop();
        parameters
    };
    agv.my_function_list().add_function("stop", &number(0), stop).unwrap();
    agv.my_function_list().add_function("wait", &number(0), |_: &mut i64, p: cara_std::Parameters| p).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let events = agv.events();
    assert!(own.set(agv).is_ok());
    // Methods of another class wait for the state meanwhile.
    let high = cara_std::RequestOptions { priority: Some(cara_std::Priority::High), ..Default::default() };
    for _ in 0..4 {
        peer.call("wait", &mut number(0)).with(high).send().unwrap();
    }
    assert_eq!(ask(&peer, "stop", 1), Err(Error::Interrupted));
    until("it has left", || !peer.is_connected());
    until("it has told so itself", || events.try_iter().any(|event| matches!(event, UnitEvent::Left { .. })));
}

/// While a method runs that waits for its peer, and another method waits for the state, the application stops the unit.
#[test]
fn stopping_with_the_state_held_does_not_hang() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
    agv.my_function_list().add_function("method", &number(0), |_: &mut i64, p: cara_std::Parameters| p).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let began = Instant::now();
    agv.with_state(|_| {
        peer.request("method", &number(0)).unwrap();
        until("it runs", || crate::support::counter(&agv.manager().unwrap().counters(), "RequestsRun") == 1);
        agv.stop();
    })
    .unwrap();
    assert!(began.elapsed() < PATIENCE, "{:?}", began.elapsed());
}

#[test]
fn dropping_the_last_handle_stops() {
    let (manager, agv) = pair();
    let (peer, _) = meet(&manager, &agv);
    let clone = agv.clone();
    drop(agv);
    assert!(peer.is_connected() && clone.is_connected());
    drop(clone);
    until("it has left", || !peer.is_connected());
}

#[test]
fn a_stopped_unit_says_so_and_stops_again_quietly() {
    let (manager, agv) = pair();
    manager.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, back) = meet(&manager, &agv);
    // Nothing is under way any more that could cross the goodbye: a write to a closed stream finds it reset.
    assert_eq!(ask(&back, "echo", 1), Ok(1));
    let events = manager.events();
    agv.stop();
    agv.stop();
    loop {
        if let UnitEvent::Left { reason, .. } = events.recv_timeout(PATIENCE).unwrap() {
            assert_eq!(reason, cara_std::CloseReason::Stopped);
            break;
        }
    }
    assert!(agv.start().is_err(), "it does not start again");
    assert!(!back.is_connected() && !peer.is_connected());
    let never_started = unit("never", 1, fleet()).build().unwrap();
    never_started.stop();
}
