//! Many nodes: on shared threads, with long lists, called all at the same time, told of in order.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use cara_std::{CallError, Capacities, Constraints, Error, RequestOptions, Threads, Unit, UnitEvent};

use crate::support::{
    Gate, PATIENCE, ask, counter, fleet, held, meet, number, pair, publish, retire_absent, service, system, unit,
    until, value,
};

const NODES: u32 = 40;
/// More calls than a manager has threads for.
const CALLERS: usize = 60;

/// A manager for so many nodes, and s_units that share threads, none of them started.
fn many(fleet: u32) -> (cara_std::CommunicationSystem, Threads, Vec<Unit>) {
    let constraints = Constraints { maximum_nodes: NODES as u16, ..Constraints::M_UNIT };
    let manager = system(fleet).constraints(constraints).build().unwrap();
    let threads = Threads::new().unwrap();
    let agvs = (0..NODES).map(|id| {
        let agv = unit(&format!("agv-{id}"), 10 + id, fleet).threads(&threads).build().unwrap();
        let add = service(move |number| number + i64::from(id));
        agv.my_function_list().add_function("add", &number(0), add).unwrap();
        agv.publish_my_function_list().unwrap();
        agv
    });
    let agvs = agvs.collect();
    (manager, threads, agvs)
}

fn all_joined(manager: &cara_std::CommunicationSystem) -> bool {
    manager.number_of_s_units() == NODES as usize
}

/// One node keeps more calls waiting than there are threads to run them, for as long as another one asks.
#[test]
fn a_node_that_keeps_all_threads_busy_keeps_no_other_node_waiting() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let work = service(|number| {
        std::thread::sleep(Duration::from_millis(5));
        number
    });
    manager.my_function_list().add_function("work", &number(0), work).unwrap();
    let (busy, patient) = (unit("first", 1, fleet).build().unwrap(), unit("second", 2, fleet).build().unwrap());
    let (_, flood) = meet(&manager, &busy);
    let (_, asks) = meet(&manager, &patient);
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..CALLERS {
            scope.spawn(|| {
                while !over.load(Ordering::SeqCst) {
                    let _ = ask(&flood, "work", 1);
                }
            });
        }
        let asked: Vec<_> = (0..20).map(|round| ask(&asks, "work", round)).collect();
        over.store(true, Ordering::SeqCst);
        assert_eq!(asked, (0..20).map(Ok).collect::<Vec<_>>());
    });
}

#[test]
fn units_that_share_threads_serve_and_stop_each_by_itself() {
    let (manager, threads, mut agvs) = many(fleet());
    manager.start().unwrap();
    agvs.iter().for_each(|agv| agv.start().unwrap());
    until("all have joined", || all_joined(&manager));
    for peer in manager.s_units() {
        assert_eq!(ask(&peer, "add", 100), Ok(100 + i64::from(peer.id() - 10)), "{peer:?}");
    }
    let rest = agvs.split_off(NODES as usize / 2);
    agvs.iter().for_each(Unit::stop);
    assert_eq!(agvs.first().unwrap().start(), Err(Error::NotRunning.into()), "it does not start again");
    drop(threads);
    until("half of them have left", || manager.number_of_s_units() == rest.len());
    for peer in manager.s_units().iter().filter(|peer| peer.is_connected()) {
        assert_eq!(ask(peer, "add", 1), Ok(1 + i64::from(peer.id() - 10)), "{peer:?}");
    }
    drop(rest);
    until("nobody is left", || manager.number_of_s_units() == 0);
}

/// A handler of one unit stops another one that shares its threads, and then its own.
#[test]
fn a_handler_on_shared_threads_may_stop_units() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let threads = Threads::new().unwrap();
    let [one, two] = [1, 2].map(|id| unit(&format!("agv-{id}"), id, fleet).threads(&threads).build().unwrap());
    let units = [two.downgrade(), one.downgrade()];
    let stop = service(move |number| {
        units.iter().filter_map(cara_std::WeakUnit::upgrade).for_each(|unit| unit.stop());
        number
    });
    one.my_function_list().add_function("stop", &number(0), stop).unwrap();
    meet(&manager, &two);
    let (peer, _) = meet(&manager, &one);
    assert_eq!(ask(&peer, "stop", 1), Err(Error::Interrupted));
    until("both have left", || manager.number_of_s_units() == 0);
}

