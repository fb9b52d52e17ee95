//! Interfaces with `async fn`.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use cara_std::{
    Actuator, AnyCall, AsyncState, CommunicationSystem, Error, LeaseWatch, Peer, Priority, Renew, ServiceError,
    TypedCall, Unit, Variables, interface,
};

use super::services::run_on;
use super::{patient, runtime};
use crate::support::{fleet, meet, system, unit, until};
use crate::typed::{Blocked, Left};

#[derive(Variables, Clone, Copy, Debug, Default, PartialEq)]
struct Load {
    kilograms: u16,
}

#[interface]
trait Crane {
    #[idempotent]
    async fn load(state: &impl AsyncState<Self>) -> Result<Load, ServiceError>;

    async fn hang(state: &impl AsyncState<Self>, #[variables] load: Load) -> Result<(), ServiceError>;

    /// Ends when something hangs on it.
    async fn wait(state: &impl AsyncState<Self>, call: &impl AnyCall) -> Result<(), ServiceError>;

    #[name = "say-hello"]
    #[priority(high)]
    #[returns(#[size(32)] text, length)]
    async fn greet(#[size(16)] name: &str) -> (String, u64) {
        tokio::task::yield_now().await;
        (format!("hello {name}"), name.len() as u64)
    }

    /// Does not arrive from 11 with what is hung on it, never ends from 0, and commits from 5 when its order has ended.
    #[actuator(motor)]
    #[lease(ms = 60_000)]
    async fn lift(
        call: &impl TypedCall<Left, Blocked, Order = LeaseWatch>,
        state: &impl AsyncState<Self>,
        from: u32,
    ) -> Result<(), ServiceError>;

    #[priority(emergency)]
    #[actuator(motor)]
    #[stop]
    fn halt();

    #[returns(waiting)]
    fn waiting(&self) -> u32;
}

#[derive(Default)]
struct Hook {
    load: Load,
    waiting: u32,
    lifted: u32,
    ended: Arc<AtomicUsize>,
}

/// Counts what has ended, or has been dropped.
struct Inside(Arc<AtomicUsize>);

impl Drop for Inside {
    fn drop(&mut self) {
        self.0.fetch_add(1, Ordering::SeqCst);
    }
}

/// Ends when something hangs on it.
async fn loaded(state: &impl AsyncState<Hook>) -> Result<(), ServiceError> {
    while state.with(|hook| hook.load.kilograms == 0).await? {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    Ok(())
}

impl Crane for Hook {
    async fn load(state: &impl AsyncState<Self>) -> Result<Load, ServiceError> {
        state.with(|hook| hook.load).await
    }

    async fn hang(state: &impl AsyncState<Self>, load: Load) -> Result<(), ServiceError> {
        state.with(|hook| hook.load = load).await
    }

    async fn wait(state: &impl AsyncState<Self>, call: &impl AnyCall) -> Result<(), ServiceError> {
        state.with(|hook| hook.waiting += 1).await?;
        loaded(state).await?;
        assert_eq!(call.caller().name(), "manager");
        Ok(())
    }

    async fn lift(
        call: &impl TypedCall<Left, Blocked, Order = LeaseWatch>,
        state: &impl AsyncState<Self>,
        from: u32,
    ) -> Result<(), ServiceError> {
        let _inside = Inside(state.with(|hook| hook.ended.clone()).await?);
        let order = call.order().expect("it has a lease");
        assert!(order.is_live());
        call.progress(&Left { left: from })?;
        if from == 5 {
            order.wait_until_ended();
        }
        state.commit(|hook| hook.lifted = from).await?;
        match from {
            0 => std::future::pending().await,
            11 => {
                loaded(state).await?;
                Err(call.fail_with(7, "the way is blocked", &Blocked { at: [3, -4] }))
            }
            _ => Ok(()),
        }
    }

    fn halt() {}

    fn waiting(&self) -> u32 {
        self.waiting
    }
}

/// A crane and its motor's order, and a manager that has met it.
fn pair_with_crane() -> (CommunicationSystem, Peer, Unit<Hook>, LeaseWatch) {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let crane = unit("agv", 7, fleet).state(Hook::default()).build().unwrap();
    let motor: Actuator = crane.my_function_list().actuator(|| ()).unwrap();
    let order = motor.watch();
    crane.my_function_list().serve(CraneServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &crane);
    (manager, peer, crane, order)
}

/// No executor is named: a thread of the unit runs them.
#[test]
fn an_async_fn_answers_threads_and_tasks() {
    let (manager, peer, crane, _) = pair_with_crane();
    let client = CraneClient::at(&peer);
    assert_eq!(client.greet("crane").wait(), Ok(("hello crane".to_owned(), 5)));
    assert_eq!(client.load().wait(), Ok(Load::default()));
    assert_eq!(client.hang(Load { kilograms: 900 }).wait(), Ok(()));
    runtime().block_on(async {
        let client = CraneClient::at(&peer);
        assert_eq!(client.load().await, Ok(Load { kilograms: 900 }));
        assert_eq!(client.greet("task").await, Ok(("hello task".to_owned(), 4)));
        assert_eq!(client.wait().await, Ok(()), "it has no reason to");
    });
    assert_eq!(crane.with_state(|hook| hook.load), Ok(Load { kilograms: 900 }));
    let [load, greet, lift] = ["load", "say-hello", "lift"].map(|name| peer.function(name).unwrap());
    assert!(load.attributes.idempotent && !greet.attributes.idempotent);
    assert_eq!((load.attributes.priority, greet.attributes.priority), (Priority::Normal, Priority::High));
    assert_eq!(greet.definition.to_string(), "say-hello(name: string[16]) -> (text: string[32], length: int)");
    assert_eq!(lift.definition.to_string(), "lift(from: int) progress (left: int) fails (at: int[2])");
    assert!(lift.attributes.lease.is_some());
    manager.stop();
    crane.stop();
}

#[test]
fn an_async_fn_waits_while_others_are_answered() {
    let (manager, peer, crane, _) = pair_with_crane();
    let runtime = runtime();
    run_on(&crane, &runtime);
    let waiting = runtime.spawn({
        let peer = peer.clone();
        async move { CraneClient::at(&peer).with(patient()).wait().await }
    });
    let client = CraneClient::at(&peer);
    until("it waits", || client.waiting().wait() == Ok(1));
    assert_eq!(client.load().wait(), Ok(Load::default()));
    assert!(!waiting.is_finished());
    assert_eq!(client.hang(Load { kilograms: 1 }).wait(), Ok(()));
    assert_eq!(runtime.block_on(waiting).unwrap(), Ok(()));
    manager.stop();
    crane.stop();
}

#[test]
fn an_async_fn_tells_progress_and_why_it_failed() {
    let (manager, peer, crane, _) = pair_with_crane();
    let runtime = runtime();
    run_on(&crane, &runtime);
    let client = CraneClient::at(&peer).with(patient());
    let failed = client
        .lift(11)
        .watch(|left| {
            assert_eq!(left, Left { left: 11 });
            client.hang(Load { kilograms: 900 }).send().unwrap();
            ControlFlow::Continue(())
        })
        .wait();
    let failed = failed.unwrap_err();
    assert_eq!((failed.text(), failed.values()), ("the way is blocked", Some(Blocked { at: [3, -4] })));
    assert_eq!(failed.error, Error::Service(ServiceError::Failed(7)));
    runtime.block_on(async {
        let client = CraneClient::at(&peer);
        let failed = client.lift(11).watch(|_| ControlFlow::Continue(())).await.unwrap_err();
        assert_eq!(failed.to_string(), "the way is blocked (code 7)");
        assert_eq!(client.lift(3).watch(|_| ControlFlow::Continue(())).await, Ok(()));
    });
    assert_eq!(crane.with_state(|hook| hook.lifted), Ok(3));
    manager.stop();
    crane.stop();
}

/// As every handler that is a future, it is dropped when nothing wants its call any more.
#[test]
fn an_async_fn_is_dropped_with_its_order() {
    let (manager, peer, crane, order) = pair_with_crane();
    let ended = crane.with_state(|hook| hook.ended.clone()).unwrap();
    let ended_are = |count| until("it is dropped", || ended.load(Ordering::SeqCst) == count && !order.is_live());
    runtime().block_on(async {
        let client = CraneClient::at(&peer).with(patient()).renewing(Renew::Process);
        let failed = client.lift(0).watch(|_| ControlFlow::Break(())).await.unwrap_err();
        assert_eq!(failed.error, Error::Cancelled);
        ended_are(1);
        // Stopped while it waits.
        let stopping = |_| {
            assert!(order.is_live());
            CraneClient::at(&peer).halt().send().unwrap();
            ControlFlow::Continue(())
        };
        let failed = client.lift(0).watch(stopping).await.unwrap_err();
        assert_eq!(failed.error, Error::Expired);
        ended_are(2);
    });
    manager.stop();
    drop(crane);
    until("the unit is gone", || Arc::strong_count(&ended) == 1);
}

#[test]
fn an_async_fn_commits_nothing_behind_the_end_of_its_order() {
    let (manager, peer, crane, _) = pair_with_crane();
    let client = CraneClient::at(&peer).with(patient());
    let stopping = |Left { left }| {
        assert_eq!(left, 5);
        client.halt().send().unwrap();
        ControlFlow::Continue(())
    };
    assert!(client.lift(5).watch(stopping).wait().is_err());
    until("it has ended", || crane.with_state(|hook| hook.ended.load(Ordering::SeqCst)) == Ok(1));
    assert_eq!(crane.with_state(|hook| hook.lifted), Ok(0));
    manager.stop();
    crane.stop();
}
