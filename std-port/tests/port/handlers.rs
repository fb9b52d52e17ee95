//! What runs a service: its forms, in both roles, and what happens when it panics or takes long.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cara_std::{
    Error, Parameters, ParametersView, Priority, RequestOptions, Role, Served, ServiceError, ServiceOptions,
};

use crate::support::{
    Gate, PATIENCE, ask, fleet, held, meet, number, pair, publish, service, system, unit, until, value, within,
};

fn free(mut parameters: Parameters) -> Parameters {
    let doubled = 2 * value(&parameters);
    parameters.set_value("number", doubled).unwrap();
    parameters
}

fn method(state: &mut i64, mut parameters: Parameters) -> Parameters {
    *state += value(&parameters);
    parameters.set_value("number", *state).unwrap();
    parameters
}

fn in_place(call: &Served, view: &mut ParametersView) -> Result<(), ServiceError> {
    let sign = if call.caller.role() == Role::MUnit { 1 } else { -1 };
    let number = sign * value(view);
    view.set_value("number", number).map_err(|_| ServiceError::BadResults)
}

fn method_in_place(state: &mut i64, _: &Served, view: &mut ParametersView) -> Result<(), ServiceError> {
    if value(view) == 0 {
        return Err(ServiceError::Failed(9));
    }
    view.set_value("number", *state).map_err(|_| ServiceError::BadResults)
}

#[test]
fn all_four_forms_serve_in_both_roles() {
    let fleet = fleet();
    let manager = system(fleet).state(100_i64).build().unwrap();
    let agv = unit("agv", 7, fleet).state(200_i64).build().unwrap();
    for list in [manager.my_function_list(), agv.my_function_list()] {
        list.add_function("free", &number(0), free).unwrap();
        list.add_function("method", &number(0), method).unwrap();
        list.add_function("in_place", &number(0), in_place).unwrap();
        list.add_function("method_in_place", &number(0), method_in_place).unwrap();
    }
    let (peer, back) = meet(&manager, &agv);
    for (peer_free, sign, start) in [(ask(&peer, "free", 21), 1, 200), (ask(&back, "free", 21), -1, 100)] {
        assert_eq!(peer_free, Ok(42));
        let call = |function: &str, number: i64| match sign {
            1 => ask(&peer, function, number),
            _ => ask(&back, function, number),
        };
        assert_eq!(call("method", 5), Ok(start + 5));
        assert_eq!(call("method", 5), Ok(start + 10));
        assert_eq!(call("in_place", 7), Ok(7 * sign));
        assert_eq!(call("method_in_place", 1), Ok(start + 10));
        assert_eq!(call("method_in_place", 0), Err(Error::Service(ServiceError::Failed(9))));
    }
    assert_eq!(manager.with_state(|state| *state), Ok(110));
    assert_eq!(agv.with_state(|state| *state), Ok(210));
}

#[test]
fn a_handler_that_panics_harms_nobody_else() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
    let list = agv.my_function_list();
    list.add_function("free", &number(0), |_: &Served, _: &mut ParametersView| panic!("as the test wants")).unwrap();
    list.add_function("method", &number(0), |_: &mut i64, _: Parameters| -> Parameters { panic!("likewise") }).unwrap();
    list.add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    for round in 0..20 {
        assert_eq!(ask(&peer, "free", round), Err(Error::Service(ServiceError::Panicked)));
        assert_eq!(ask(&peer, "method", round), Err(Error::Service(ServiceError::Panicked)));
        assert_eq!(ask(&peer, "echo", round), Ok(round));
    }
    assert!(agv.with_state(|_| ()).is_ok());
}