#[test]
fn all_are_called_although_the_interval_has_not_passed() {
    let (manager, _threads, agvs) = many(fleet());
    let interval = Duration::from_secs(1);
    let constraints = Constraints { minimum_interval: interval.into(), ..manager.constraints() };
    manager.set_constraints(constraints).unwrap();
    manager.start().unwrap();
    agvs.iter().for_each(|agv| agv.start().unwrap());
    until("all have joined", || all_joined(&manager));
    retire_absent(&manager);
    let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::default() };
    let began = std::time::Instant::now();
    for _ in 0..2 {
        let outcomes = manager.call_all("add", &number(5)).with(options).wait();
        assert_eq!(outcomes.len(), NODES as usize);
        for (peer, outcome) in outcomes {
            assert_eq!(outcome.map(|results| value(&results)), Ok(5 + i64::from(peer.id() - 10)), "{peer:?}");
        }
    }
    assert!(began.elapsed() >= interval, "the second call of each waited");
    // Longer than a thread waits for its turn, or the last call would not come too soon.
    let minute = cara_std::Duration::from_secs(60);
    manager.set_constraints(Constraints { minimum_interval: minute, ..manager.constraints() }).unwrap();
    let hasty = RequestOptions { timeout: Some(Duration::from_millis(1).into()), ..RequestOptions::default() };
    let outcomes = manager.call_all("add", &number(5)).with(hasty).wait();
    assert!(
        outcomes.iter().any(|(_, outcome)| matches!(outcome, Err(CallError { error: Error::TooSoon { .. }, .. }))),
        "not beyond the deadline"
    );
}

#[test]
fn whoever_counts_has_told_its_list() {
    let (manager, _threads, agvs) = many(fleet());
    manager.start().unwrap();
    agvs.iter().for_each(|agv| agv.start().unwrap());
    until("all have joined", || {
        let counted = manager.number_of_s_units();
        assert!(manager.nodes_offering("add").len() >= counted, "{counted}");
        counted == NODES as usize
    });
}

#[test]
fn a_node_has_joined_before_anything_else_is_told_of_it() {
    let (manager, _threads, agvs) = many(fleet());
    let events = manager.events();
    manager.start().unwrap();
    agvs.iter().for_each(|agv| agv.start().unwrap());
    until("all have joined", || all_joined(&manager));
    agvs.iter().for_each(Unit::stop);
    let mut lives: HashMap<u32, Vec<&str>> = HashMap::new();
    until("all have left", || {
        for event in events.try_iter() {
            let (peer, what) = match event {
                UnitEvent::Joined { peer } => (peer, "joined"),
                UnitEvent::ListChanged { peer } => (peer, "list"),
                UnitEvent::Left { peer, .. } => (peer, "left"),
                _ => continue,
            };
            lives.entry(peer.id()).or_default().push(what);
        }
        lives.len() == NODES as usize && lives.values().all(|life| life.last() == Some(&"left"))
    });
    assert!(lives.values().all(|life| *life == ["joined", "list", "left"]), "{lives:?}");
}

/// A link begins with room for a few functions and calls, and reaches the capacities.
#[test]
fn tables_grow_to_the_capacities_and_no_further() {
    let fleet = fleet();
    let capacities = Capacities { calls_in_flight: 16, their_functions: 40, ..Capacities::default() };
    let manager = system(fleet).capacities(capacities).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    agv.set_constraints(Constraints { calls_per_peer: 64, ..agv.constraints() }).unwrap();
    let gate = std::sync::Arc::new(Gate::default());
    agv.my_function_list().add_function("slow", &number(0), held(&gate)).unwrap();
    for index in 1..45 {
        agv.my_function_list()
            .add_function(&format!("function_{index}"), &number(0), service(|number| number))
            .unwrap();
    }
    publish(&manager, &agv);
    let events = agv.events();
    manager.start().unwrap();
    agv.start().unwrap();
    until("it has joined", || manager.number_of_s_units() == 1);
    let peer = manager.s_units().remove(0);
    assert_eq!(peer.their_function_list().len(), 40);
    until("it is told how many were skipped", || {
        events.try_iter().any(|event| matches!(event, UnitEvent::FunctionsSkipped { skipped: 5, .. }))
    });
    assert_eq!(ask(&peer, "function_39", 3), Ok(3));
    assert_eq!(ask(&peer, "function_40", 3), Err(Error::UnknownFunction));
    let before = counter(&peer.counters(), "RequestsSent");
    let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::default() };
    let call = |caller: i64| peer.call("slow", &mut number(caller)).with(options).wait();
    std::thread::scope(|scope| {
        let callers: Vec<_> = (0..20)
            .map(|caller| {
                scope.spawn({
                    let call = &call;
                    move || call(caller)
                })
            })
            .collect();
        until("as many are in flight as may be", || counter(&peer.counters(), "RequestsSent") - before == 16);
        gate.open();
        assert!(callers.into_iter().all(|caller| caller.join().unwrap() == Ok(())));
    });
    assert_eq!(counter(&peer.counters(), "RequestsSent") - before, 20);
}

#[test]
fn functions_that_are_added_later_reach_those_who_are_connected() {
    let (manager, agv) = pair();
    let (peer, _) = meet(&manager, &agv);
    for index in 0..30 {
        agv.my_function_list().add_function(&format!("later_{index}"), &number(0), service(|number| number)).unwrap();
    }
    agv.publish_my_function_list().unwrap();
    until("all are known", || peer.their_function_list().len() == 30);
    assert_eq!(ask(&peer, "later_29", 4), Ok(4));
}
