//! Which of the calls that wait begins next.

use std::sync::{Arc, Mutex};

use cara_core::config::Scheduling;
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;

use super::met;
use crate::scenario::scenarios;
use crate::{Gate, Pending, Service, Spec, Unit, World, millis, number, secs};

scenarios![
    the_earliest_deadline_begins_first_or_what_came_first: "74", Light, [], ["RequestsAhead", "fifo"];
    calls_that_move_begin_in_their_order_whatever_their_deadlines: "74", Light, [], ["RequestsRun"];
    a_call_that_has_waited_half_its_time_out_is_next: "74", Light, [ExactTime], ["RequestsAhead"];
    one_slow_run_refuses_short_calls_for_seconds_only: "74", Light, [ExactTime], ["RequestsBusy"];
    a_peer_with_short_deadlines_keeps_no_other_peer_waiting: "74", Light, [ThirdUnit], ["RequestsRun"];
];

const fn within(timeout: Duration) -> RequestOptions {
    RequestOptions { timeout: Some(timeout), ..RequestOptions::renewing(Renew::Process) }
}

/// A vehicle that runs one call at a time, with a service that keeps others waiting, and a manager that knows them all.
fn one_at_a_time(world: &mut dyn World, gate: &Gate, services: &[&Service]) -> (Unit, Unit) {
    let manager = world.add(Spec::manager("manager", 1));
    let spec = Spec::agv("agv", 7).limits(|limits| limits.calls_per_peer = 30).one_call_at_a_time();
    let spec = spec.service(&Service::new("hold(n: int[1])").waits_at(gate));
    let agv = world.add(services.iter().fold(spec, |spec, service| spec.service(service)));
    for name in services.iter().map(|service| service.name()).chain(["hold"]) {
        met(world, &manager, "agv", name);
    }
    (manager, agv)
}

/// Makes calls of these services with these numbers and time-outs while another one runs, and lets them go when all wait.
fn wait_together(world: &mut dyn World, (manager, agv): &(Unit, Unit), gate: &Gate, calls: &[(&str, i64, Duration)]) {
    gate.close();
    let (run, received) = (agv.counted(LinkCounter::RequestsRun), agv.counted(LinkCounter::RequestsReceived));
    let held = manager.begin("agv", "hold", &number("n", 0), within(secs(60)));
    world.wait("the first one runs", || agv.counted(LinkCounter::RequestsRun) > run, secs(20));
    for (name, n, timeout) in calls {
        manager.request_with("agv", name, &number("n", *n), within(*timeout)).expect("it is sent");
    }
    let all = received + 1 + calls.len() as u64;
    world.wait("the others wait", || agv.counted(LinkCounter::RequestsReceived) == all, secs(20));
    gate.open();
    assert!(world.finish(&held).is_ok());
}

fn the_earliest_deadline_begins_first_or_what_came_first(world: &mut dyn World) {
    let (gate, note) = (Gate::default(), Service::numbered("note"));
    let units = one_at_a_time(world, &gate, &[&note]);
    let calls = [(1, secs(50)), (2, secs(30)), (3, secs(50)), (4, secs(30)), (5, secs(40))];
    let calls = calls.map(|(n, timeout)| ("note", n, timeout));
    wait_together(world, &units, &gate, &calls);
    world.wait("all ran", || note.log().runs() == calls.len(), secs(20));
    assert_eq!(note.log().values(), [2, 4, 5, 1, 3], "of equal time-outs the first");
    units.1.change(|limits| limits.scheduling = Scheduling::Fifo);
    wait_together(world, &units, &gate, &calls);
    world.wait("all ran", || note.log().runs() == 2 * calls.len(), secs(20));
    assert_eq!(note.log().values()[calls.len()..], [1, 2, 3, 4, 5]);
    world.reached("fifo");
}

fn calls_that_move_begin_in_their_order_whatever_their_deadlines(world: &mut dyn World) {
    let (gate, order) = (Gate::default(), Arc::new(Mutex::new(Vec::new())));
    let noting = |name: &str| {
        let order = Arc::clone(&order);
        Service::new(&format!("{name}(n: int[1])")).does(move |_, parameters| {
            let n = parameters.variable::<i64>("n").map_err(|_| ServiceError::BadResults)?;
            order.lock().map_err(|_| ServiceError::Panicked)?.push(n);
            Ok(())
        })
    };
    let (drive, lift, note) = (noting("drive").lease(secs(60)), noting("lift").lease(secs(60)), noting("note"));
    let units = one_at_a_time(world, &gate, &[&drive, &lift, &note]);
    let calls = [("note", 1, 55), ("note", 2, 50), ("drive", 3, 45), ("lift", 4, 40), ("note", 5, 35), ("note", 6, 30)];
    wait_together(world, &units, &gate, &calls.map(|(name, n, timeout)| (name, n, secs(timeout))));
    let ran = || order.lock().expect("no handler panics").clone();
    world.wait("all ran", || ran().len() == calls.len(), secs(20));
    assert_eq!(ran(), [2, 1, 3, 4, 6, 5], "nothing overtakes what moves");
}