/// One handler of one link hangs; everything else goes on, keep-alives included.
#[test]
fn a_slow_handler_delays_nobody_else() {
    let fleet = fleet();
    let constraints =
        cara_std::Constraints { keep_alive: cara_std::Duration::from_millis(800), ..crate::keyed::M_UNIT };
    let manager = system(fleet).constraints(constraints).build().unwrap();
    let gate = Arc::new(Gate::default());
    manager.my_function_list().add_function("slow", &number(0), held(&gate)).unwrap();
    manager.my_function_list().add_function("quick", &number(0), service(|number| number + 1)).unwrap();
    let units: Vec<_> = (0..2)
        .map(|index| {
            let constraints = cara_std::Constraints { maximum_nodes: 1, ..constraints };
            unit(&format!("agv{index}"), index, fleet).constraints(constraints).build().unwrap()
        })
        .collect();
    let [first, second] = [&units[0], &units[1]].map(|unit| meet(&manager, unit));
    let options = RequestOptions { timeout: Some(cara_std::Duration::from_secs(20)), ..Default::default() };
    std::thread::scope(|scope| {
        let slow = scope.spawn(|| {
            let mut parameters = number(1);
            first.1.call("slow", &mut parameters).with(options).wait()
        });
        until("the slow handler runs", || gate.came() == 1);
        // Longer than the three keep-alives after which a silent link is lost.
        let began = Instant::now();
        while began.elapsed() < Duration::from_secs(4) {
            assert_eq!(ask(&second.1, "quick", 1), Ok(2), "another link");
            let high = RequestOptions { priority: Some(Priority::High), ..Default::default() };
            let mut parameters = number(4);
            assert_eq!(first.1.call("quick", &mut parameters).with(high).wait(), Ok(()), "the same link");
            assert_eq!(value(&parameters), 5);
        }
        assert!(first.0.is_connected() && second.0.is_connected());
        gate.open();
        assert_eq!(slow.join().unwrap(), Ok(()));
    });
}

/// A link begins with slots for fewer.
#[test]
fn as_many_calls_of_one_peer_run_as_it_may_have() {
    const CALLS: usize = 6;
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    manager.my_function_list().add_function("slow", &number(0), held(&gate)).unwrap();
    let (_, peer) = meet(&manager, &agv);
    let options = RequestOptions { timeout: Some(cara_std::Duration::from_secs(20)), ..Default::default() };
    std::thread::scope(|scope| {
        let call = || peer.call("slow", &mut number(1)).with(options).wait();
        let calls: Vec<_> = (0..CALLS).map(|_| scope.spawn(call)).collect();
        until("all of them run", || gate.came() == CALLS);
        gate.open();
        assert!(calls.into_iter().all(|call| call.join().unwrap() == Ok(())));
    });
}

/// Handlers that have been quick run on threads without a relief; the clock starts a thread when all are inside
/// handlers.
#[test]
fn quick_handlers_that_all_get_slow_leave_a_thread_that_reads() {
    const CALLERS: u32 = 5;
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let gate = Arc::new(Gate::default());
    let at_gate = gate.clone();
    let work = service(move |number| {
        if number == 1 {
            at_gate.pass();
        }
        number
    });
    manager.my_function_list().add_function("work", &number(0), work).unwrap();
    let units: Vec<_> =
        (0..=CALLERS).map(|index| unit(&format!("agv{index}"), index, fleet).build().unwrap()).collect();
    let met: Vec<_> = units.iter().map(|unit| meet(&manager, unit)).collect();
    let (last, callers) = met.split_last().unwrap();
    let options = RequestOptions { timeout: Some(cara_std::Duration::from_secs(20)), ..Default::default() };
    let call = |peer: &cara_std::Peer, argument| peer.call("work", &mut number(argument)).with(options).wait();
    std::thread::scope(|scope| {
        let calls: Vec<_> = callers
            .iter()
            .map(|(_, peer)| {
                scope.spawn(move || {
                    (0..50).for_each(|_| assert_eq!(call(peer, 0), Ok(())));
                    call(peer, 1)
                })
            })
            .collect();
        until("all slow handlers run", || gate.came() == CALLERS as usize);
        assert_eq!(call(&last.1, 0), Ok(()), "another link");
        gate.open();
        calls.into_iter().for_each(|call| assert_eq!(call.join().unwrap(), Ok(())));
    });
}

/// An emergency is served while a handler of each other class is busy.
#[test]
fn an_emergency_does_not_wait_for_other_handlers() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    let stops = Arc::new(AtomicUsize::new(0));
    let stopped = stops.clone();
    let list = agv.my_function_list();
    list.add_function("work", &number(0), held(&gate)).unwrap();
    let definition = "stop(number: int[1]) -> (number: int[1])".parse().unwrap();
    let stop = service(move |number| {
        stopped.fetch_add(1, Ordering::SeqCst);
        number
    });
    list.add_service(&definition, ServiceOptions::new().priority(Priority::Emergency), stop).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let classes = [Priority::High, Priority::Normal, Priority::Low];
    for priority in classes {
        let timeout = Some(cara_std::Duration::from_secs(20));
        let options = RequestOptions { priority: Some(priority), timeout, ..Default::default() };
        peer.call("work", &mut number(1)).with(options).send().unwrap();
        peer.call("work", &mut number(1)).with(options).send().unwrap();
    }
    until("all are busy, side by side", || gate.came() == 2 * classes.len());
    assert_eq!(ask(&peer, "stop", 3), Ok(3), "while the others are busy");
    assert_eq!(stops.load(Ordering::SeqCst), 1, "it came twice and ran once");
    gate.open();
}

