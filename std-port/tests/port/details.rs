//! What is told of calls beside their results: why they fail, how far they are, and that they are given up.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use cara_std::{
    CallError, Canceller, CommunicationSystem, Constraints, Error, Failure, LeaseWatch, LinkCounter, Parameters,
    ParametersView, Peer, RequestOptions, Served, ServiceError, ServiceOptions, Stage, Unit,
};

use crate::support::{Gate, PATIENCE, counter, held, meet, number, pair, until, value};

const SIGNATURE: &str = "(number: int) -> (number: int) progress (left: int) fails (at: int[2])";
const FAILED: Error = Error::Service(ServiceError::Failed(7));

pub(crate) fn blocked() -> Failure {
    let mut failure = Failure::new(7, "the way is blocked");
    failure.values_mut().add_int("at", 2).unwrap();
    failure.values_mut().set_value("at", [3, 4]).unwrap();
    failure
}

pub(crate) fn assert_blocked(failure: Option<&Failure>) {
    let failure = failure.expect("the service has said why");
    assert_eq!((failure.code(), failure.text()), (7, "the way is blocked"));
    assert_eq!(failure.values().variable("at"), Ok([3_i64, 4]));
}

pub(crate) fn left(value: i64) -> Parameters {
    let mut left = Parameters::new();
    left.add_int("left", 1).unwrap();
    left.set_value("left", value).unwrap();
    left
}

/// A handler, behind the name of its function.
pub(crate) fn serve(
    agv: &Unit,
    name: &str,
    options: ServiceOptions<()>,
    handler: impl Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
) {
    let definition = format!("{name}{SIGNATURE}").parse().unwrap();
    agv.my_function_list().add_service(&definition, options, handler).unwrap();
}

fn patient() -> RequestOptions {
    RequestOptions { timeout: Some(cara_std::Duration::from_secs(20)), ..Default::default() }
}

fn watched(
    peer: &Peer,
    function: &str,
    on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
) -> Result<i64, CallError> {
    let mut parameters = number(1);
    let outcome = peer.call(function, &mut parameters).with(patient()).watch(on_progress).wait();
    outcome.map(|()| value(&parameters))
}

fn passed_over(_: &ParametersView) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

#[test]
fn a_failure_tells_its_code_its_text_and_its_values() {
    let (manager, agv) = pair();
    serve(&agv, "says", ServiceOptions::new(), |call, _| Err(call.fail(blocked())));
    serve(&agv, "says_not", ServiceOptions::new(), |_, _| Err(ServiceError::Failed(7)));
    // What a handler said counts only if that is what it ends with.
    serve(&agv, "says_another", ServiceOptions::new(), |call, _| {
        call.fail(blocked());
        Err(ServiceError::Failed(8))
    });
    serve(&agv, "recovers", ServiceOptions::new(), |call, _| {
        call.fail(blocked());
        Ok(())
    });
    let (peer, _) = meet(&manager, &agv);
    let failed = watched(&peer, "says", passed_over).unwrap_err();
    assert_eq!((failed.error, failed.to_string().as_str()), (FAILED, "the way is blocked (code 7)"));
    assert_blocked(failed.failure());
    assert_eq!(peer.block_request("says", &mut number(1)), Err(FAILED), "the short form has the code");
    let failed = watched(&peer, "says_not", passed_over).unwrap_err();
    assert!(failed.error == FAILED && failed.failure().is_none(), "{failed:?}");
    let failed = watched(&peer, "says_another", passed_over).unwrap_err();
    assert!(failed.error == Error::Service(ServiceError::Failed(8)) && failed.failure().is_none(), "{failed:?}");
    assert_eq!(watched(&peer, "recovers", passed_over).unwrap(), 1);
}

