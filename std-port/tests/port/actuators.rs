//! What moves is an actuator: one order at a time has it, and a stop of anyone who may ends that order.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};

use cara_std::{
    Actuator, CommunicationSystem, Definition, Error, Latch, Parameters, ParametersView, Peer, Priority, Renew,
    RequestOptions, Served, ServiceError, ServiceOptions, Stage, UnitEvent,
};

use crate::support::{fleet, system, system_named, until};

/// So long that nothing here ends by time.
const LEASE: cara_std::Duration = cara_std::Duration::from_secs(600);

/// A crane with one drive, and two that want to move it.
struct Crane {
    unit: CommunicationSystem,
    drive: Actuator,
    hooks: Arc<AtomicUsize>,
    /// Whether the drive could move when the handler of `halt` ran.
    moved_in_halt: Arc<AtomicBool>,
    /// What `slow` could change, at its beginning and once its order had ended.
    committed: Arc<Mutex<Vec<bool>>>,
    callers: [CommunicationSystem; 2],
    fleet: u32,
}

impl Crane {
    fn new() -> Self {
        let fleet = fleet();
        let unit = system(fleet).build().unwrap();
        let (hooks, moved_in_halt) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        let counted = hooks.clone();
        let functions = unit.my_function_list();
        let drive = functions
            .actuator(move || {
                counted.fetch_add(1, Ordering::SeqCst);
            })
            .unwrap();
        let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let (watch, moved) = (drive.watch(), moved_in_halt.clone());
        let halt = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            moved.fetch_or(watch.is_live(), Ordering::SeqCst);
            Ok(())
        };
        let define = |text: &str| Definition::parse(text).unwrap();
        let moves = || ServiceOptions::new().moves(&drive, LEASE);
        functions.add_service(&define("go()"), moves(), nothing).unwrap();
        functions.add_service(&define("dock()"), moves(), nothing).unwrap();
        let committed = Arc::new(Mutex::new(Vec::new()));
        let commits = committed.clone();
        let slow = move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            let commit = || call.commit(|| ()).is_ok();
            let before = commit();
            commits.lock().unwrap().push(before);
            call.lease.as_ref().unwrap().wait_until_ended();
            commits.lock().unwrap().push(commit());
            call.commit(|| ())?;
            Ok(())
        };
        functions.add_service(&define("slow()"), moves(), slow).unwrap();
        let stops = ServiceOptions::new().stops(&drive).priority(Priority::Emergency);
        functions.add_service(&define("halt()"), stops, halt).unwrap();
        functions.add_service(&define("free()"), ServiceOptions::new().resets(&drive), nothing).unwrap();
        unit.publish_my_function_list().unwrap();
        let callers = [("one", 1), ("two", 2)].map(|(name, id)| system_named(name, id, fleet).build().unwrap());
        let crane = Self { unit, drive, hooks, moved_in_halt, committed, callers, fleet };
        crane.unit.start().unwrap();
        crane.callers.iter().for_each(|caller| caller.start().unwrap());
        until("both see it", || crane.callers.iter().all(|caller| caller.nodes_offering("free").len() == 1));
        crane
    }

    fn peer(&self, caller: usize) -> Peer<()> {
        self.callers[caller].m_unit("manager").unwrap()
    }

    fn ask(&self, caller: usize, function: &str) -> Result<(), Error> {
        self.peer(caller).call(function, &mut Parameters::new()).renewing(Renew::Process).wait().map_err(Error::from)
    }

    fn moves(&self) -> bool {
        self.drive.watch().is_live()
    }

    fn hooks(&self) -> usize {
        self.hooks.load(Ordering::SeqCst)
    }
}

/// Waits until a caller is told of this end of a lease.
fn reported(events: &Receiver<UnitEvent>, word: &str) {
    until(word, || {
        events.try_iter().any(|event| matches!(event, UnitEvent::LeaseEnded { why, .. } if why.word() == word))
    });
}

/// Waits until a caller is told of this state of the drive's latch.
fn latched(events: &Receiver<UnitEvent>, wanted: Option<Latch>) {
    until("it is told of the latch", || {
        events.try_iter().any(|event| matches!(event, UnitEvent::Inhibited { latch, .. } if latch == wanted))
    });
}

#[test]
fn two_services_of_one_actuator_replace_each_other_without_the_hook() {
    let crane = Crane::new();
    let events = crane.callers[0].events();
    assert_eq!(crane.ask(0, "go"), Ok(()));
    assert_eq!(crane.ask(0, "dock"), Ok(()));
    reported(&events, "replaced");
    assert!(crane.moves() && crane.hooks() == 0);
    crane.peer(0).release("dock").unwrap();
    until("the hook ran", || crane.hooks() == 1);
    assert!(!crane.moves());
    let numbers = ["go", "dock", "halt", "free"].map(|name| crane.peer(0).function(name).unwrap().attributes.actuator);
    assert!(numbers[0] != 0 && numbers.iter().all(|number| *number == numbers[0]), "{numbers:?}");
}

