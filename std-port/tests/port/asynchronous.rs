//! Requests as futures, on tokio.

use std::sync::Arc;
use std::time::Duration;

use cara_std::{Error, Peer, RequestOptions};

use crate::support::{Gate, ask, counter, held, meet, number, pair, service, until, value};

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_time().build().unwrap()
}

fn patient() -> RequestOptions {
    RequestOptions { timeout: Some(cara_std::Duration::from_secs(20)), ..Default::default() }
}

async fn echo(peer: &Peer, number_in: i64) -> Result<i64, Error> {
    let mut parameters = number(number_in);
    peer.request_async("echo", &mut parameters, &patient())?.await.map(|()| value(&parameters))
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
        let refused = peer.request_async("no_such", &mut number(1), &patient()).err();
        assert_eq!(refused, Some(Error::UnknownFunction));
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
                            // There are fewer slots than tasks, here and there.
                            Err(Error::Full(_) | Error::Busy) => tokio::task::yield_now().await,
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
        let options = RequestOptions { timeout: Some(cara_std::Duration::from_millis(30)), ..Default::default() };
        let mut parameters = number(5);
        let outcome = peer.request_async("hang", &mut parameters, &options).unwrap().await;
        assert_eq!((outcome, value(&parameters)), (Err(Error::TimedOut), 5));
        // More than there are slots, each given up before its reply.
        for _ in 0..300 {
            let mut parameters = number(5);
            let pending = peer.request_async("hang", &mut parameters, &options).unwrap();
            match tokio::time::timeout(Duration::ZERO, pending).await {
                Err(_) => {}
                Ok(outcome) => assert_eq!(outcome, Err(Error::Busy), "the peer refuses those beyond its own limit"),
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
            peer.request_async("hang", &mut parameters, &patient())?.await
        }
    });
    until("it runs", || gate.came() == 1);
    manager.stop();
    assert_eq!(runtime.block_on(waiting).unwrap(), Err(Error::Interrupted));
    gate.open();
}
