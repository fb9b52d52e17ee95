//! How requests end: for all nodes, too soon, in time, too late, not at all.

use std::sync::Arc;
use std::time::{Duration, Instant};

use cara_std::{
    CallError, CommunicationSystem, Constraints, Delivery, Error, Parameters, Peer, RequestOptions, ServiceError, Unit,
    UnitEvent,
};

use crate::support::{
    Gate, PATIENCE, ask, counter, fleet, meet, number, pair, retire_absent, service, system, unit, until, value,
};

/// A manager and `count` s_units with a function `f`, which the last one fails.
fn fleet_with_one_that_fails(count: u32) -> (CommunicationSystem, Vec<Unit>) {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    let units: Vec<_> = (0..count).map(|id| unit(&format!("agv{id}"), id, fleet).build().unwrap()).collect();
    for (id, agv) in units.iter().enumerate() {
        let fails = id as u32 + 1 == count;
        let f = move |_: &cara_std::Served, view: &mut cara_std::ParametersView| -> Result<(), ServiceError> {
            let number = value(view) + id as i64;
            if fails {
                Err(ServiceError::Failed(4))
            } else {
                view.set_value("number", number).map_err(|_| ServiceError::BadResults)
            }
        };
        agv.my_function_list().add_function("f", &number(0), f).unwrap();
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
    }
    until("all have come", || manager.nodes_offering("f").len() == count as usize);
    retire_absent(&manager);
    (manager, units)
}

#[test]
fn a_request_to_all_has_an_outcome_for_each() {
    let (manager, _units) = fleet_with_one_that_fails(3);
    let outcomes = manager.call_all("f", &number(100)).wait();
    assert_eq!(outcomes.len(), 3);
    for (peer, outcome) in outcomes {
        let expected = if peer.id() == 2 {
            Err(Error::Service(ServiceError::Failed(4)).into())
        } else {
            Ok(100 + i64::from(peer.id()))
        };
        assert_eq!(outcome.map(|parameters| value(&parameters)), expected, "{peer:?}");
    }
}

/// No node is passed over in silence: one that is away or has no such function has an outcome too, until it is retired.
#[test]
fn a_request_to_all_tells_who_is_missing() {
    let (manager, units) = fleet_with_one_that_fails(4);
    units[0].stop();
    units[1].my_function_list().remove("f").unwrap();
    let by_id = |id: u32| manager.roster().into_iter().find(|peer| peer.id() == id).unwrap();
    until("one has left", || !by_id(0).is_connected());
    until("one has withdrawn it", || by_id(1).their_function_list().is_empty());
    let outcomes = || {
        let reported = manager.call_all("f", &number(100)).wait().into_iter();
        let mut reported: Vec<_> = reported
            .map(|(peer, outcome)| (peer.id(), outcome.map(|results| value(&results)).map_err(Error::from)))
            .collect();
        reported.sort_unstable_by_key(|(id, _)| *id);
        reported
    };
    let fails = (3, Err(Error::Service(ServiceError::Failed(4))));
    assert_eq!(outcomes(), [(0, Err(Error::NotConnected)), (1, Err(Error::UnknownFunction)), (2, Ok(102)), fails]);
    let asked = manager.call_all("f", &number(100)).send();
    let refused =
        |id: u32| asked.iter().find(|(peer, _)| peer.id() == id).unwrap().1.as_ref().err().map(|failed| failed.error);
    assert_eq!([0, 1, 2, 3].map(refused), [Some(Error::NotConnected), Some(Error::UnknownFunction), None, None]);
    assert!(by_id(0).retire() && !by_id(1).retire(), "one that is connected stays");
    assert_eq!(outcomes(), [(1, Err(Error::UnknownFunction)), (2, Ok(102)), fails]);
}

