//! Services whose handlers are futures.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use cara_std::{
    CallError, Definition, Error, Parameters, ParametersView, Peer, Priority, Renew, RequestOptions, Served,
    ServiceError, ServiceOptions, Unit,
};

use super::{once, patient, runtime, within_millis};
use crate::support::{Gate, PATIENCE, ask, counter, fleet, held, meet, number, pair, system, unit, until, value};

/// How many handlers are inside, and how many have been dropped before their end.
#[derive(Default)]
struct Seen {
    inside: AtomicUsize,
    most: AtomicUsize,
    dropped: AtomicUsize,
    reported: AtomicUsize,
}

/// A handler that is inside.
struct Inside(Arc<Seen>, bool);

impl Inside {
    fn new(seen: &Arc<Seen>) -> Self {
        let inside = seen.inside.fetch_add(1, Ordering::SeqCst) + 1;
        seen.most.fetch_max(inside, Ordering::SeqCst);
        Self(seen.clone(), false)
    }

    /// It ends by itself.
    fn end(mut self) {
        self.1 = true;
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        self.0.inside.fetch_sub(1, Ordering::SeqCst);
        self.0.dropped.fetch_add(usize::from(!self.1), Ordering::SeqCst);
    }
}

pub(super) fn run_on<T: Send + 'static>(agv: &Unit<T>, runtime: &tokio::runtime::Runtime) {
    let runtime = runtime.handle().clone();
    agv.run_services_on(move |task| drop(runtime.spawn(task)));
}

fn definition(name: &str) -> Definition {
    format!("{name}(number: int) -> (number: int)").parse().unwrap()
}

#[test]
fn each_form_of_a_handler_answers() {
    let (manager, agv) = pair();
    let list = agv.my_function_list();
    async fn plain(mut parameters: Parameters) -> Parameters {
        parameters.set_value("number", 10 * value(&parameters)).unwrap();
        parameters
    }
    async fn checked(call: Served, parameters: Parameters) -> Result<Parameters, ServiceError> {
        assert_eq!(call.caller.name(), "manager");
        tokio::task::yield_now().await;
        if value(&parameters) == 0 { Err(ServiceError::Failed(3)) } else { Ok(parameters) }
    }
    list.add_function("plain", &number(0), plain).unwrap();
    list.add_function("checked", &number(0), checked).unwrap();
    let any_size = |_: Served, mut view: Box<ParametersView>| async move {
        let twice = 2 * value(&view);
        view.set_value("number", twice)?;
        Ok(view)
    };
    list.add_service(&definition("any_size"), ServiceOptions::new().idempotent(), any_size).unwrap();
    let panics = |_: Served, parameters: Parameters| async move {
        if value(&parameters) == 1 {
            panic!("a handler")
        }
        Ok(parameters)
    };
    list.add_function("panics", &number(0), panics).unwrap();
    // No executor is named: a thread of the unit runs them.
    let (peer, _) = meet(&manager, &agv);
    assert_eq!(ask(&peer, "plain", 7), Ok(70));
    assert_eq!(ask(&peer, "checked", 7), Ok(7));
    assert_eq!(ask(&peer, "checked", 0), Err(Error::Service(ServiceError::Failed(3))));
    assert_eq!(ask(&peer, "any_size", 7), Ok(14));
    assert_eq!(ask(&peer, "panics", 1), Err(Error::Service(ServiceError::Panicked)));
    assert_eq!(ask(&peer, "panics", 2), Ok(2));
    let emergency = ServiceOptions::new().priority(Priority::Emergency);
    assert_eq!(list.add_service(&definition("stop"), emergency, plain).err(), Some(Error::EmergencyWaits));
}

/// There are 16 threads, and more calls than that wait in their handlers at the same time.
#[test]
fn handlers_that_wait_hold_no_thread() {
    const CALLERS: usize = 8;
    const EACH: usize = 8;
    let fleet = fleet();
    let runtime = runtime();
    let manager = system(fleet).build().unwrap();
    let seen: Arc<Seen> = Arc::default();
    let inside = seen.clone();
    let wait = move |parameters: Parameters| {
        let guard = Inside::new(&inside);
        async move {
            let all = |guard: &Inside| guard.0.most.load(Ordering::SeqCst) == CALLERS * EACH;
            while !all(&guard) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            guard.end();
            parameters
        }
    };
    manager.my_function_list().add_function("wait", &number(0), wait).unwrap();
    let handle = runtime.handle().clone();
    manager.run_services_on(move |task| drop(handle.spawn(task)));
    let agvs: Vec<_> = (1..=CALLERS as u32).map(|id| unit(&format!("agv{id}"), id, fleet).build().unwrap()).collect();
    let peers: Vec<Peer> = agvs.iter().map(|agv| meet(&manager, agv).1).collect();
    runtime.block_on(async {
        let calls: Vec<_> = peers
            .iter()
            .flat_map(|peer| (0..EACH as i64).map(move |number| (peer.clone(), number)))
            .map(|(peer, number_in)| {
                tokio::spawn(async move {
                    let mut parameters = number(number_in);
                    peer.call("wait", &mut parameters).with(patient()).await.map(|()| value(&parameters))
                })
            })
            .collect();
        for (index, call) in calls.into_iter().enumerate() {
            assert_eq!(call.await.unwrap(), Ok((index % EACH) as i64));
        }
    });
    assert_eq!(seen.dropped.load(Ordering::SeqCst), 0);
}

