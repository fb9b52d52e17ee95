//! Nothing of the application holds up a stop: handlers, hooks and holders of the state that never return.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cara_std::{Error, Parameters, Peer, Priority, Renew, RequestOptions, ServiceError, ServiceOptions, Unit};

use crate::support::{Gate, PATIENCE, ask, counter, fleet, held, meet, number, service, system, unit, until};

const LEASE: Duration = Duration::from_millis(300);

/// A vehicle whose handlers are stuck as long as the gate is closed: `held` without the state, `held_state` with it, the
/// emergency `held_stop`, and `held_at_zero` where its number is 0. `stop` and `go`, with its hook, are sound.
struct Stuck {
    _manager: cara_std::CommunicationSystem,
    agv: Unit<i64>,
    peer: Peer,
    gate: Arc<Gate>,
    hooks: Arc<AtomicUsize>,
}

fn emergency<T>() -> ServiceOptions<T> {
    ServiceOptions::new().priority(Priority::Emergency)
}

fn counting(hooks: &Arc<AtomicUsize>) -> impl Fn() + Send + Sync + 'static {
    let hooks = hooks.clone();
    move || {
        hooks.fetch_add(1, Ordering::SeqCst);
    }
}

impl Stuck {
    fn new() -> Self {
        let fleet = fleet();
        let manager = system(fleet).build().unwrap();
        let agv = unit("agv", 7, fleet).state(0_i64).build().unwrap();
        agv.set_constraints(cara_std::Constraints { calls_per_peer: 64, ..agv.constraints() }).unwrap();
        let (gate, hooks) = (Arc::new(Gate::default()), Arc::new(AtomicUsize::new(0)));
        let list = agv.my_function_list();
        list.add_function("held", &number(0), held(&gate)).unwrap();
        let at_gate = gate.clone();
        let with_state = move |_: &mut i64, parameters: Parameters| {
            at_gate.pass();
            parameters
        };
        list.add_function("held_state", &number(0), with_state).unwrap();
        let at_gate = gate.clone();
        let held_at_zero = move |number| {
            if number == 0 {
                at_gate.pass();
            }
            number
        };
        list.add_function("held_at_zero", &number(0), service(held_at_zero)).unwrap();
        let signature = |name: &str| format!("{name}(number: int[1]) -> (number: int[1])").parse().unwrap();
        list.add_service(&signature("held_stop"), emergency(), held(&gate)).unwrap();
        list.add_service(&signature("stop"), emergency(), service(|number| number)).unwrap();
        let options = ServiceOptions::new().lease(LEASE, counting(&hooks));
        list.add_service(&signature("go"), options, service(|number| number)).unwrap();
        list.add_function("quick", &number(0), service(|number| number)).unwrap();
        let (peer, _) = meet(&manager, &agv);
        Self { _manager: manager, agv, peer, gate, hooks }
    }

    /// Calls without waiting, and without an end that the test could see.
    fn call(&self, function: &str) {
        self.queue(function, 1);
        self.peer.flush().unwrap();
    }

    /// The same; it leaves with what is called next.
    fn queue(&self, function: &str, with: i64) {
        let options =
            RequestOptions { timeout: Some(PATIENCE.into()), renew: Renew::Never, ..RequestOptions::default() };
        self.peer.call(function, &mut number(with)).with(options).send().unwrap();
    }

    fn go(&self) {
        let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
        self.peer.call("go", &mut number(1)).with(options).wait().unwrap();
    }

    fn hooks(&self) -> usize {
        self.hooks.load(Ordering::SeqCst)
    }
}

#[test]
fn with_every_handler_stuck_a_hook_runs_and_an_emergency_is_answered() {
    let stuck = Stuck::new();
    stuck.go();
    stuck.call("held_state");
    stuck.call("held_stop");
    stuck.call("held_stop");
    for _ in 0..60 {
        stuck.call("held");
    }
    until("handlers are stuck, one of them with the state", || stuck.gate.came() >= 10);
    let free = RequestOptions { timeout: Some(Duration::from_millis(300).into()), ..RequestOptions::default() };
    let quick = stuck.peer.call("quick", &mut number(1)).with(free).wait();
    assert_eq!(quick, Err(Error::TimedOut.into()), "as many run as may");
    until("the hook runs all the same", || stuck.hooks() == 1);
    for round in 0..10 {
        assert_eq!(ask(&stuck.peer, "stop", round), Ok(round), "an emergency, whatever else is stuck");
    }
    assert_eq!(ask(&stuck.peer, "held_stop", 1), Err(Error::Busy), "two of the service that is stuck are there");
    stuck.gate.open();
    until("nothing was lost", || stuck.gate.came() == 63);
    assert_eq!(stuck.hooks(), 1);
}