/// Three vehicles have one name: none of them is meant by it.
#[test]
fn a_name_that_several_have_is_refused() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let units = [1, 11].map(|id| unit("agv-1", id, fleet).build().unwrap());
    let named = || manager.s_unit("agv-1").map(|peer| peer.id());
    let (first, _) = meet(&manager, &units[0]);
    assert_eq!(named(), Err(Error::Ambiguous { ids: [1, 11] }), "the one that is absent may be meant");
    let (second, _) = meet(&manager, &units[1]);
    assert_eq!(named(), Err(Error::Ambiguous { ids: [1, 11] }));
    assert_eq!((first.id(), second.id()), (1, 11), "by identity each is found");
    units[0].stop();
    until("it has left", || !first.is_connected());
    assert_eq!(named(), Err(Error::Ambiguous { ids: [1, 11] }));
    assert!(first.retire());
    assert_eq!(named(), Ok(11));
    assert_eq!(manager.s_unit("nobody").err(), Some(Error::NotConnected));
}

/// One that wants no replies: it comes back as an event what failed.
#[test]
fn a_request_to_all_without_waiting_reports_the_failure() {
    let (manager, _units) = fleet_with_one_that_fails(3);
    let events = manager.events();
    let outcomes = manager.call_all("f", &number(100)).send();
    assert_eq!(outcomes.len(), 3);
    let (_, failing) = outcomes.iter().find(|(peer, _)| peer.id() == 2).unwrap();
    let failing = *failing.as_ref().unwrap();
    loop {
        if let UnitEvent::RequestFailed { peer, call, error } = events.recv_timeout(PATIENCE).unwrap() {
            assert_eq!((peer.id(), call, error), (2, failing, Error::Service(ServiceError::Failed(4))));
            return;
        }
    }
}

/// Its parameters stay as they are, whatever the service makes of them.
#[test]
fn a_request_without_waiting_returns_while_its_service_runs() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    let at_gate = gate.clone();
    let slow = service(move |number| {
        at_gate.pass();
        number + 1
    });
    agv.my_function_list().add_function("f", &number(0), slow).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let parameters = number(1);
    peer.request("f", &parameters).unwrap();
    until("it runs", || gate.came() == 1);
    gate.open();
    until("it has run", || ask(&peer, "f", 5) == Ok(6));
    assert_eq!(value(&parameters), 1);
}

#[test]
fn publishing_waits_until_all_have_acknowledged() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let units: Vec<_> = (0..2).map(|id| unit(&format!("agv{id}"), id, fleet).build().unwrap()).collect();
    for agv in &units {
        meet(&manager, agv);
    }
    let span = cara_std::Duration::from_secs(10);
    manager.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    assert_eq!(manager.publish_and_wait(span), Ok(vec![]));
    assert_eq!(ask(&units[0].manager().unwrap(), "f", 3), Ok(3));
    assert_eq!(manager.s_unit("agv1").unwrap().publish_and_wait(span), Ok(()));
}

#[test]
fn a_blocking_request_waits_for_the_interval_and_another_is_told() {
    let interval = Duration::from_millis(600);
    let fleet = fleet();
    let constraints = Constraints { minimum_interval: interval.into(), ..Constraints::M_UNIT };
    let manager = system(fleet).constraints(constraints).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    agv.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let began = Instant::now();
    for round in 0..4 {
        assert_eq!(ask(&peer, "f", round), Ok(round));
    }
    assert!(began.elapsed() >= 3 * interval, "{:?}", began.elapsed());
    // Longer than a thread waits for its turn, or the next calls would not come too soon.
    let interval = cara_std::Duration::from_secs(60);
    manager.set_constraints(Constraints { minimum_interval: interval, ..manager.constraints() }).unwrap();
    match peer.request("f", &number(1)) {
        Err(Error::TooSoon { wait }) => assert!(wait <= interval),
        other => panic!("{other:?}"),
    }
    // A time-out shorter than the interval leaves no room to wait.
    let options = RequestOptions { timeout: Some(cara_std::Duration::from_millis(1)), ..Default::default() };
    let refused = peer.call("f", &mut number(1)).with(options).wait();
    assert!(matches!(refused, Err(CallError { error: Error::TooSoon { .. }, .. })), "{refused:?}");
}

