//! Handlers that call back, and calls that would wait for themselves.

use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use cara_std::{Error, Parameters, ParametersView, Peer, Served, ServiceError};

use crate::support::{Gate, PATIENCE, ask, fleet, held, meet, number, pair, service, system, unit, value};

/// What a handler needs to call back, known when both have met.
type Back<T> = Arc<OnceLock<Peer<T>>>;

#[test]
fn a_free_handler_calls_its_caller_back() {
    let (manager, agv) = pair();
    let back: Back<()> = Arc::default();
    let there = back.clone();
    let asks_back = service(move |number| ask(there.get().unwrap(), "mine", number + 1).unwrap());
    agv.my_function_list().add_function("asks_back", &number(0), asks_back).unwrap();
    manager.my_function_list().add_function("mine", &number(0), service(|number| 10 * number)).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager).is_ok());
    let began = Instant::now();
    for round in 0..200 {
        assert_eq!(ask(&peer, "asks_back", round), Ok(10 * (round + 1)));
    }
    // A fifth of a second for each, which what waits for the clock would take longer than.
    assert!(began.elapsed() < Duration::from_secs(40), "{:?}", began.elapsed());
    agv.stop();
}

#[test]
fn a_handler_with_the_state_calls_back_a_service_without_it() {
    let fleet = fleet();
    let manager = system(fleet).state(0_i64).build().unwrap();
    let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
    let back: Back<i64> = Arc::default();
    let there = back.clone();
    let asks_back = move |state: &mut i64, _: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        *state += 1;
        let number = ask(there.get().unwrap(), "mine", value(view)).map_err(|_| ServiceError::NotReady)?;
        view.set_value("number", number).map_err(|_| ServiceError::BadResults)
    };
    agv.my_function_list().add_function("asks_back", &number(0), asks_back).unwrap();
    manager.my_function_list().add_function("mine", &number(0), service(|number| -number)).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager).is_ok());
    for round in 1..50 {
        assert_eq!(ask(&peer, "asks_back", round), Ok(-round));
    }
    assert_eq!(agv.with_state(|state| *state), Ok(49));
    agv.stop();
}

/// The callback is let go by nobody, and has an hour by itself.
#[test]
fn a_call_that_a_handler_makes_ends_with_its_callers_deadline() {
    let (manager, agv) = pair();
    let (gate, back): (Arc<Gate>, Back<()>) = Default::default();
    let (there, (told, outcomes)) = (back.clone(), channel());
    let stays = gate.clone();
    let asks_back = service(move |number| {
        let hour = Duration::from_secs(3_600);
        let asked = there.get().unwrap().call("mine", &mut self::number(number)).timeout(hour).wait();
        let _ = told.send(asked.map_err(Error::from));
        // A reply now could reach a caller that is slow to notice its own time.
        stays.pass();
        number
    });
    agv.my_function_list().add_function("asks_back", &number(0), asks_back).unwrap();
    manager.my_function_list().add_function("mine", &number(0), held(&gate)).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager).is_ok());
    let asked = peer.call("asks_back", &mut number(1)).timeout(Duration::from_millis(500)).wait();
    assert_eq!(asked.map_err(Error::from), Err(Error::TimedOut));
    assert_eq!(outcomes.recv_timeout(PATIENCE / 2), Ok(Err(Error::TimedOut)), "it goes on without its caller");
    gate.open();
}

/// The manager holds its state and asks the vehicle's method, whose answer needs the manager's state: no time-out is
/// waited for.
#[test]
fn methods_that_need_both_states_are_told_at_once() {
    let fleet = fleet();
    let manager = system(fleet).state(0_i64).build().unwrap();
    let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
    let back: Back<i64> = Arc::default();
    let there = back.clone();
    let forwards = move |_: &mut i64, _: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        match ask(there.get().unwrap(), "last", value(view)) {
            Ok(number) => view.set_value("number", number).map_err(|_| ServiceError::BadResults),
            Err(Error::WouldDeadlock) => Err(ServiceError::Failed(1)),
            Err(_) => Err(ServiceError::NotReady),
        }
    };
    manager.my_function_list().add_function("last", &number(0), |_: &mut i64, p: Parameters| p).unwrap();
    agv.my_function_list().add_function("forwards", &number(0), forwards).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager.clone()).is_ok());
    assert_eq!(ask(&peer, "forwards", 4), Ok(4), "nobody holds the manager's state");
    let outcome = manager.with_state(|_| ask(&peer, "forwards", 4));
    assert_eq!(outcome, Ok(Err(Error::Service(ServiceError::Failed(1)))));
    assert_eq!(ask(&to_manager, "last", 3), Ok(3), "both states are free again");
    agv.stop();
}

/// A method reads for the reply of its own call when its caller's loss, and a lease's end, come along: their hooks need
/// the state that it holds.
#[test]
fn a_hook_does_not_wait_for_the_method_whose_thread_runs_it() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(Vec::<&str>::new()).build().unwrap();
    let back: Back<Vec<&str>> = Arc::default();
    let there = back.clone();
    let asks_back =
        move |state: &mut Vec<&'static str>, _: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            state.push("begins");
            let error = ask(there.get().unwrap(), "never", 0).unwrap_err();
            state.push(if error == Error::Interrupted { "interrupted" } else { "another error" });
            Ok(())
        };
    agv.my_function_list().add_function("asks_back", &number(0), asks_back).unwrap();
    agv.on_manager_lost(|state| state.push("lost")).unwrap();
    let gate = Arc::new(Gate::default());
    manager.my_function_list().add_function("never", &number(0), held(&gate)).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager).is_ok());
    peer.request("asks_back", &number(0)).unwrap();
    crate::support::until("the callback runs", || gate.came() == 1);
    std::thread::scope(|scope| {
        scope.spawn(|| manager.stop());
        let reported = || agv.with_state(|state| state.clone()).unwrap();
        crate::support::until("the hook has run", || reported() == ["begins", "interrupted", "lost"]);
        gate.open();
    });
    agv.stop();
}

#[test]
fn the_application_is_told_when_it_holds_the_state_itself() {
    let agv = unit("agv", 7, fleet()).state(5).build().unwrap();
    let other = agv.clone();
    assert_eq!(agv.with_state(|_| other.with_state(|state| *state)), Ok(Err(Error::WouldDeadlock)));
}