/// A vehicle whose `drive` moves under a lease and whose `wait` does not; both wait for ever.
fn waiting(agv: &Unit, reported: bool) -> Arc<Seen> {
    let seen: Arc<Seen> = Arc::default();
    let options = || if reported { ServiceOptions::new().runs_to_its_end() } else { ServiceOptions::new() };
    let handler = |seen: &Arc<Seen>| {
        let seen = seen.clone();
        move |call: Served, parameters: Parameters| {
            let guard = Inside::new(&seen);
            async move {
                call.given_up().await;
                guard.0.reported.fetch_add(1, Ordering::SeqCst);
                guard.end();
                Ok(parameters)
            }
        }
    };
    let list = agv.my_function_list();
    list.add_service(&definition("wait"), options(), handler(&seen)).unwrap();
    let leased = options().lease(Duration::from_secs(5), || {});
    list.add_service(&definition("drive"), leased, handler(&seen)).unwrap();
    seen
}

/// The callback is let go by nobody, and has an hour by itself. What is asked after the caller's time has a time of its own.
#[test]
fn a_call_that_a_future_makes_ends_with_its_callers_deadline() {
    let (manager, agv) = pair();
    let runtime = runtime();
    run_on(&agv, &runtime);
    let (gate, back): (Arc<Gate>, Arc<OnceLock<Peer<()>>>) = Default::default();
    let (there, (told, outcomes)) = (back.clone(), channel());
    let asks_back = move |call: Served, parameters: Parameters| {
        let (there, told) = (there.clone(), told.clone());
        async move {
            let manager = there.get().unwrap();
            let hour = Duration::from_secs(3_600);
            let ended = manager.call("mine", &mut number(1)).timeout(hour).await;
            call.given_up().await;
            let later = manager.call("echo", &mut number(1)).with(patient()).await;
            let _ = told.send((ended.map_err(Error::from), later.map_err(Error::from)));
            Ok(parameters)
        }
    };
    let options = ServiceOptions::new().runs_to_its_end();
    agv.my_function_list().add_service(&definition("asks_back"), options, asks_back).unwrap();
    manager.my_function_list().add_function("mine", &number(0), held(&gate)).unwrap();
    manager.my_function_list().add_function("echo", &number(0), |parameters: Parameters| parameters).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.set(to_manager).is_ok());
    let _ = peer.call("asks_back", &mut number(1)).with(within_millis(500)).wait();
    assert_eq!(outcomes.recv_timeout(PATIENCE / 2), Ok((Err(Error::TimedOut), Ok(()))));
    gate.open();
}

#[test]
fn a_handler_whose_call_is_given_up_is_dropped_or_told() {
    for reported in [false, true] {
        let (manager, agv) = pair();
        let runtime = runtime();
        run_on(&agv, &runtime);
        let seen = waiting(&agv, reported);
        let (peer, _) = meet(&manager, &agv);
        let ended = |count: usize| {
            until("the handler has ended", || seen.inside.load(Ordering::SeqCst) == 0);
            let counts = [&seen.dropped, &seen.reported].map(|seen| seen.load(Ordering::SeqCst));
            assert_eq!(counts, if reported { [0, count] } else { [count, 0] });
        };
        let inside = || until("it is inside", || seen.inside.load(Ordering::SeqCst) == 1);
        // Its caller's time is over.
        let outcome = runtime.block_on(async {
            let mut parameters = number(1);
            peer.call("wait", &mut parameters).with(within_millis(300)).await
        });
        // One that is told may answer before its caller has looked at the time.
        assert!(
            matches!(outcome, Err(CallError { error: Error::TimedOut | Error::Expired, .. })) || reported,
            "{outcome:?}"
        );
        ended(1);
        // Its caller has given its order up.
        let mut parameters = number(1);
        let wanted = RequestOptions { renew: Renew::Process, ..patient() };
        let mut call = peer.call("drive", &mut parameters).with(wanted).into_future();
        assert_eq!(runtime.block_on(once(&mut call)), None);
        inside();
        drop(call);
        ended(2);
        // Its caller is gone. This one was never waited for.
        peer.request("wait", &number(1)).unwrap();
        inside();
        manager.stop();
        ended(3);
        // All slots are free, and the unit ends.
        agv.stop();
    }
}