#[test]
fn a_time_out_frees_the_slot_and_leaves_the_parameters() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    let at_gate = gate.clone();
    let slow = service(move |number| {
        at_gate.pass();
        number + 1
    });
    agv.my_function_list().add_function("slow", &number(0), slow).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let options = RequestOptions { timeout: Some(cara_std::Duration::from_millis(20)), ..Default::default() };
    let mut parameters = number(5);
    let began = Instant::now();
    // More than there are slots for calls in flight.
    for _ in 0..80 {
        let refused = peer.call("slow", &mut parameters).with(options).wait();
        assert!(
            matches!(refused, Err(CallError { error: Error::TimedOut | Error::Busy | Error::Expired, .. })),
            "{refused:?}"
        );
        assert_eq!(value(&parameters), 5);
    }
    // Less than the default time-out for each.
    assert!(began.elapsed() < Duration::from_secs(80));
    gate.open();
    until("a later call works", || ask(&peer, "slow", 1) == Ok(2));
    assert!(counter(&peer.counters(), "CallsTimedOut") > 0);
}

#[test]
fn best_effort_arrives_in_one_datagram_or_is_refused() {
    let (manager, agv) = pair();
    let came = Arc::new(std::sync::Mutex::new(Vec::new()));
    let taken = came.clone();
    let take = service(move |number| {
        taken.lock().unwrap().push(number);
        number
    });
    agv.my_function_list().add_function("telemetry", &number(0), take).unwrap();
    let mut long = Parameters::<4000>::sized();
    long.add_string("text", 2000).unwrap();
    long.set_value("text", "x".repeat(2000).as_str()).unwrap();
    agv.my_function_list()
        .add_function("long", &long, |_: &cara_std::Served, _: &mut cara_std::ParametersView| Ok(()))
        .unwrap();
    let (peer, _) = meet(&manager, &agv);
    let options = RequestOptions { delivery: Delivery::BestEffort, ..Default::default() };
    let sent = || ["MessagesSent", "DatagramsSent"].map(|name| counter(&peer.counters(), name));
    // Until the vehicle has told that datagrams come, the calls go in the stream.
    let mut value = 0;
    until("a call goes in a datagram", || {
        let before = sent();
        peer.call("telemetry", &mut number(value)).with(options).send().unwrap();
        let now = sent();
        // A vehicle holds a few calls at a time and drops the rest; loopback loses none.
        value += 1;
        until("it has come", || came.lock().unwrap().len() == value as usize);
        now[0] == before[0] && now[1] > before[1]
    });
    let [_, before] = sent();
    for value in value..value + 20 {
        peer.call("telemetry", &mut number(value)).with(options).send().unwrap();
        until("it has come", || came.lock().unwrap().len() == value as usize + 1);
    }
    let [_, now] = sent();
    assert!(now >= before + 20, "{now} from {before}");
    assert_eq!(*came.lock().unwrap(), (0..value + 20).collect::<Vec<_>>());
    assert!(matches!(
        peer.call("long", &mut long).with(options).send(),
        Err(CallError { error: Error::TooLarge { .. }, .. })
    ));
    assert_eq!(peer.call("telemetry", &mut number(1)).with(options).wait(), Err(Error::BadConstraint.into()));
}

#[test]
fn what_cannot_work_is_refused_before_it_is_sent() {
    let (manager, agv) = pair();
    agv.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let sent = counter(&peer.counters(), "RequestsSent");
    let empty = Parameters::new();
    assert_eq!(peer.request("f", &empty), Err(Error::MissingArgument { index: 0 }));
    assert_eq!(peer.request("g", &number(1)), Err(Error::UnknownFunction));
    assert_eq!(counter(&peer.counters(), "RequestsSent"), sent);
    let lost: Peer = peer.clone();
    agv.stop();
    until("it has left", || !lost.is_connected());
    assert_eq!(lost.request("f", &number(1)), Err(Error::NotConnected));
}