/// The first call of a burst is quick, the second is not: the thread that serves them must not keep the stream.
#[test]
fn a_burst_that_ends_slowly_leaves_the_stream_to_others() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    let list = agv.my_function_list();
    list.add_function("quick", &number(0), service(|number| number)).unwrap();
    list.add_function("slow", &number(0), held(&gate)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    for round in 0..50 {
        // A thread of the pool comes to stay.
        for _ in 0..20 {
            assert_eq!(ask(&peer, "quick", round), Ok(round));
        }
        peer.request("quick", &number(1)).unwrap();
        peer.request("quick", &number(2)).unwrap();
        peer.request("quick", &number(3)).unwrap();
        peer.flush().unwrap();
    }
    peer.request("quick", &number(1)).unwrap();
    peer.request("slow", &number(2)).unwrap();
    peer.flush().unwrap();
    until("the slow one runs", || gate.came() == 1);
    let options = RequestOptions { priority: Some(Priority::High), ..Default::default() };
    let mut parameters = number(5);
    assert_eq!(peer.call("quick", &mut parameters).with(options).wait(), Ok(()), "while the slow one runs");
    gate.open();
}

#[test]
fn a_changed_function_is_stale_until_it_is_published_again() {
    let (manager, agv) = pair();
    agv.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let definition = "f(number: int[1]) -> (number: int[1])".parse().unwrap();
    agv.my_function_list().replace(&definition, ServiceOptions::new(), service(|number| -number)).unwrap();
    assert_eq!(ask(&peer, "f", 1), Err(Error::StaleFunction));
    publish(&manager, &agv);
    until("the new one is known", || ask(&peer, "f", 1) == Ok(-1));
    agv.my_function_list().remove("f").unwrap();
    until("it is gone", || ask(&peer, "f", 1) == Err(Error::UnknownFunction));
}

/// Long messages are sealed ahead of the stream, on a link that is full of them: an emergency runs before those that were
/// accepted before it, and once, though it comes as a datagram and in the stream.
#[test]
fn an_emergency_overtakes_long_messages_that_are_sealed_ahead() {
    let (manager, agv) = pair();
    let (stored, stops) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let mut long = Parameters::<48_000>::sized();
    long.add_string("text", 20_000).unwrap();
    long.set_value("text", &*"x".repeat(20_000)).unwrap();
    let list = agv.my_function_list();
    let runs = stored.clone();
    let store = move |_: &Served, _: &mut ParametersView| {
        runs.fetch_add(1, Ordering::SeqCst);
        Ok(())
    };
    list.add_function("store", &long, store).unwrap();
    let definition = "stop(number: int[1]) -> (number: int[1])".parse().unwrap();
    let (runs, stopped) = (stored.clone(), stops.clone());
    let stop = service(move |_| {
        stopped.fetch_add(1, Ordering::SeqCst);
        runs.load(Ordering::SeqCst) as i64
    });
    list.add_service(&definition, ServiceOptions::new().priority(Priority::Emergency), stop).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let (accepted, over) = (AtomicUsize::new(0), AtomicBool::new(false));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::SeqCst) {
                accepted.fetch_add(usize::from(peer.request("store", &long).is_ok()), Ordering::SeqCst);
            }
        });
        let mut asked = 0;
        let overtakes = within(PATIENCE, || {
            let before = accepted.load(Ordering::SeqCst) as i64;
            asked += 1;
            ask(&peer, "stop", 0).is_ok_and(|stored| stored < before)
        });
        over.store(true, Ordering::SeqCst);
        assert!(overtakes, "an emergency runs before what was accepted before it");
        assert_eq!(stops.load(Ordering::SeqCst), asked, "each once");
    });
    until("the long messages run as well", || stored.load(Ordering::SeqCst) > 0);
}
