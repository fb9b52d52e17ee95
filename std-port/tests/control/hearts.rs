//! What an operator holds is renewed as of the client's last sign of life, by the thread that watches the client.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_std::control::execute_while;
use cara_std::control::protocol::{Answer, Question};
use cara_std::{LeaseWatch, ParametersView, Served, ServiceError, ServiceOptions, Unit};

use crate::support::{Depot, call, until};

const LEASE: Duration = Duration::from_millis(400);

struct Creeping {
    depot: Depot,
    lease: LeaseWatch,
    made_safe: Arc<AtomicU32>,
    _agv: Unit,
}

impl Creeping {
    fn new() -> Self {
        let (depot, agv) = Depot::with_agv();
        let made_safe = Arc::<AtomicU32>::default();
        let counted = made_safe.clone();
        let safe = move || {
            counted.fetch_add(1, Ordering::SeqCst);
        };
        let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let options = ServiceOptions::new().lease(LEASE, safe);
        let lease = agv.my_function_list().add_service(&"creep()".parse().unwrap(), options, nothing).unwrap();
        agv.publish_my_function_list().unwrap();
        let peer = depot.system.s_unit("agv").unwrap();
        until("it is known", || peer.function("creep").is_some());
        Self { depot, lease, made_safe, _agv: agv }
    }

    fn hold(&self, answer: &mut dyn FnMut(Answer) -> ControlFlow<()>, lives: &dyn Fn() -> Option<Instant>) {
        execute_while(&self.depot.system, &Question::Hold(call(Some("agv"), "creep", vec![])), answer, lives);
    }

    fn made_safe(&self) -> u32 {
        self.made_safe.load(Ordering::SeqCst)
    }
}

#[test]
fn a_thread_that_hangs_while_it_watches_a_client_renews_nothing() {
    let creeping = Creeping::new();
    let (go_on, hangs) = channel::<()>();
    let mut answer = move |answer| {
        if matches!(answer, Answer::Called { error: None, .. }) {
            // As with an answer or a line of a log that finds no room.
            let _ = hangs.recv();
        }
        ControlFlow::Continue(())
    };
    let is_over = AtomicBool::new(false);
    let (moves, stops) = std::thread::scope(|scope| {
        scope.spawn(|| creeping.hold(&mut answer, &|| (!is_over.load(Ordering::SeqCst)).then(Instant::now)));
        // No assertion before the thread is let go.
        let within = |condition: &dyn Fn() -> bool| {
            (0..1_000).any(|_| {
                std::thread::sleep(Duration::from_millis(10));
                condition()
            })
        };
        let moves = within(&|| creeping.lease.is_live() || creeping.made_safe() == 1);
        let stops = within(&|| creeping.made_safe() == 1);
        is_over.store(true, Ordering::SeqCst);
        drop(go_on);
        (moves, stops)
    });
    assert!(moves && stops, "it moves as long as the thread hangs");
}

#[test]
fn a_gateway_that_makes_no_sign_of_life_up_lets_go() {
    let creeping = Creeping::new();
    let (is_there, reported) = (AtomicBool::new(true), Mutex::new(Vec::new()));
    let last = Mutex::new(Instant::now());
    let lives = || {
        if is_there.load(Ordering::SeqCst) {
            *last.lock().unwrap() = Instant::now();
        }
        Some(*last.lock().unwrap())
    };
    let mut note = |answer| {
        reported.lock().unwrap().push(answer);
        ControlFlow::Continue(())
    };
    std::thread::scope(|scope| {
        scope.spawn(|| creeping.hold(&mut note, &lives));
        until("it moves", || creeping.lease.is_live());
        is_there.store(false, Ordering::SeqCst);
        until("it stops", || creeping.made_safe() == 1);
    });
    let reported = reported.into_inner().unwrap();
    assert!(matches!(reported.last(), Some(Answer::Failed(failure)) if failure.error == "Unattended"), "{reported:?}");
}