/// The handler tells a thousand values at once, and answers after its caller has seen the last one.
#[test]
fn the_newest_progress_comes_and_others_need_not() {
    let (manager, agv) = pair();
    let gate = Arc::<Gate>::default();
    let seen = gate.clone();
    serve(&agv, "go", ServiceOptions::new(), move |call, parameters| {
        for metres in (0..1_000).rev() {
            call.progress(&left(metres)).map_err(|_| ServiceError::Failed(1))?;
        }
        // What does not fit the signature is an error where it would be sent, and takes nothing from what waits.
        let is_wrong = call.progress(&number(1)).is_err();
        seen.pass();
        // One behind the last look of its caller.
        call.progress(&left(-1)).map_err(|_| ServiceError::Failed(2))?;
        if is_wrong == (value(parameters) == 1) { Ok(()) } else { Err(ServiceError::Failed(3)) }
    });
    let (peer, _) = meet(&manager, &agv);
    let mut reported = Vec::new();
    let outcome = watched(&peer, "go", |progress| {
        reported.push(progress.variable::<i64>("left").unwrap());
        if reported.last() == Some(&0) {
            gate.open();
        }
        ControlFlow::Continue(())
    });
    assert_eq!(outcome.unwrap(), 1);
    assert!(reported.contains(&0) && reported.len() < 1_000 && reported.is_sorted_by(|a, b| a > b), "{reported:?}");
    // To a caller that does not want to know nothing is sent.
    let sent = || counter(&agv.manager().unwrap().counters(), "ProgressSent");
    let before = sent();
    assert_eq!(peer.call("go", &mut number(2)).with(patient()).wait(), Ok(()));
    assert!(before > 0 && sent() == before);
}

#[test]
fn a_caller_that_has_heard_enough_gives_its_call_up() {
    let (manager, agv) = pair();
    let stopped = Arc::new(AtomicUsize::new(0));
    let count = stopped.clone();
    serve(&agv, "go", ServiceOptions::new(), move |call, _| {
        let mut metres = 0;
        until("the call is given up", || {
            metres += 1;
            call.progress(&left(metres)).unwrap();
            call.is_cancelled()
        });
        count.fetch_add(1, Ordering::SeqCst);
        Ok(())
    });
    let (peer, _) = meet(&manager, &agv);
    let mut heard = 0;
    let failed = watched(&peer, "go", |_| {
        heard += 1;
        if heard < 3 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    });
    assert_eq!(failed.unwrap_err().error, Error::Cancelled);
    assert_eq!(heard, 3, "nothing is told behind the end");
    until("its handler has seen it", || stopped.load(Ordering::SeqCst) == 1);
    assert_eq!(counter(&agv.manager().unwrap().counters(), "RunningCancelled"), 1);
}

/// A vehicle that moves until its call is given up, or the gate is opened.
struct Vehicle {
    manager: CommunicationSystem,
    agv: Unit,
    peer: Peer,
    hooks: Arc<AtomicUsize>,
    orders: Arc<Mutex<Vec<LeaseWatch>>>,
    gate: Arc<Gate>,
}

impl Vehicle {
    fn new() -> Self {
        let (manager, agv) = pair();
        let (hooks, orders, gate) = <(Arc<AtomicUsize>, Arc<Mutex<Vec<LeaseWatch>>>, Arc<Gate>)>::default();
        let (ran, started) = (hooks.clone(), orders.clone());
        let options = ServiceOptions::new().lease(PATIENCE.saturating_mul(4), move || {
            ran.fetch_add(1, Ordering::SeqCst);
        });
        serve(&agv, "go", options, move |call, parameters| {
            started.lock().unwrap().push(call.lease.clone().unwrap());
            if value(parameters) == 1 {
                until("the call is given up", || call.is_cancelled());
            }
            Ok(())
        });
        let waits = "waits(number: int)".parse().unwrap();
        agv.my_function_list().add_service(&waits, ServiceOptions::new(), held(&gate)).unwrap();
        let (peer, _) = meet(&manager, &agv);
        Self { manager, agv, peer, hooks, orders, gate }
    }

    fn started(&self, count: usize) {
        until("its handler runs", || self.orders.lock().unwrap().len() == count);
    }