#[test]
fn calls_of_an_executor_that_ends_are_answered() {
    let (manager, agv) = pair();
    let executor = runtime();
    run_on(&agv, &executor);
    let seen = waiting(&agv, false);
    let (peer, _) = meet(&manager, &agv);
    let own = runtime();
    let running = own.spawn({
        let peer = peer.clone();
        async move { peer.call("wait", &mut number(1)).with(patient()).await }
    });
    until("it is inside", || seen.inside.load(Ordering::SeqCst) == 1);
    executor.shutdown_background();
    assert_eq!(own.block_on(running).unwrap(), Err(Error::Service(ServiceError::NotReady).into()));
    // One that it does not even take.
    assert_eq!(ask(&peer, "wait", 1), Err(Error::Service(ServiceError::NotReady)));
    assert_eq!(counter(&peer.counters(), "CallsTimedOut"), 0);
}

/// A vehicle's service awaits one of the manager, which awaits another one of the vehicle, which asks for its state.
#[test]
fn services_that_wait_call_each_other_back() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(0_i64).build().unwrap());
    let back: Arc<(OnceLock<Peer>, OnceLock<Peer<i64>>)> = Arc::default();
    let there = back.clone();
    let outer = move |mut parameters: Parameters| {
        let there = there.clone();
        async move {
            there.1.get().unwrap().call("middle", &mut parameters).with(patient()).await.unwrap();
            parameters
        }
    };
    let there = back.clone();
    let middle = move |mut parameters: Parameters| {
        let there = there.clone();
        async move {
            there.0.get().unwrap().call("inner", &mut parameters).with(patient()).await.unwrap();
            parameters
        }
    };
    let weak = agv.downgrade();
    let inner = move |mut parameters: Parameters| {
        let agv = weak.upgrade().unwrap();
        async move {
            let count = agv.with_state_async(|state| {
                *state += 1;
                *state
            });
            parameters.set_value("number", count.await.unwrap()).unwrap();
            parameters
        }
    };
    agv.my_function_list().add_function("outer", &number(0), outer).unwrap();
    agv.my_function_list().add_function("inner", &number(0), inner).unwrap();
    manager.my_function_list().add_function("middle", &number(0), middle).unwrap();
    let (peer, to_manager) = meet(&manager, &agv);
    assert!(back.0.set(peer.clone()).is_ok() && back.1.set(to_manager).is_ok());
    for count in 1..=50 {
        assert_eq!(ask(&peer, "outer", 0), Ok(count));
    }
    agv.stop();
}

/// A turn that is given up, and one that comes while another thread has the state.
#[test]
fn the_state_is_waited_for_in_turn() {
    let agv = unit("agv", 7, fleet()).state(0_i64).build().unwrap();
    let runtime = runtime();
    let ((opened, gate), (entered, inside)) = (std::sync::mpsc::channel(), std::sync::mpsc::channel());
    let holder = std::thread::spawn({
        let agv = agv.clone();
        move || {
            agv.with_state(|state| {
                entered.send(()).unwrap();
                gate.recv().unwrap();
                *state += 1;
            })
        }
    });
    inside.recv().unwrap();
    runtime.block_on(async {
        let given_up =
            tokio::time::timeout(Duration::from_millis(30), agv.with_state_async(|state| *state += 10)).await;
        assert!(given_up.is_err());
        let waiting = tokio::spawn({
            let agv = agv.clone();
            async move { agv.with_state_async(|state| *state += 100).await }
        });
        tokio::time::sleep(Duration::from_millis(30)).await;
        opened.send(()).unwrap();
        assert_eq!(waiting.await.unwrap(), Ok(()));
    });
    assert_eq!(holder.join().unwrap(), Ok(()));
    assert_eq!(agv.with_state(|state| *state), Ok(101));
    let nested = agv.with_state(|_| runtime.block_on(agv.with_state_async(|state| *state)));
    assert_eq!(nested, Ok(Err(Error::WouldDeadlock)));
}
