//! Units in several processes on one host, which can be killed.
//!
//! The child is this test binary again, with [`as_child`] as its only test and its part in the environment. It ends when
//! its standard input does, so that none is left behind.

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cara_processes::ticker::unless_held_up;
use cara_std::control::Control;
use cara_std::{
    CloseReason, Definition, Error, LeaseEnd, OrderOutcome, Parameters, ParametersView, Peer, Refusal, Renew,
    RequestOptions, Served, ServiceError, ServiceOptions, StartError, UnitEvent,
};
use rustix::process::{Pid, Signal, kill_process};

use crate::support::{PATIENCE, ask, fleet, has_begun, number, service, system, unit, until};

const PART: &str = "CARA_TEST_PART";

/// A process with one unit; killed when dropped.
struct Process(Child);

impl Process {
    /// An s_unit whose `life` answers `life` and whose `hang` never does.
    fn agv(fleet: u32, name: &str, id: u32, life: i64) -> Self {
        Self::start(format!("agv {fleet} {name} {id} {life}"))
    }

    /// A manager that sends every vehicle which offers `go_to` on its way, under the lease.
    fn manager(fleet: u32) -> Self {
        Self::start(format!("manager {fleet} manager 1 0"))
    }

    fn start(part: String) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "processes::as_child", "--ignored", "--test-threads=1"]).env(PART, part);
        Self(command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap())
    }

    /// Returns when all its threads stand still.
    fn freeze(&self) {
        cara_processes::freeze(&self.0).unwrap();
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }

    /// No goodbye: the system closes its sockets.
    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "run by the other tests here, in processes of their own"]
fn as_child() {
    let part = std::env::var(PART).expect("the part to play");
    let words: Vec<&str> = part.split(' ').collect();
    let [kind, fleet, name, id, life] = words[..] else { panic!("{part}") };
    let (fleet, id, life) = (fleet.parse().unwrap(), id.parse().unwrap(), life.parse().unwrap());
    match kind {
        "agv" => {
            let agv = unit(name, id, fleet).build().unwrap();
            let list = agv.my_function_list();
            list.add_function("life", &number(0), service(move |_| life)).unwrap();
            list.add_function(
                "hang",
                &number(0),
                service(|_| {
                    loop {
                        std::thread::park()
                    }
                }),
            )
            .unwrap();
            // Less than three keep-alives, and longer than a thread waits for its turn.
            let moves = ServiceOptions::new().lease(Duration::from_secs(2), || ());
            let drive = |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
                call.lease.as_ref().unwrap().wait_until_ended();
                Ok(())
            };
            list.add_service(&Definition::parse("drive()").unwrap(), moves, drive).unwrap();
            agv.publish_my_function_list().unwrap();
            agv.start().unwrap();
            until_input_ends();
            // Its handlers may hang: exit without joining their threads.
            std::process::exit(0);
        }
        _ => {
            let manager = system(fleet).control(Control::Off).build().unwrap();
            manager.start().unwrap();
            let goes = |to: &Peer| has_begun(to, "go_to", Renew::Process);
            until("a vehicle goes", || manager.nodes_offering("go_to").first().is_some_and(goes));
            until_input_ends();
        }
    }
}

fn until_input_ends() {
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
}

#[test]
fn a_killed_peer_interrupts_its_callers_and_takes_its_place_again() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    let mut first = Process::agv(fleet, "first", 1, 1);
    until("the first has come", || manager.s_units().first().is_some_and(|peer| ask(peer, "life", 0) == Ok(1)));
    let _second = Process::agv(fleet, "second", 2, 10);
    until("the second has come", || manager.s_units().get(1).is_some_and(|peer| ask(peer, "life", 0) == Ok(10)));
    let peer = manager.s_units()[0].clone();
    let sent = || crate::support::counter(&peer.counters(), "RequestsSent");
    for life in 2..4 {
        let before = sent();
        std::thread::scope(|scope| {
            let callers: Vec<_> = (0..3)
                .map(|_| {
                    scope.spawn(|| {
                        let options = cara_std::RequestOptions { timeout: Some(PATIENCE.into()), ..Default::default() };
                        peer.call("hang", &mut number(0)).with(options).wait()
                    })
                })
                .collect();
            until("all have asked", || sent() >= before + 3);
            first.kill();
            for caller in callers {
                assert_eq!(caller.join().unwrap(), Err(Error::Interrupted.into()));
            }
        });
        until("it has left", || !peer.is_connected());
        first = Process::agv(fleet, "first", 1, life);
        until("it is back under the same handle", || ask(&peer, "life", 0) == Ok(life));
        let names: Vec<_> = manager.s_units().iter().map(|peer| peer.name().to_owned()).collect();
        assert_eq!(names, ["first", "second"]);
    }
}