/// Keeps so many calls with short time-outs waiting until the call that is asked about is over.
fn flood(world: &mut dyn World, from: &Unit, to: &str, count: usize, until: &Pending) {
    let mut calls: Vec<Pending> = Vec::new();
    while !until.is_over() {
        calls.retain(|call| !call.is_over());
        while calls.len() < count {
            calls.push(from.begin(to, "work", &number("n", 1), within(millis(120))));
        }
        world.run_for(millis(5));
    }
}

fn a_call_that_has_waited_half_its_time_out_is_next(world: &mut dyn World) {
    let (gate, work) = (Gate::default(), Service::numbered("work").takes(millis(20)));
    let (manager, agv) = one_at_a_time(world, &gate, &[&work]);
    let first = manager.begin("agv", "work", &number("n", 0), within(secs(1)));
    let began = world.now();
    let patient = manager.begin("agv", "work", &number("n", 0), within(secs(10)));
    flood(world, &manager, "agv", 8, &patient);
    assert!(world.finish(&first).is_ok() && patient.outcome() == Some(Ok(())), "{:?}", patient.outcome());
    let waited = patient.ended_at().expect("it is over").since(began);
    assert!(waited > secs(4) && waited < secs(6), "after {} ms", waited.as_millis());
    assert!(agv.counted(LinkCounter::RequestsAhead) > 0);
}

/// The first run takes 2 s, all others nothing.
fn one_slow_run_refuses_short_calls_for_seconds_only(world: &mut dyn World) {
    let (gate, work) = (Gate::default(), Service::numbered("work"));
    let work = work.waits_at(&gate);
    let (manager, agv) = one_at_a_time(world, &gate, &[&work]);
    agv.change(|limits| limits.scheduling = Scheduling::Admission);
    let ask = |world: &mut dyn World, timeout| {
        let call = manager.begin("agv", "work", &number("n", 1), within(timeout));
        world.finish(&call).map(drop)
    };
    gate.close();
    let slow = manager.begin("agv", "work", &number("n", 1), within(secs(10)));
    world.run_for(secs(2));
    gate.open();
    assert!(world.finish(&slow).is_ok());
    assert_eq!(ask(world, secs(3)), Ok(()), "it has the time");
    assert_eq!(ask(world, secs(1)), Ok(()), "one a second is tried");
    assert_eq!(ask(world, secs(1)), Err(Error::Busy), "the next one is refused at once");
    assert_eq!((work.log().runs(), agv.counted(LinkCounter::RequestsBusy)), (3, 1));
    world.run_for(secs(2));
    assert_eq!(ask(world, secs(1)), Ok(()), "what was slow once is tried again");
}

/// More calls than a unit on Linux has threads for.
const MANY: usize = 30;

fn a_peer_with_short_deadlines_keeps_no_other_peer_waiting(world: &mut dyn World) {
    let work = Service::numbered("work").takes(millis(20));
    let manager = world.add(Spec::manager("manager", 1).service(&work).limits(|limits| limits.calls_per_peer = 60));
    let [busy, patient] = [("one", 1), ("two", 2)].map(|(name, id)| world.add(Spec::agv(name, id)));
    [&busy, &patient].into_iter().for_each(|agv| met(world, agv, "manager", "work"));
    for n in 0..3 {
        let runs = work.log().runs();
        let first: Vec<_> =
            (0..MANY).map(|_| busy.begin("manager", "work", &number("n", 1), within(secs(1)))).collect();
        world.wait("the first ones run", || work.log().runs() > runs, secs(20));
        let call = patient.begin("manager", "work", &number("n", n), within(secs(10)));
        flood(world, &busy, "manager", MANY, &call);
        drop(first);
        assert_eq!(call.outcome(), Some(Ok(())), "after {} calls{}", work.log().runs() - runs, world.story());
    }
    assert_eq!(manager.number_of_s_units(), 2);
}
