//! Failures, progress and cancellation for callers and handlers that are futures.

use std::ops::ControlFlow;

use cara_std::{
    CallError, Definition, Error, Failure, Parameters, RequestOptions, Served, ServiceError, ServiceOptions,
};

use super::{patient, runtime};
use crate::details::{assert_blocked, blocked, left, serve};
use crate::support::{counter, fleet, meet, number, pair, system, unit, until, value};
use crate::typed::{Blocked, DockAsyncClient, DockServer, Gate, Left, NewerDockAsyncClient};

fn watched() -> RequestOptions {
    RequestOptions { progress: true, ..patient() }
}

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
        let mut call = peer.request_async("says", &mut parameters, &watched()).unwrap();
        assert_eq!((&mut call).await, Err(Error::Service(ServiceError::Failed(7))));
        assert_blocked(call.failure().as_deref());
        // Nothing is kept for a caller that did not ask.
        let mut parameters = number(1);
        let mut call = peer.request_async("says", &mut parameters, &patient()).unwrap();
        assert_eq!((&mut call).await, Err(Error::Service(ServiceError::Failed(7))));
        assert!(call.failure().is_none());
        let mut parameters = number(1);
        let mut call = peer.request_async("awaits", &mut parameters, &watched()).unwrap();
        assert_eq!((&mut call).await, Err(Error::Service(ServiceError::Failed(9))));
        assert_eq!(call.failure().map(|failure| failure.text().to_owned()).as_deref(), Some("on its way"));
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
        let client = DockAsyncClient::at(&peer).with(patient());
        let mut told = None;
        let on_progress = |left| {
            told = told.or(Some(left));
            ControlFlow::Continue(())
        };
        let failed = client.watch_dock(11, on_progress).await.unwrap_err();
        assert_eq!(told, Some(Left { left: 10 }));
        assert_eq!((failed.text.as_str(), failed.values), ("the way is blocked", Some(Blocked { at: [3, -4] })));
        let failed = client.watch_dock(500, |_| ControlFlow::Break(())).await.unwrap_err();
        assert_eq!(failed, CallError::Call(Error::Cancelled).into());
        let newer = NewerDockAsyncClient::at(&peer);
        let failed = newer.watch_dock(1, |_| unreachable!("nothing is sent")).await.unwrap_err();
        assert!(failed.to_string().contains("its progress left is int there and float here"), "{failed}");
    });
    until("its service has been told", || agv.with_state(|gate| gate.given_up).is_ok_and(|count| count == 1));
    manager.stop();
    agv.stop();
}

/// The handler goes on until its call is given up, which its caller does by dropping the reply.
#[test]
fn a_task_hears_progress_and_gives_its_call_up() {
    let (manager, agv) = pair();
    serve(&agv, "three", ServiceOptions::new(), |call, parameters| {
        (0..3).try_for_each(|metres| call.progress(&left(metres))).map_err(|_| ServiceError::Failed(1))?;
        parameters.set_value("number", 10 * value(parameters)).map_err(|_| ServiceError::BadResults)
    });
    let is_told = |call: Served, parameters: Parameters| async move {
        call.progress(&left(5)).map_err(|_| ServiceError::Failed(1))?;
        call.given_up().await;
        assert!(call.is_cancelled());
        Ok(parameters)
    };
    let definition: Definition = "waits(number: int) -> (number: int) progress (left: int)".parse().unwrap();
    let options = ServiceOptions::new().runs_to_its_end();
    agv.my_function_list().add_service(&definition, options, is_told).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        let mut parameters = number(1);
        let mut call = peer.request_async("three", &mut parameters, &watched()).unwrap();
        let mut last = -1;
        while let Some(told) = call.progress().await {
            let metres: i64 = told.variable("left").unwrap();
            assert!(metres > last, "{metres} behind {last}");
            last = metres;
        }
        assert_eq!(call.await, Ok(()));
        assert_eq!(value(&parameters), 10);
        let mut parameters = number(1);
        let mut call = peer.request_async("waits", &mut parameters, &watched()).unwrap();
        let told = call.progress().await.expect("it runs").variable::<i64>("left");
        assert_eq!(told, Ok(5));
        drop(call);
    });
    let cancelled = || counter(&agv.manager().unwrap().counters(), "RunningCancelled") == 1;
    until("its handler is told", cancelled);
    // The unit ends once its handler has.
    agv.stop();
}