    fn hooks(&self) -> usize {
        self.hooks.load(Ordering::SeqCst)
    }
}

#[test]
fn another_thread_gives_a_call_up_and_its_order_ends() {
    let vehicle = Vehicle::new();
    let canceller = Canceller::new();
    let failed = std::thread::scope(|scope| {
        let call = scope.spawn(|| {
            vehicle.peer.call("go", &mut number(1)).with(patient()).cancelled_by(&canceller).watch(passed_over).wait()
        });
        vehicle.started(1);
        assert!(vehicle.hooks() == 0 && vehicle.orders.lock().unwrap()[0].is_live());
        canceller.clone().cancel();
        call.join().unwrap()
    });
    assert_eq!(failed.unwrap_err().error, Error::Cancelled);
    until("what it moved is safe", || vehicle.hooks() == 1);
    assert_eq!(vehicle.orders.lock().unwrap()[0].stage(), Stage::Dead);
    // It is for one call and all that come after it.
    let late =
        vehicle.peer.call("waits", &mut number(1)).with(patient()).cancelled_by(&canceller).watch(passed_over).wait();
    assert_eq!(late.unwrap_err().error, Error::Cancelled);
    vehicle.gate.open();
    vehicle.agv.stop();
    vehicle.manager.stop();
    assert_eq!(vehicle.hooks(), 1);
}

#[test]
fn a_call_that_is_given_up_before_it_is_sent_is_not_sent() {
    let (manager, agv) = pair();
    serve(&agv, "go", ServiceOptions::new(), |_, _| Ok(()));
    let (peer, _) = meet(&manager, &agv);
    // The next call waits so long.
    let interval = cara_std::Duration::from_secs(60);
    manager.set_constraints(Constraints { minimum_interval: interval, ..manager.constraints() }).unwrap();
    peer.block_request("go", &mut number(1)).unwrap();
    let (canceller, sent) = (Canceller::new(), manager.counted(LinkCounter::MessagesSent));
    let options = RequestOptions { timeout: Some(cara_std::Duration::from_secs(120)), ..Default::default() };
    let failed = std::thread::scope(|scope| {
        let call = scope
            .spawn(|| peer.call("go", &mut number(1)).with(options).cancelled_by(&canceller).watch(passed_over).wait());
        std::thread::sleep(std::time::Duration::from_millis(100));
        canceller.cancel();
        until("it ends", || call.is_finished());
        call.join().unwrap()
    });
    assert_eq!(failed.unwrap_err().error, Error::Cancelled);
    assert_eq!(manager.counted(LinkCounter::MessagesSent), sent);
}

#[test]
fn a_call_that_is_given_up_leaves_a_newer_order_alone() {
    let vehicle = Vehicle::new();
    let canceller = Canceller::new();
    std::thread::scope(|scope| {
        let call = scope.spawn(|| {
            vehicle.peer.call("go", &mut number(1)).with(patient()).cancelled_by(&canceller).watch(passed_over).wait()
        });
        vehicle.started(1);
        // The answer comes at once, and what it has started goes on.
        let newer = RequestOptions { renew: cara_std::Renew::Process, ..patient() };
        vehicle.peer.call("go", &mut number(2)).with(newer).wait().unwrap();
        let orders = vehicle.orders.lock().unwrap().clone();
        assert!(!orders[0].is_live() && orders[1].is_live());
        canceller.cancel();
        assert_eq!(call.join().unwrap().unwrap_err().error, Error::Cancelled);
    });
    let reported = || counter(&vehicle.agv.manager().unwrap().counters(), "RunningCancelled") == 1;
    until("its handler is told", reported);
    // What comes behind the cancellation is served behind it.
    vehicle.gate.open();
    vehicle.peer.block_request("waits", &mut number(1)).unwrap();
    let newer = vehicle.orders.lock().unwrap()[1].clone();
    assert!(newer.is_live() && vehicle.hooks() == 0, "{:?}", newer.stage());
}