/// Calls that wait for the state keep no thread: those that do not need it are served.
#[test]
fn calls_that_wait_for_the_state_keep_nobody_from_being_served() {
    let stuck = Stuck::new();
    for _ in 0..15 {
        stuck.call("held_state");
    }
    until("one has the state", || stuck.gate.came() == 1);
    for round in 0..20 {
        assert_eq!(ask(&stuck.peer, "quick", round), Ok(round));
    }
    assert_eq!(stuck.gate.came(), 1);
    stuck.gate.open();
    until("each has its turn", || stuck.gate.came() == 15);
    assert_eq!(stuck.agv.with_state(|_| ()), Ok(()));
}

#[test]
fn a_quick_call_waits_for_none_of_three_slow_ones_before_it() {
    let stuck = Stuck::new();
    for _ in 0..3 {
        stuck.call("held");
    }
    assert_eq!(ask(&stuck.peer, "quick", 7), Ok(7));
    until("the three run side by side", || stuck.gate.came() == 3);
    stuck.gate.open();
}

/// While handlers are quick one thread serves what has come; behind one that hangs after all another thread goes on.
#[test]
fn a_call_does_not_wait_for_one_whose_handler_was_quick_until_then() {
    let stuck = Stuck::new();
    let mut rounds = [1, 2, 3, 4, 5, 6, 7, 8, 9].map(|hung| {
        (1..=50).for_each(|number| stuck.queue("held_at_zero", number));
        stuck.queue("held_at_zero", 0);
        let asked = Instant::now();
        assert_eq!(ask(&stuck.peer, "quick", 7), Ok(7));
        until("one more hangs", || stuck.gate.came() == hung);
        asked.elapsed()
    });
    // The next keep-alive, after a second, would have it served as well.
    rounds.sort();
    assert!(rounds[4] < Duration::from_millis(500), "{rounds:?}");
    stuck.gate.open();
}

/// A hook that does not return delays its own service, and no other hook.
#[test]
fn hooks_do_not_wait_for_each_other() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    let (gate, hooks) = (Arc::new(Gate::default()), Arc::new(AtomicUsize::new(0)));
    let list = agv.my_function_list();
    let signature = |name: &str| format!("{name}(number: int[1]) -> (number: int[1])").parse().unwrap();
    let at_gate = gate.clone();
    let stuck = ServiceOptions::new().lease(LEASE, move || at_gate.pass());
    list.add_service(&signature("stuck"), stuck, service(|number| number)).unwrap();
    let sound = ServiceOptions::new().lease(LEASE, counting(&hooks));
    list.add_service(&signature("sound"), sound, service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let options = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    let call = |function: &str| peer.call(function, &mut number(1)).with(options).wait();
    assert_eq!(call("stuck"), Ok(()));
    until("its hook is stuck", || gate.came() == 1);
    // The hook may be ahead of the unit, which is busy until it has seen the end of the last order.
    let mut refused = call("stuck");
    while refused == Err(Error::Busy.into()) {
        refused = call("stuck");
    }
    assert_eq!(refused, Err(Error::Service(ServiceError::NotReady).into()), "the next order comes after the hook");
    for round in 1..4 {
        // Its hook may be ahead of the unit, which takes no new order before it has seen the end of the last one.
        until("it takes an order", || call("sound") == Ok(()));
        until("the other hook runs", || hooks.load(Ordering::SeqCst) == round);
    }
    assert_eq!(counter(&agv.counters(), "HooksLate"), 1);
    gate.open();
    until("it is ready again", || call("stuck") == Ok(()));
}

#[test]
fn an_emergency_service_takes_no_handler_that_waits_for_the_state() {
    let agv = unit("agv", 7, fleet()).state(0_i64).build().unwrap();
    let definition = "stop(number: int[1])".parse().unwrap();
    let stop = |_: &mut i64, parameters: Parameters| parameters;
    let refused = agv.my_function_list().add_service(&definition, emergency(), stop);
    assert_eq!(refused.map(drop), Err(Error::EmergencyWaits));
    assert!(agv.my_function_list().add_service(&definition, emergency(), service(|number| number)).is_ok());
}
