//! Services with `&self`: they run side by side, keep nothing that changes the state from its turn, and hold up no stop.

use std::fmt::{Debug, Write};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use cara_std::{Peer, Renew, RequestOptions, Unit, interface};
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber, span};

use crate::support::{Gate, PATIENCE, fleet, meet, system, unit, until};

#[interface]
trait Crane {
    /// Waits at its gate.
    #[returns(load)]
    fn load(&self) -> i64;

    fn set_load(&mut self, load: i64);

    /// Takes a moment, as a reader of a sensor does.
    #[returns(load)]
    fn weigh(&self) -> i64;

    /// Waits at its gate, and moves.
    #[actuator(hook)]
    #[lease(ms = 20000)]
    fn lift(&self);

    #[priority(emergency)]
    fn halt();

    fn ponder(&mut self, times: i64);
}

#[derive(Default)]
struct Hook {
    load: i64,
    at_load: Arc<Gate>,
    at_lift: Arc<Gate>,
    /// What each call of `load` has returned, in the order in which they ended.
    seen: Arc<Mutex<Vec<i64>>>,
    weighed: Arc<AtomicUsize>,
}

impl Crane for Hook {
    fn load(&self) -> i64 {
        self.at_load.pass();
        self.seen.lock().unwrap().push(self.load);
        self.load
    }

    fn set_load(&mut self, load: i64) {
        self.load = load;
    }

    fn weigh(&self) -> i64 {
        std::thread::sleep(Duration::from_millis(1));
        self.weighed.fetch_add(1, Ordering::SeqCst);
        self.load
    }

    fn lift(&self) {
        self.at_lift.pass();
    }

    fn halt() {}

    fn ponder(&mut self, times: i64) {
        let began = Instant::now();
        while times > 0 && began.elapsed() < Duration::from_millis(1_050) {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// A crane with its manager's view of it.
struct Pair {
    manager: cara_std::CommunicationSystem,
    crane: Unit<Hook>,
    peer: Peer,
}

impl Pair {
    fn new(hook: Hook) -> Self {
        let fleet = fleet();
        let manager = system(fleet).build().unwrap();
        let crane = unit("agv", 7, fleet).state(hook).build().unwrap();
        let hook = crane.my_function_list().actuator(|| ()).unwrap();
        crane.my_function_list().serve(CraneServer { hook }).unwrap();
        let (peer, _) = meet(&manager, &crane);
        Self { manager, crane, peer }
    }

    fn client(&self) -> CraneClient<'_, Peer> {
        let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::default() };
        CraneClient::at(&self.peer).with(options)
    }

    fn stop(self) {
        self.manager.stop();
        self.crane.stop();
    }
}

#[test]
fn readers_run_side_by_side_and_overtake_no_change() {
    let hook = Hook::default();
    let (at_load, seen) = (hook.at_load.clone(), hook.seen.clone());
    let pair = Pair::new(hook);
    let client = pair.client();
    for _ in 0..3 {
        client.load().send().unwrap();
    }
    until("three read at the same time", || at_load.came() == 3);
    client.set_load(5).send().unwrap();
    client.load().send().unwrap();
    pair.peer.flush().unwrap();
    for _ in 0..10 {
        assert_eq!(client.halt().wait(), Ok(()), "an emergency waits for no reader");
    }
    assert_eq!(at_load.came(), 3, "a change waits before the fourth");
    at_load.open();
    until("all have read", || seen.lock().unwrap().len() == 4);
    assert_eq!(*seen.lock().unwrap(), [0, 0, 0, 5]);
    pair.stop();
}

/// So many calls read that the state is never free.
#[test]
fn a_flood_of_readers_keeps_neither_changes_nor_stops_from_their_turn() {
    let hook = Hook::default();
    let weighed = hook.weighed.clone();
    let pair = Pair::new(hook);
    let client = pair.client();
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..12 {
            scope.spawn(|| {
                while !over.load(Ordering::SeqCst) {
                    client.weigh().wait().unwrap();
                }
            });
        }
        until("they read", || weighed.load(Ordering::SeqCst) > 100);
        for load in 1..=50 {
            assert_eq!(client.set_load(load).wait(), Ok(()));
            assert_eq!(client.halt().wait(), Ok(()));
        }
        over.store(true, Ordering::SeqCst);
    });
    assert_eq!(pair.crane.with_state(|hook| hook.load), Ok(50));
    pair.stop();
}

/// Rule 9 of authority: two calls that move one thing, with `&self` as well.
#[test]
fn calls_that_move_run_one_at_a_time_though_they_only_read() {
    let hook = Hook::default();
    let (at_lift, at_load) = (hook.at_lift.clone(), hook.at_load.clone());
    at_load.open();
    let pair = Pair::new(hook);
    let client = pair.client().with(RequestOptions {
        renew: Renew::Never,
        timeout: Some(PATIENCE.into()),
        ..RequestOptions::default()
    });
    client.lift().send().unwrap();
    until("the first moves", || at_lift.came() == 1);
    client.lift().send().unwrap();
    pair.peer.flush().unwrap();
    (0..10).for_each(|_| assert_eq!(client.halt().wait(), Ok(())));
    assert_eq!(at_lift.came(), 1);
    at_lift.open();
    until("the second moves", || at_lift.came() == 2);
    assert_eq!(client.load().wait(), Ok(0));
    pair.stop();
}

#[test]
fn who_waits_with_the_state_is_warned_about_once() {
    let lines = warnings();
    let pair = Pair::new(Hook::default());
    let client = pair.client();
    client.ponder(0).wait().unwrap();
    let of_ponder = || {
        lines.lock().unwrap().iter().filter(|line| line.contains("function=\"ponder\"")).cloned().collect::<Vec<_>>()
    };
    assert_eq!(of_ponder(), [""; 0]);
    (0..2).for_each(|_| client.ponder(1).wait().unwrap());
    let seen = of_ponder();
    assert_eq!(seen.len(), 1, "{seen:?}");
    assert!(seen[0].contains("unit=agv/7") && seen[0].contains("held_ms=1"), "{seen:?}");
    pair.stop();
}

/// The warnings of all handlers of this process from here on.
fn warnings() -> &'static Mutex<Vec<String>> {
    static LINES: OnceLock<&'static Mutex<Vec<String>>> = OnceLock::new();
    LINES.get_or_init(|| {
        let lines: &'static Mutex<Vec<String>> = Box::leak(Box::default());
        tracing::subscriber::set_global_default(Recorder(lines)).expect("nothing else records here");
        lines
    })
}

struct Recorder(&'static Mutex<Vec<String>>);

impl Subscriber for Recorder {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        *metadata.level() == Level::WARN && metadata.target() == "cara_std::engine::serving"
    }

    fn event(&self, event: &Event<'_>) {
        struct Line(String);
        impl Visit for Line {
            fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
                let _ = write!(self.0, "{}={value:?} ", field.name());
            }
        }
        let mut line = Line(String::new());
        event.record(&mut line);
        self.0.lock().unwrap().push(line.0);
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }

    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}
    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}
    fn enter(&self, _: &span::Id) {}
    fn exit(&self, _: &span::Id) {}
}
