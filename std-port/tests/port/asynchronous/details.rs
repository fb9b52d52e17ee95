//! Failures, progress and cancellation for callers and handlers that are futures.

use std::cell::Cell;
use std::ops::ControlFlow;
use std::sync::Arc;

use cara_std::{
    Canceller, Constraints, Definition, Error, Failure, LinkCounter, Parameters, ParametersView, Served, ServiceError,
    ServiceOptions,
};

use super::{once, patient, runtime};
use crate::details::{assert_blocked, blocked, left, serve};
use crate::support::{PATIENCE, counter, fleet, held, meet, number, pair, system, unit, until, value};
use crate::typed::{Blocked, DockClient, DockServer, Gate, Left, NewerDockClient};

#[test]
fn a_failure_tells_its_text_and_its_values_to_a_task() {
    let (manager, agv) = pair();
    serve(&agv, "says", ServiceOptions::new(), |call, _| Err(call.fail(blocked())));
    async fn is_a_future(call: Served, _: Parameters) -> Result<Parameters, ServiceError> {
        call.progress(&left(3)).map_err(|_| ServiceError::Failed(1))?;
        tokio::task::yield_now().await;
        Err(call.fail(Failure::new(9, "on its way")))
    }
    let definition: Definition = "awaits(number: int) -> (number: int) progress (left: int)".parse().unwrap();
    agv.my_function_list().add_service(&definition, ServiceOptions::new(), is_a_future).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        let mut parameters = number(1);
        let failed = peer.call("says", &mut parameters).with(patient()).await.unwrap_err();
        assert_eq!(failed, Error::Service(ServiceError::Failed(7)));
        assert_blocked(failed.failure());
        let failed = peer.call("awaits", &mut parameters).with(patient()).await.unwrap_err();
        assert_eq!(failed, Error::Service(ServiceError::Failed(9)));
        assert_eq!(failed.text(), "on its way");
    });
}

#[test]
fn a_task_awaits_what_a_typed_call_tells() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(Gate::default()).build().unwrap();
    agv.my_function_list().serve(DockServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        let client = DockClient::at(&peer).with(patient());
        let mut reported = None;
        let on_progress = |left| {
            reported = reported.or(Some(left));
            ControlFlow::Continue(())
        };
        let failed = client.dock(11).watch(on_progress).await.unwrap_err();
        assert_eq!(reported, Some(Left { left: 10 }));
        assert_eq!((failed.text(), failed.values()), ("the way is blocked", Some(Blocked { at: [3, -4] })));
        let failed = client.dock(500).watch(|_| ControlFlow::Break(())).await.unwrap_err();
        assert_eq!(failed, Error::Cancelled);
        let mut heard = 0;
        let breaks = |_| {
            heard += 1;
            ControlFlow::Break(())
        };
        let failed = client.dock(500).watch(breaks).answer_within(PATIENCE).await.unwrap_err();
        assert_eq!((failed.text(), failed.values(), heard), ("given up", Some(Blocked { at: [5, 6] }), 1));
        let newer = NewerDockClient::at(&peer);
        let failed = newer.dock(1).watch(|_| unreachable!("nothing is sent")).await.unwrap_err();
        assert!(failed.to_string().contains("its progress left is int there and float here"), "{failed}");
    });
    until("its service has been told", || agv.with_state(|gate| gate.given_up).is_ok_and(|count| count == 2));
    manager.stop();
    agv.stop();
}

/// By a canceller that no progress wakes; then of a service that does not answer.
#[test]
fn a_task_awaits_the_answer_of_a_call_that_is_given_up() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(Gate::default()).build().unwrap();
    agv.my_function_list().serve(DockServer).unwrap();
    let at_gate = Arc::new(crate::support::Gate::default());
    agv.my_function_list().add_function("held", &number(0), held(&at_gate)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let canceller = Canceller::new();
    let button = canceller.clone();
    let pressed = std::thread::spawn({
        let at_gate = at_gate.clone();
        move || {
            until("it runs", || at_gate.came() == 1);
            button.cancel();
        }
    });
    runtime().block_on(async {
        let client = DockClient::at(&peer).with(patient());
        let mut four = number(4);
        let held = peer.call("held", &mut four).with(patient()).cancelled_by(&canceller);
        let within = std::time::Duration::from_millis(50);
        assert_eq!(held.answer_within(within).await.unwrap_err(), Error::Cancelled);
        let failed = client.dock(500).cancelled_by(&canceller).answer_within(PATIENCE).await.unwrap_err();
        assert_eq!(failed, Error::Cancelled, "it was not sent");
    });
    pressed.join().unwrap();
    at_gate.open();
    until("its answer reaches no one", || manager.counted(LinkCounter::RepliesLate) == 1);
    manager.stop();
    agv.stop();
}