/// The vehicle stands still for longer than the link lives, and then is started again: what has become of the call.
#[test]
fn an_interrupted_order_is_resolved_when_the_vehicle_is_back() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    let mut vehicle = Process::agv(fleet, "first", 1, 1);
    until("it has come", || manager.nodes_offering("drive").len() == 1);
    let peer = manager.s_units()[0].clone();
    assert_eq!(peer.outcome_of("drive"), OrderOutcome::Unknown);
    std::thread::scope(|scope| {
        let drives = scope.spawn(|| {
            let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::renewing(Renew::Process) };
            peer.call("drive", &mut Parameters::new()).with(options).wait()
        });
        until("it drives", || peer.outcome_of("drive") == OrderOutcome::Runs);
        vehicle.freeze();
        assert_eq!(drives.join().unwrap(), Err(Error::Interrupted.into()));
    });
    until("it is lost", || !peer.is_connected());
    assert_eq!(peer.outcome_of("drive"), OrderOutcome::Unknown);
    vehicle.signal(Signal::CONT);
    until("it tells", || peer.outcome_of("drive") == OrderOutcome::Ended(LeaseEnd::Expired));
    vehicle.kill();
    until("it has left", || !peer.is_connected());
    let _again = Process::agv(fleet, "first", 1, 2);
    until("it is back", || peer.is_connected() && peer.function("drive").is_some());
    assert_eq!(peer.outcome_of("drive"), OrderOutcome::Unknown);
}

/// The discovery port belongs to no process alone: units in five of them find each other.
#[test]
fn several_processes_share_the_discovery_port() {
    let fleet = fleet();
    let _vehicles: Vec<_> = (0..3).map(|id| Process::agv(fleet, &format!("agv{id}"), id, i64::from(id))).collect();
    let _stranger = Process::agv(fleet.wrapping_add(1), "stranger", 9, 9);
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    until("all have come", || manager.nodes_offering("life").len() == 3);
    for peer in manager.s_units() {
        assert_eq!(ask(&peer, "life", 0), Ok(i64::from(peer.id())));
    }
}

/// One process is frozen: it does not acknowledge, and is named.
#[test]
fn publishing_names_who_has_not_acknowledged() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    let _quick = Process::agv(fleet, "quick", 1, 1);
    let frozen = Process::agv(fleet, "frozen", 2, 2);
    until("both have come", || manager.nodes_offering("life").len() == 2);
    // Both together are less than three keep-alives.
    let [span, short] = [1_500, 200].map(cara_std::Duration::from_millis);
    manager.my_function_list().add_function("f", &number(0), service(|number| number)).unwrap();
    assert_eq!(manager.publish_and_wait(cara_std::Duration::from_secs(10)), Ok(vec![]));
    frozen.freeze();
    manager.my_function_list().add_function("g", &number(0), service(|number| number)).unwrap();
    let missing = manager.publish_and_wait(span).unwrap();
    assert_eq!(missing.iter().map(|identity| identity.name()).collect::<Vec<_>>(), ["frozen"]);
    let lost = manager.s_unit("frozen").unwrap();
    assert_eq!(lost.publish_and_wait(short), Err(Error::TimedOut));
    // Silent for three keep-alives, it is lost; it comes back when it goes on.
    until("it is lost", || !lost.is_connected());
    assert_eq!(manager.number_of_s_units(), 1);
    frozen.signal(Signal::CONT);
    until("it is back", || ask(&lost, "life", 0) == Ok(2));
}

