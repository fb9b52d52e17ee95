//! The end of a call's hold of its service's lease, awaited by a thread and by a task.

use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cara_std::{
    CommunicationSystem, LeaseWatch, ParametersView, Peer, Renew, RequestOptions, Served, ServiceError, ServiceOptions,
    Unit,
};

use crate::support::{PATIENCE, meet, number, pair, value};

/// Beyond all patience: what is seen to end has not ended by time.
const LONG: Duration = PATIENCE.saturating_mul(4);
const SHORT: Duration = Duration::from_millis(800);

struct Vehicle {
    manager: CommunicationSystem,
    agv: Unit,
    peer: Peer,
    /// The number of each call whose end has been awaited, once by a thread and once by a task.
    ended: Receiver<i64>,
    /// The order of each call.
    orders: Arc<Mutex<Vec<LeaseWatch>>>,
}

/// A vehicle whose service answers at once, and leaves a thread and a task to await the end of what it started.
fn vehicle(length: Duration) -> Vehicle {
    let (manager, agv) = pair();
    let (notify, ended) = channel();
    let orders = Arc::<Mutex<Vec<LeaseWatch>>>::default();
    let started = orders.clone();
    let go = move |call: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
        let (number, lease, end) = (value(parameters), call.lease.clone().unwrap(), call.lease_ended());
        let (thread, task) = (notify.clone(), notify.clone());
        started.lock().unwrap().push(lease.clone());
        std::thread::spawn(move || {
            lease.wait_until_ended();
            let _ = thread.send(number);
        });
        std::thread::spawn(move || {
            tokio::runtime::Builder::new_current_thread().build().unwrap().block_on(end);
            let _ = task.send(number);
        });
        Ok(())
    };
    let definition = "go(number: int)".parse().unwrap();
    agv.my_function_list().add_service(&definition, ServiceOptions::new().lease(length, || {}), go).unwrap();
    let (peer, _) = meet(&manager, &agv);
    Vehicle { manager, agv, peer, ended, orders }
}

impl Vehicle {
    fn go(&self, call: i64, renew: Renew) {
        let timeout = Some(cara_std::Duration::from_secs(20));
        let options = RequestOptions { renew, timeout, ..Default::default() };
        self.peer.call("go", &mut number(call)).with(options).wait().unwrap();
    }

    /// The thread and the task have awaited the end of this call, and of no other.
    #[track_caller]
    fn assert_ended(&self, call: i64) {
        let ended = [(); 2].map(|()| self.ended.recv_timeout(PATIENCE).expect("the end was not told"));
        assert_eq!(ended, [call; 2]);
    }

    #[track_caller]
    fn assert_none_ended(&self) {
        assert_eq!(self.ended.recv_timeout(Duration::from_millis(300)), Err(RecvTimeoutError::Timeout));
    }
}

#[test]
fn the_end_of_a_call_that_is_replaced_is_told_and_that_of_the_newer_is_not() {
    let vehicle = vehicle(LONG);
    vehicle.go(1, Renew::Process);
    vehicle.assert_none_ended();
    vehicle.go(2, Renew::Process);
    vehicle.assert_ended(1);
    vehicle.assert_none_ended();
    vehicle.peer.release("go").unwrap();
    vehicle.assert_ended(2);
}

#[test]
fn the_end_by_time_alone_is_told() {
    let vehicle = vehicle(SHORT);
    vehicle.go(1, Renew::Never);
    vehicle.assert_ended(1);
    assert!(vehicle.peer.is_connected());
}

#[test]
fn the_end_of_what_has_finished_is_told() {
    let vehicle = vehicle(LONG);
    vehicle.go(1, Renew::Process);
    let first = vehicle.orders.lock().unwrap()[0].clone();
    vehicle.go(2, Renew::Process);
    vehicle.assert_ended(1);
    assert!(!vehicle.agv.end_order(&first), "it was replaced");
    vehicle.assert_none_ended();
    let second = vehicle.orders.lock().unwrap()[1].clone();
    assert!(vehicle.agv.end_order(&second) && !vehicle.agv.end_order(&second));
    vehicle.assert_ended(2);
}

#[test]
fn the_end_of_a_service_that_is_removed_is_told() {
    let vehicle = vehicle(LONG);
    vehicle.go(1, Renew::Process);
    vehicle.agv.my_function_list().remove("go").unwrap();
    vehicle.assert_ended(1);
}

#[test]
fn the_end_with_the_manager_is_told() {
    let vehicle = vehicle(LONG);
    vehicle.go(1, Renew::Process);
    vehicle.manager.stop();
    vehicle.assert_ended(1);
}