/// The next call waits for longer than a canceller is heard in.
#[test]
fn a_canceller_ends_a_task_s_call_that_is_not_sent_yet_and_no_poll_sends_it_again() {
    let (manager, agv) = pair();
    serve(&agv, "go", ServiceOptions::new(), |_, _| Ok(()));
    let (peer, _) = meet(&manager, &agv);
    let interval = cara_std::Duration::from_secs(60);
    manager.set_constraints(Constraints { minimum_interval: interval, ..manager.constraints() }).unwrap();
    peer.block_request("go", &mut number(1)).unwrap();
    let (canceller, sent) = (Canceller::new(), manager.counted(LinkCounter::RequestsSent));
    runtime().block_on(async {
        let mut parameters = number(1);
        let call = peer.call("go", &mut parameters).timeout(cara_std::Duration::from_secs(120));
        let mut call = call.cancelled_by(&canceller).into_future();
        // It waits for its turn by then: this poll is the last before the alarm.
        assert_eq!(once(&mut call).await, None);
        let button = canceller.clone();
        std::thread::spawn(move || {
            std::thread::sleep(std::time::Duration::from_millis(100));
            button.cancel();
        });
        let began = std::time::Instant::now();
        assert_eq!(call.await, Err(Error::Cancelled.into()));
        assert!(began.elapsed() < std::time::Duration::from_secs(30), "the next try is in a minute");
    });
    manager
        .set_constraints(Constraints { minimum_interval: cara_std::Duration::ZERO, ..manager.constraints() })
        .unwrap();
    runtime().block_on(async {
        let mut parameters = number(1);
        let mut call = peer.call("no_such", &mut parameters).into_future();
        assert_eq!((&mut call).await, Err(Error::UnknownFunction.into()));
        assert_eq!((&mut call).await, Err(Error::Interrupted.into()), "it is over");
    });
    assert_eq!(manager.counted(LinkCounter::RequestsSent), sent);
}

/// The handler goes on until its call is given up, which its caller does by dropping the reply.
#[test]
fn a_task_hears_progress_and_gives_its_call_up() {
    let (manager, agv) = pair();
    serve(&agv, "three", ServiceOptions::new(), |call, parameters| {
        (0..3).try_for_each(|metres| call.progress(&left(metres))).map_err(|_| ServiceError::Failed(1))?;
        parameters.set_value("number", 10 * value(parameters)).map_err(|_| ServiceError::BadResults)
    });
    let is_reported = |call: Served, parameters: Parameters| async move {
        call.progress(&left(5)).map_err(|_| ServiceError::Failed(1))?;
        call.given_up().await;
        assert!(call.is_cancelled());
        Ok(parameters)
    };
    let definition: Definition = "waits(number: int) -> (number: int) progress (left: int)".parse().unwrap();
    let options = ServiceOptions::new().runs_to_its_end();
    agv.my_function_list().add_service(&definition, options, is_reported).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        let mut parameters = number(1);
        let mut last = -1;
        let rises = |reported: &ParametersView| {
            let metres: i64 = reported.variable("left").unwrap();
            assert!(metres > last, "{metres} behind {last}");
            last = metres;
            ControlFlow::Continue(())
        };
        assert_eq!(peer.call("three", &mut parameters).with(patient()).watch(rises).await, Ok(()));
        assert_eq!(value(&parameters), 10);
        let heard = Cell::new(None);
        let mut parameters = number(1);
        let call = peer.call("waits", &mut parameters).with(patient()).watch(|reported| {
            heard.set(Some(reported.variable::<i64>("left")));
            ControlFlow::Continue(())
        });
        let mut call = call.into_future();
        while heard.get().is_none() {
            assert_eq!(once(&mut call).await, None);
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
        assert_eq!(heard.get(), Some(Ok(5)));
        // Dropped when it has told something.
        drop(call);
    });
    let cancelled = || counter(&agv.manager().unwrap().counters(), "RunningCancelled") == 1;
    until("its handler is told", cancelled);
    // The unit ends once its handler has.
    agv.stop();
}
