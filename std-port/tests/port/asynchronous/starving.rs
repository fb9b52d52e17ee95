//! Nothing blocks the thread of a runtime. On a runtime of one thread, one task waits, and what it waits for is brought
//! about by another: were the thread blocked, the wait would end with an error, at its deadline.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use cara_std::{Error, RequestOptions, ServiceOptions, UnitEvent};

use super::{patient, within_millis};
use crate::support::{Gate, fleet, held, meet, number, pair, retire_absent, service, system, unit, value};

/// Longest wait; what blocks would block for so long.
const LIMIT: Duration = Duration::from_secs(30);

/// Runs `waits` on one thread with a second task that ticks a few times and then does what ends the wait.
pub(super) fn beside<R>(waits: impl Future<Output = R>, brings_about: impl FnOnce() + Send + 'static) -> R {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let ticks = Arc::new(AtomicUsize::new(0));
    let ticked = ticks.clone();
    runtime.block_on(async move {
        let other = tokio::spawn(async move {
            for _ in 0..10 {
                tokio::time::sleep(Duration::from_millis(2)).await;
                ticked.fetch_add(1, Ordering::SeqCst);
            }
            brings_about();
        });
        let outcome = tokio::time::timeout(LIMIT, waits).await.expect("it ends by itself");
        assert!(ticks.load(Ordering::SeqCst) > 0, "the other task has had a turn meanwhile");
        other.await.unwrap();
        outcome
    })
}

#[test]
fn calls_starve_no_other_task() {
    let (manager, agv) = pair();
    let gates: [Arc<Gate>; 3] = Default::default();
    for (index, gate) in gates.iter().enumerate() {
        agv.my_function_list().add_function(&format!("hang{index}"), &number(0), held(gate)).unwrap();
    }
    let (peer, _) = meet(&manager, &agv);
    retire_absent(&manager);
    let [one, all, kept] = gates.map(|gate| move || gate.open());
    let mut parameters = number(5);
    let call = async { peer.call("hang0", &mut parameters).with(within_millis(25_000)).await };
    assert_eq!(beside(call, one), Ok(()));
    let outcomes = beside(manager.call_all("hang1", &number(4)).with(within_millis(25_000)).into_future(), all);
    assert_eq!(outcomes.iter().map(|(_, outcome)| outcome.as_ref().map(|p| value(p))).collect::<Vec<_>>(), [Ok(4)]);
    let mut parameters = number(1);
    let held = peer.call("hang2", &mut parameters).with(within_millis(25_000)).hold();
    assert!(beside(held.into_future(), kept).is_ok());
}

/// One that blocks does starve the other: the check can fail.
#[test]
fn a_call_that_blocks_starves_the_other_task() {
    let (manager, agv) = pair();
    let gate: Arc<Gate> = Arc::default();
    agv.my_function_list().add_function("hang", &number(0), held(&gate)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let open = gate.clone();
    let blocked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        let call = async { peer.call("hang", &mut number(5)).with(within_millis(300)).wait() };
        beside(call, move || open.open())
    }));
    gate.open();
    assert!(blocked.is_err(), "{blocked:?}");
}

#[test]
fn waits_for_nodes_functions_events_and_the_state_starve_no_other_task() {
    let fleet = fleet();
    let manager = system(fleet).state(0_i64).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    let mut events = manager.events_async();
    assert_eq!(beside(manager.start_async(), || ()).map_err(|error| error.to_string()), Ok(()));
    let starts = agv.clone();
    let peer = beside(manager.wait_for_s_unit_async("agv"), move || starts.start().unwrap()).unwrap();
    let publishes = agv.clone();
    let adds = move || {
        publishes.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
        publishes.publish_my_function_list().unwrap();
    };
    assert_eq!(beside(peer.wait_for_function_async("echo"), adds), Ok(()));
    let (opened, gate) = std::sync::mpsc::channel();
    let (entered, inside) = std::sync::mpsc::channel();
    let holds = manager.clone();
    let holder = std::thread::spawn(move || {
        holds.with_state(|_| {
            entered.send(()).unwrap();
            gate.recv_timeout(LIMIT).unwrap();
        })
    });
    inside.recv().unwrap();
    assert_eq!(beside(manager.with_state_async(|state| *state), move || opened.send(()).unwrap()), Ok(0));
    holder.join().unwrap().unwrap();
    let stops = agv.clone();
    let left = async {
        loop {
            if let Some(Ok(UnitEvent::Left { peer, .. })) = events.next().await {
                return peer;
            }
        }
    };
    assert_eq!(beside(left, move || stops.stop()), agv.identity());
}

/// One task is the vehicle's service, and the other one its caller.
#[test]
fn a_service_that_waits_and_its_caller_share_a_thread() {
    let (manager, agv) = pair();
    let opens = Arc::new(AtomicUsize::new(0));
    let opened = opens.clone();
    let waits = move |parameters: cara_std::Parameters| {
        let opened = opened.clone();
        async move {
            while opened.load(Ordering::SeqCst) == 0 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            parameters
        }
    };
    agv.my_function_list().add_function("waits", &number(0), waits).unwrap();
    let definition = "leased(number: int) -> (number: int)".parse().unwrap();
    let ends = |call: cara_std::Served, parameters: cara_std::Parameters| async move {
        call.lease_ended().await;
        Ok(parameters)
    };
    let leased = ServiceOptions::new().lease(Duration::from_millis(200), || {});
    agv.my_function_list().add_service(&definition, leased, ends).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let mut parameters = number(5);
    let called = async {
        let runtime = tokio::runtime::Handle::current();
        agv.run_services_on(move |task| drop(runtime.spawn(task)));
        peer.call("waits", &mut parameters).with(within_millis(25_000)).await
    };
    assert_eq!(beside(called, move || opens.store(1, Ordering::SeqCst)), Ok(()));
    let unrenewed = RequestOptions { renew: cara_std::Renew::Never, ..patient() };
    let called = async {
        let runtime = tokio::runtime::Handle::current();
        agv.run_services_on(move |task| drop(runtime.spawn(task)));
        peer.call("leased", &mut number(1)).with(unrenewed).await
    };
    // The order ends by itself, and with it the handler.
    assert_eq!(beside(called, || ()), Err(Error::Expired.into()));
}
