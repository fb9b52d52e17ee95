//! The asynchronous face, on tokio.

mod details;
mod services;
mod starving;
mod streams;
mod typed;
mod waiting;

use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

use cara_std::{CallError, Constraints, Error, Parameters, Peer, RequestOptions, ServiceError};

use crate::support::{
    Gate, PATIENCE, ask, counter, fleet, held, meet, number, pair, service, system, unit, until, value,
};

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_time().build().unwrap()
}

fn patient() -> RequestOptions {
    within_millis(20_000)
}

fn within_millis(millis: u64) -> RequestOptions {
    RequestOptions { timeout: Some(cara_std::Duration::from_millis(millis)), ..Default::default() }
}

/// Polls a future once.
async fn once<F: Future + Unpin>(future: &mut F) -> Option<F::Output> {
    std::future::poll_fn(|cx| match std::pin::Pin::new(&mut *future).poll(cx) {
        std::task::Poll::Ready(output) => std::task::Poll::Ready(Some(output)),
        std::task::Poll::Pending => std::task::Poll::Ready(None),
    })
    .await
}

async fn echo(peer: &Peer, number_in: i64) -> Result<i64, Error> {
    let mut parameters = number(number_in);
    peer.call("echo", &mut parameters).with(patient()).await.map(|()| value(&parameters)).map_err(Error::from)
}

#[test]
fn a_request_can_be_awaited_and_fails_like_any_other() {
    let (manager, agv) = pair();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        for number in 0..100 {
            assert_eq!(echo(&peer, number).await, Ok(number));
        }
        let refused = peer.call("no_such", &mut number(1)).with(patient()).await;
        assert_eq!(refused, Err(Error::UnknownFunction.into()));
    });
    agv.stop();
    until("it has left", || !peer.is_connected());
    assert_eq!(runtime().block_on(echo(&peer, 1)), Err(Error::NotConnected));
}

#[test]
fn a_hundred_requests_are_awaited_side_by_side() {
    let (manager, agv) = pair();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        let tasks: Vec<_> = (0..100)
            .map(|number| {
                let peer = peer.clone();
                tokio::spawn(async move {
                    loop {
                        match echo(&peer, number).await {
                            // There are fewer slots than tasks: here it waits for one, and there it may be refused.
                            Err(Error::Busy) => tokio::task::yield_now().await,
                            outcome => return outcome,
                        }
                    }
                })
            })
            .collect();
        for (number, task) in tasks.into_iter().enumerate() {
            assert_eq!(task.await.unwrap(), Ok(number as i64));
        }
    });
    assert_eq!(counter(&peer.counters(), "CallsTimedOut"), 0);
}

#[test]
fn a_future_times_out_and_a_dropped_one_frees_its_slot() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    agv.my_function_list().add_function("hang", &number(0), held(&gate)).unwrap();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        // Long enough for the call to be run on a busy machine: one that comes too late is answered.
        let mut parameters = number(5);
        let outcome = peer.call("hang", &mut parameters).with(within_millis(500)).await;
        assert_eq!((outcome, value(&parameters)), (Err(Error::TimedOut.into()), 5));
        // More than there are slots, each given up before its reply.
        for _ in 0..300 {
            let mut parameters = number(5);
            let pending = peer.call("hang", &mut parameters).with(within_millis(30)).into_future();
            match tokio::time::timeout(Duration::ZERO, pending).await {
                Err(_) => {}
                Ok(Err(CallError { error: Error::Busy | Error::TimedOut | Error::Expired, .. })) => {} // The peer refuses those beyond its own limit.
                Ok(outcome) => panic!("{outcome:?}"),
            }
        }
    });
    gate.open();
    until("calls work again", || ask(&peer, "echo", 3) == Ok(3));
}