/// A board that loses power does not say goodbye: its process stands still here, and one of the same identity begins. Then
/// a third of that identity comes while the second is well: that one is a double.
#[test]
fn a_restart_and_a_twin_are_told_apart() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let events = manager.events();
    manager.start().unwrap();
    let _bystander = Process::agv(fleet, "bystander", 2, 20);
    let first = Process::agv(fleet, "agv", 7, 1);
    let life = |name: &str| manager.s_unit(name).and_then(|peer| ask(&peer, "life", 0)).ok();
    until("both have come", || (life("agv"), life("bystander")) == (Some(1), Some(20)));

    first.freeze();
    let _second = Process::agv(fleet, "agv", 7, 2);
    until("the second has the first one's place", || life("agv") == Some(2));
    let left = events.try_iter().find_map(|event| match event {
        UnitEvent::Left { peer, reason } if peer.name() == "agv" => Some(reason),
        _ => None,
    });
    assert_eq!(left, Some(CloseReason::PeerRestarted), "it did not take three keep-alives to notice");
    assert_eq!(life("bystander"), Some(20));

    let duplicate = unit("agv", 7, fleet).build().unwrap();
    let reported = duplicate.events();
    duplicate.start().unwrap();
    loop {
        match reported.recv_timeout(PATIENCE).unwrap() {
            UnitEvent::NotJoined { reason: CloseReason::Refused(refusal), .. } => {
                assert_eq!(refusal, Refusal::DuplicateIdentity);
                break;
            }
            UnitEvent::Joined { .. } => panic!("the duplicate was taken while the second lives"),
            _ => {}
        }
    }
    assert_eq!((life("agv"), life("bystander"), manager.number_of_s_units()), (Some(2), Some(20), 2));
}

/// A manager that runs keeps its place; one that hangs does not answer, and where no control socket tells of it, its vehicles
/// go to the one that starts.
#[test]
fn a_second_manager_starts_only_where_the_first_does_not_answer() {
    let fleet = fleet();
    let first = Process::manager(fleet);
    let agv = unit("agv", 7, fleet).build().unwrap();
    agv.start().unwrap();
    until("it has joined the first", || agv.is_connected());
    let second = system(fleet).control(Control::Off).build().unwrap();
    let port = agv.manager().and_then(|peer| peer.address()).map(|address| address.port());
    match second.start() {
        Err(StartError::AlreadyRunning { at, .. }) => assert_eq!(Some(at.port()), port),
        other => panic!("one runs already: {other:?}"),
    }
    first.freeze();
    second.start().unwrap();
    until("the vehicle joins the second", || second.number_of_s_units() == 1);
}

#[test]
fn a_vehicle_stops_once_when_its_manager_is_killed() {
    let length = Duration::from_millis(1_500);
    unless_held_up(length, || goes_until_its_manager_is_killed(length));
}

fn goes_until_its_manager_is_killed(length: Duration) {
    let fleet = fleet();
    let stops = Arc::new(AtomicUsize::new(0));
    let stopped = stops.clone();
    let agv = unit("agv", 7, fleet).build().unwrap();
    let definition = "go_to(number: int[1]) -> (number: int[1])".parse().unwrap();
    let options = ServiceOptions::new().lease(length, move || {
        stopped.fetch_add(1, Ordering::SeqCst);
    });
    let lease = agv.my_function_list().add_service(&definition, options, service(|number| number)).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    let mut manager = Process::manager(fleet);
    until("it moves", || lease.is_live());
    let began = Instant::now();
    while began.elapsed() < 2 * length {
        std::thread::sleep(Duration::from_millis(5));
        assert!(lease.is_live(), "the lease is renewed");
    }
    manager.kill();
    until("it stops", || stops.load(Ordering::SeqCst) == 1);
    assert!(!lease.is_live());
    until("it knows", || !agv.is_connected());
    agv.stop();
    assert_eq!(stops.load(Ordering::SeqCst), 1);
}