#[test]
fn another_callers_order_is_held_unless_it_is_taken_over() {
    let crane = Crane::new();
    assert_eq!(crane.ask(0, "go"), Ok(()));
    assert_eq!(crane.ask(1, "dock"), Err(Error::Held { by: 1, operator: false }));
    assert!(crane.moves() && crane.hooks() == 0);
    let options = RequestOptions { take_over: true, ..RequestOptions::new() };
    assert_eq!(crane.peer(1).call("dock", &mut Parameters::new()).with(options).wait(), Ok(()));
    assert_eq!(crane.ask(0, "go"), Err(Error::Held { by: 2, operator: false }));
    // The earlier holder gives up what it no longer has: nothing stops.
    crane.peer(0).release("go").unwrap();
    assert!(crane.moves() && crane.hooks() == 0);
}

#[test]
fn a_stop_of_a_second_unit_ends_the_order_of_the_first_and_lasts_until_a_reset() {
    let crane = Crane::new();
    assert_eq!(crane.ask(0, "go"), Ok(()));
    assert_eq!(crane.ask(1, "halt"), Ok(()));
    assert!(!crane.moves() && !crane.moved_in_halt.load(Ordering::SeqCst));
    until("the hook ran", || crane.hooks() == 1);
    let stopped = Err(Error::Inhibited { by: 2, reason: 0 });
    assert_eq!((crane.ask(0, "go"), crane.ask(1, "dock")), (stopped, stopped));
    // The one who stopped it goes, and comes back.
    crane.callers[1].stop();
    until("it has left", || crane.unit.number_of_m_units() == 1);
    assert_eq!(crane.ask(0, "go"), stopped);
    // A reset counts from the earliest time at which it can have been asked for: one right behind the stop is refused.
    until("it is reset", || crane.ask(0, "free") == Ok(()));
    // The order of the first has ended there as well once its link has looked.
    until("it moves again", || crane.ask(0, "go") == Ok(()));
    assert!(crane.moves() && crane.hooks() == 1);
}

/// The unit that stopped it is killed or loses its link, and another process of its name is no other unit.
#[test]
fn a_stop_outlasts_the_link_and_the_start_of_the_unit_that_stopped_it() {
    let crane = Crane::new();
    assert_eq!(crane.ask(1, "halt"), Ok(()));
    crane.callers[1].stop();
    until("it has left", || crane.unit.number_of_m_units() == 1);
    let again = system_named("two", 2, crane.fleet).build().unwrap();
    again.start().unwrap();
    until("it has come back", || again.nodes_offering("free").len() == 1);
    let dock = |by: &CommunicationSystem| by.nodes_offering("dock")[0].block_request("dock", &mut Parameters::new());
    let stopped = Err(Error::Inhibited { by: 2, reason: 0 });
    assert_eq!((dock(&again), dock(&crane.callers[0])), (stopped, stopped));
    until("it is reset", || again.nodes_offering("free")[0].block_request("free", &mut Parameters::new()) == Ok(()));
    assert_eq!(dock(&crane.callers[0]), Ok(()));
}

#[test]
fn the_vehicles_own_stop_is_told_with_its_reason_and_its_hook_waits_for_nothing() {
    let crane = Crane::new();
    let events = crane.callers[0].events();
    let others = crane.callers[1].events();
    assert_eq!(crane.ask(0, "go"), Ok(()));
    crane.drive.inhibit(9);
    assert!(!crane.moves());
    // At once, and not when the lease would have ended.
    reported(&events, "stopped");
    until("the hook ran", || crane.hooks() == 1);
    assert_eq!(crane.ask(0, "go"), Err(Error::Inhibited { by: 0, reason: 9 }));
    latched(&others, Some(Latch { by: 0, reason: 9 }));
    crane.drive.reset();
    assert_eq!(crane.ask(0, "go"), Ok(()));
    latched(&others, None);
    assert_eq!(crane.hooks(), 1);
}

#[test]
fn a_handler_changes_nothing_for_an_order_that_has_ended() {
    let crane = Crane::new();
    let asked = crane.peer(0).request("slow", &Parameters::new());
    assert!(asked.is_ok());
    until("it has begun", || crane.committed.lock().unwrap().len() == 1);
    assert_eq!(crane.ask(1, "halt"), Ok(()));
    until("it has seen the end", || crane.committed.lock().unwrap().len() == 2);
    assert_eq!(*crane.committed.lock().unwrap(), [true, false]);
}

#[test]
fn what_cannot_stand_still_at_once_slows_down_and_begins_nothing_meanwhile() {
    let crane = Crane::new();
    let drive = crane.drive.clone().ramp(LEASE.divided_by(20));
    assert_eq!(drive.watch().left(), None);
    assert_eq!(crane.ask(0, "go"), Ok(()));
    assert_eq!(drive.watch().stage(), Stage::Live);
    let left = drive.watch().left();
    assert!(left.is_some_and(|left| left > LEASE.divided_by(2) && left <= LEASE), "{left:?}");
    crane.peer(0).release("go").unwrap();
    until("it slows down", || drive.watch().stage() == Stage::Stopping);
    until("the hook ran", || crane.hooks() == 1);
    assert_eq!(crane.ask(0, "dock"), Err(Error::Busy), "the ramp comes first");
    assert_eq!((drive.watch().stage(), drive.watch().left()), (Stage::Stopping, None));
}