#[test]
fn a_future_ends_when_its_link_does() {
    let (manager, agv) = pair();
    let gate = Arc::new(Gate::default());
    agv.my_function_list().add_function("hang", &number(0), held(&gate)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let runtime = runtime();
    let waiting = runtime.spawn({
        let peer = peer.clone();
        async move {
            let mut parameters = number(5);
            peer.call("hang", &mut parameters).with(patient()).await
        }
    });
    until("it runs", || gate.came() == 1);
    manager.stop();
    assert_eq!(runtime.block_on(waiting).unwrap(), Err(Error::Interrupted.into()));
    gate.open();
}

#[test]
fn a_future_waits_for_the_interval_within_its_deadline() {
    let (manager, agv) = pair();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let interval = cara_std::Duration::from_millis(800);
    let set = |minimum_interval| {
        peer.set_constraints(Constraints { minimum_interval, ..peer.constraints() }).unwrap();
    };
    set(interval);
    let sent = || counter(&peer.counters(), "RequestsSent");
    runtime().block_on(async {
        let began = Instant::now();
        assert_eq!(echo(&peer, 1).await, Ok(1));
        assert_eq!(echo(&peer, 2).await, Ok(2));
        assert!(began.elapsed() >= interval.into(), "{:?}", began.elapsed());
        // Longer than a thread waits for its turn, or the third call would not come too soon.
        set(cara_std::Duration::from_secs(60));
        let mut parameters = number(3);
        let refused = peer.call("echo", &mut parameters).with(within_millis(20)).await.map_err(Error::from);
        assert!(matches!(refused, Err(Error::TooSoon { .. })), "{refused:?}");
        assert_eq!((sent(), counter(&agv.manager().unwrap().counters(), "RequestsRun")), (2, 2));
        // Dropped while it waits, it is never sent. It does not wait if the machine has stood still for the interval.
        let mut has_waited = false;
        while !has_waited {
            assert!(began.elapsed() < 3 * PATIENCE, "not in time: a call waits for the interval");
            set(cara_std::Duration::ZERO);
            let last = Instant::now();
            assert_eq!(echo(&peer, 4).await, Ok(4));
            set(interval);
            let before = sent();
            let mut pending = peer.call("echo", &mut parameters).with(patient()).into_future();
            let polled = once(&mut pending).await;
            has_waited = last.elapsed() < interval.into();
            drop(pending);
            tokio::time::sleep(Duration::from_millis(1_200)).await;
            assert!(!has_waited || (polled.is_none() && sent() == before), "{polled:?} {} {before}", sent());
        }
    });
}

#[test]
fn calls_to_all_have_an_outcome_each_and_are_given_up_when_they_are_dropped() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agvs = [1, 2, 3].map(|id| unit(&format!("agv{id}"), id, fleet).build().unwrap());
    let gate = Arc::new(Gate::default());
    for (index, agv) in agvs.iter().enumerate() {
        agv.my_function_list().add_function("hang", &number(0), held(&gate)).unwrap();
        let fails = move |parameters: Parameters| match index {
            2 => panic!("this one fails"),
            _ => parameters,
        };
        agv.my_function_list().add_function("echo", &number(0), fails).unwrap();
        meet(&manager, agv);
    }
    crate::support::retire_absent(&manager);
    runtime().block_on(async {
        let outcomes = manager.call_all("echo", &number(4)).with(patient()).await;
        let mut outcomes: Vec<_> =
            outcomes.into_iter().map(|(peer, outcome)| (peer.id(), outcome.map(|results| value(&results)))).collect();
        outcomes.sort_by_key(|(id, _)| *id);
        assert_eq!(outcomes, [(1, Ok(4)), (2, Ok(4)), (3, Err(Error::Service(ServiceError::Panicked).into()))]);
        let (parameters, options) = (number(4), patient());
        let all = manager.call_all("hang", &parameters).with(options);
        assert!(tokio::time::timeout(Duration::from_millis(100), all.into_future()).await.is_err());
    });
    let cancelled = |peer: &Peer| counter(&peer.counters(), "CallsCancelled");
    assert!(manager.s_units().iter().all(|peer| cancelled(peer) == 1));
    gate.open();
}

/// A method holds the manager's state and waits for the vehicle, whose service calls a method of the manager.
#[test]
fn a_method_that_waits_for_a_future_is_told_at_once_of_a_call_that_waits_for_it() {
    let fleet = fleet();
    let manager = system(fleet).state(0_i64).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    let back: Arc<std::sync::OnceLock<Peer>> = Arc::default();
    let there = back.clone();
    let forwards = move |mut parameters: Parameters| {
        let there = there.clone();
        async move {
            let asked = there.get().unwrap().call("last", &mut parameters).with(patient()).await;
            if asked == Err(Error::WouldDeadlock.into()) {
                parameters.set_value("number", -1).unwrap();
            }
            parameters
        }
    };
    manager.my_function_list().add_function("last", &number(0), |_: &mut i64, p: Parameters| p).unwrap();
    agv.my_function_list().add_function("forwards", &number(0), forwards).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager.clone()).is_ok());
    let runtime = runtime();
    let one = || {
        let mut parameters = number(4);
        let asked = peer.call("forwards", &mut parameters).with(patient());
        runtime.block_on(asked.into_future()).map(|()| value(&parameters)).map_err(Error::from)
    };
    let all = || {
        let outcomes = manager.call_all("forwards", &number(4)).with(patient()).wait();
        outcomes
            .iter()
            .find(|(asked, _)| asked.id() == 7)
            .map(|(_, outcome)| outcome.as_ref().map(|p| value(p)).unwrap())
    };
    assert_eq!((one(), all()), (Ok(4), Some(4)), "the manager's state is free");
    assert_eq!(manager.with_state(|_| one()), Ok(Ok(-1)));
    assert_eq!(manager.with_state(|_| all()), Ok(Some(-1)));
    assert_eq!(one(), Ok(4), "no mark is left");
    agv.stop();
}
