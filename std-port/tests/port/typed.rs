//! Typed services between real units.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use cara_core::distribution::block::{self, SliceWriter};
use cara_std::typed::{BAD_ARGUMENT, Part};
use cara_std::{
    AnyCall, CallError, Canceller, Constraints, Definition, Duration, Error, Failure, LeaseWatch, LinkCounter,
    Parameters, Priority, Renew, RequestOptions, ServiceError, ServiceOptions, TypedCall, Variables, interface,
};

use crate::support::{PATIENCE, fleet, held, meet, number, pair, system, unit, until};

#[derive(Variables, Clone, Copy, Debug, Default, PartialEq)]
enum Mode {
    #[default]
    Idle,
    Driving,
}

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
pub(crate) struct Left {
    pub(crate) left: u32,
}

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
pub(crate) struct Blocked {
    pub(crate) at: [i32; 2],
}

/// What tells how far it is, and does not arrive from 11.
#[interface]
pub(crate) trait Dock {
    fn dock(&mut self, call: &impl TypedCall<Left, Blocked>, from: u32) -> Result<(), ServiceError>;
}

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
pub(crate) struct Metres {
    left: f32,
}

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    at: [i32; 3],
}

/// Other versions of it: one tells something else, one fails with something else.
#[interface]
pub(crate) trait NewerDock {
    fn dock(&mut self, call: &impl TypedCall<Metres, Blocked>, from: u32) -> Result<(), ServiceError>;
}

#[interface]
pub(crate) trait NewestDock {
    fn dock(&mut self, call: &impl TypedCall<Left, Place>, from: u32) -> Result<(), ServiceError>;
}

/// How many of its calls have seen that they are given up.
#[derive(Default)]
pub(crate) struct Gate {
    pub(crate) given_up: u32,
    /// How many have begun.
    started: Arc<AtomicUsize>,
}

impl Dock for Gate {
    fn dock(&mut self, call: &impl TypedCall<Left, Blocked>, from: u32) -> Result<(), ServiceError> {
        self.started.fetch_add(1, Ordering::SeqCst);
        for left in (0..from).rev() {
            call.progress(&Left { left })?;
            std::thread::sleep(std::time::Duration::from_millis(20));
            if call.is_cancelled() {
                self.given_up += 1;
                return Err(call.fail_with(1, "given up", &Blocked { at: [5, 6] }));
            }
            if from == 11 && left < 9 {
                return Err(call.fail_with(7, "the way is blocked", &Blocked { at: [3, -4] }));
            }
        }
        Ok(())
    }
}

#[test]
fn progress_and_failures_come_typed() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).state(Gate::default()).build().unwrap();
    agv.my_function_list().serve(DockServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let shown = peer.function("dock").unwrap().definition.to_string();
    assert_eq!(shown, "dock(from: int) progress (left: int) fails (at: int[2])");
    let client = DockClient::at(&peer);
    let mut reported = Vec::new();
    let outcome = client
        .dock(3)
        .watch(|Left { left }| {
            reported.push(left);
            ControlFlow::Continue(())
        })
        .wait();
    assert_eq!(outcome, Ok(()));
    // Which of them are told, depends on time; the first one is sent at once, and none comes twice.
    assert!(reported.first() == Some(&2) && reported.is_sorted_by(|one, next| one > next), "{reported:?}");
    let failed = client.dock(11).watch(|_| ControlFlow::Continue(())).wait().unwrap_err();
    assert_eq!(failed.error, Error::Service(ServiceError::Failed(7)));
    assert_eq!((failed.text(), failed.values()), ("the way is blocked", Some(Blocked { at: [3, -4] })));
    assert_eq!(failed.to_string(), "the way is blocked (code 7)");
    let failed = client.dock(500).watch(|_| ControlFlow::Break(())).wait().unwrap_err();
    assert_eq!(failed, Error::Cancelled);
    until("its service has been told", || agv.with_state(|gate| gate.given_up).is_ok_and(|count| count == 1));
    assert_eq!(client.dock(1).wait(), Ok(()));
    let reported = NewerDockClient::at(&peer).dock(1).watch(|_| unreachable!("nothing is sent")).wait().unwrap_err();
    assert!(matches!(reported.mismatch(), Some(what) if what.part == Part::Progress), "{reported}");
    assert!(reported.to_string().contains("its progress left is int there and float here"), "{reported}");
    let reported = NewestDockClient::at(&peer).dock(1).wait().unwrap_err();
    assert!(matches!(reported.mismatch(), Some(what) if what.part == Part::Failure), "{reported}");
    assert!(reported.to_string().contains("its failure's at is int[2] there and int[3] here"), "{reported}");
    manager.stop();
    agv.stop();
}

/// Given up by what watches it, and by another thread.
#[test]
fn a_call_that_is_given_up_gets_its_answer_where_it_asks_for_that() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let gate = Gate::default();
    let started = gate.started.clone();
    let agv = unit("agv", 7, fleet).state(gate).build().unwrap();
    agv.my_function_list().serve(DockServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = DockClient::at(&peer);
    let mut heard = 0;
    let breaks = |_: Left| {
        heard += 1;
        ControlFlow::Break(())
    };
    let watched = client.dock(1_500).watch(breaks).answer_within(PATIENCE).timeout(PATIENCE).wait().unwrap_err();
    assert_eq!(heard, 1, "nothing is heard any more once it is given up");
    let canceller = Canceller::new();
    let call = client.dock(1_500).cancelled_by(&canceller).answer_within(PATIENCE).timeout(PATIENCE);
    let cancelled = std::thread::scope(|scope| {
        let waiting = scope.spawn(|| call.wait().unwrap_err());
        until("it runs", || started.load(Ordering::SeqCst) == 2);
        canceller.cancel();
        waiting.join().unwrap()
    });
    for failed in [watched, cancelled] {
        assert_eq!(failed.error, Error::Service(ServiceError::Failed(1)));
        assert_eq!((failed.text(), failed.values()), ("given up", Some(Blocked { at: [5, 6] })));
    }
    assert_eq!(client.dock(0).wait(), Ok(()), "the link goes on");
    manager.stop();
    agv.stop();
}

#[test]
fn an_answer_that_does_not_come_in_time_is_not_waited_for() {
    let (manager, agv) = pair();
    let at_gate = Arc::new(crate::support::Gate::default());
    agv.my_function_list().add_function("held", &number(0), held(&at_gate)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let canceller = Canceller::new();
    let ended = std::thread::scope(|scope| {
        let (within, canceller, peer) = (Duration::from_millis(50), &canceller, &peer);
        let waiting = scope.spawn(move || {
            let mut number = number(4);
            let call = peer.call("held", &mut number).timeout(PATIENCE).cancelled_by(canceller);
            call.answer_within(within).wait().unwrap_err().error
        });
        until("it runs", || at_gate.came() == 1);
        canceller.cancel();
        waiting.join().unwrap()
    });
    assert_eq!(ended, Error::Cancelled);
    at_gate.open();
    until("its answer reaches no one", || manager.counted(LinkCounter::RepliesLate) == 1);
    let canceller = Canceller::new();
    canceller.cancel();
    let mut seven = number(7);
    let unsent = peer.call("held", &mut seven).cancelled_by(&canceller).answer_within(PATIENCE).wait();
    assert_eq!(unsent, Err(Error::Cancelled.into()), "what was not sent has no answer");
    manager.stop();
    agv.stop();
}

#[test]
fn another_thread_gives_typed_calls_up() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let gate = Gate::default();
    let started = gate.started.clone();
    let agv = unit("agv", 7, fleet).state(gate).build().unwrap();
    agv.my_function_list().serve(DockServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    // Runs until it is given up, far behind the end of the test.
    let ask = |watched: bool, canceller: &Canceller| {
        let call = DockClient::at(&peer).dock(5_000).timeout(PATIENCE).cancelled_by(canceller);
        if watched { call.watch(|_| ControlFlow::Continue(())).wait() } else { call.wait() }
    };
    for (count, watched) in [(1, false), (2, true)] {
        let canceller = Canceller::new();
        std::thread::scope(|scope| {
            let reported = || agv.counted(LinkCounter::ProgressSent);
            let (before, reported_before) = (started.load(Ordering::SeqCst), reported());
            let call = scope.spawn(|| ask(watched, &canceller));
            until("its service runs", || started.load(Ordering::SeqCst) > before);
            until("it tells", || !watched || reported() > reported_before);
            canceller.cancel();
            assert_eq!(call.join().unwrap(), Err(Error::Cancelled.into()), "watched: {watched}");
        });
        until("its service is told", || agv.with_state(|gate| gate.given_up).unwrap() == count);
        assert!(watched || agv.counted(LinkCounter::ProgressSent) == 0, "nobody asked for it");
        assert_eq!(ask(watched, &canceller), Err(Error::Cancelled.into()), "all calls behind it are given up");
        assert_eq!(DockClient::at(&peer).dock(1).wait(), Ok(()), "others are not");
    }
    manager.stop();
    agv.stop();
}

/// What tells how high it is, and does not stop by itself above 100.
#[interface]
trait Crane {
    #[actuator(motor)]
    #[lease(ms = 60_000)]
    #[returns(height)]
    fn hoist(&mut self, call: &impl AnyCall, height: u32) -> u32;
}

impl Crane for u32 {
    fn hoist(&mut self, call: &impl AnyCall, height: u32) -> u32 {
        if height > 100 {
            until("it is given up", || call.is_cancelled());
        }
        *self += height;
        *self
    }
}

#[test]
fn a_typed_call_that_is_held_gives_its_results_too() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(5_u32).build().unwrap());
    let motor = agv.my_function_list().actuator(|| ()).unwrap();
    let order = motor.watch();
    agv.my_function_list().serve(CraneServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let canceller = Canceller::new();
    let client = CraneClient::at(&peer).renewing(Renew::Process);
    let held = client.hoist(3).hold().cancelled_by(&canceller).wait().unwrap();
    assert!(held.results == 8 && held.is_held() && order.is_live());
    canceller.cancel();
    assert_eq!(client.hoist(4).hold().cancelled_by(&canceller).wait().unwrap_err(), Error::Cancelled);
    assert!(held.is_held() && order.is_live(), "what was held before stays so");
    drop(held);
    until("it is released", || !order.is_live());
    let canceller = Canceller::new();
    std::thread::scope(|scope| {
        let call = client.hoist(101).hold().cancelled_by(&canceller);
        let call = scope.spawn(move || call.wait().map(|_| ()));
        until("it moves", || order.is_live());
        canceller.cancel();
        assert_eq!(call.join().unwrap(), Err(Error::Cancelled.into()));
    });
    until("it stops", || !order.is_live());
    manager.stop();
    agv.stop();
}

#[derive(Variables, Clone, Debug, Default, PartialEq)]
struct State {
    position: [i64; 2],
    mode: Mode,
    #[size(100)]
    said: String,
}

#[interface]
trait Drive {
    #[idempotent]
    fn state(&self) -> State;

    /// Drives there.
    #[actuator(motor)]
    #[lease(ms = 60_000)]
    fn go_to(&mut self, call: &impl AnyCall, #[unit = "mm"] position: [i64; 2], speed: u8) -> Result<(), ServiceError>;

    #[priority(emergency)]
    #[actuator(motor)]
    #[stop]
    fn halt();

    #[actuator(motor)]
    #[reset]
    fn free(&mut self);

    #[returns(count)]
    fn say(&mut self, #[size(100)] text: &str) -> Result<u32, ServiceError>;
}

impl Drive for State {
    fn state(&self) -> State {
        self.clone()
    }

    fn go_to(&mut self, call: &impl AnyCall, position: [i64; 2], _: u8) -> Result<(), ServiceError> {
        assert_eq!(call.caller().name(), "manager");
        call.commit(|| (self.position, self.mode) = (position, Mode::Driving))?;
        Ok(())
    }

    fn halt() {}

    fn free(&mut self) {
        self.mode = Mode::Idle;
    }

    fn say(&mut self, text: &str) -> Result<u32, ServiceError> {
        self.said.push_str(text);
        u32::try_from(self.said.len()).map_err(|_| ServiceError::NotReady)
    }
}

#[test]
fn a_typed_vehicle_is_driven_stopped_and_reset() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(State::default()).build().unwrap());
    let safe = Arc::new(AtomicUsize::new(0));
    let counted = safe.clone();
    let hook = move || {
        counted.fetch_add(1, Ordering::SeqCst);
    };
    let motor = agv.my_function_list().actuator(hook).unwrap();
    let order = motor.watch();
    agv.my_function_list().serve(DriveServer { motor }).unwrap();
    assert_eq!(
        agv.my_function_list().serve(DriveServer { motor: agv.my_function_list().actuator(|| ()).unwrap() }),
        Err(Error::NameTaken)
    );
    let (peer, _) = meet(&manager, &agv);
    let client = DriveClient::at(&peer);
    assert_eq!(client.state().wait(), Ok(State::default()));
    assert_eq!(client.say("on the way").wait(), Ok(10));
    let held = client.renewing(Renew::Process).go_to([1, 2], 3).hold().wait().unwrap();
    assert!(order.is_live());
    assert_eq!(client.state().wait(), Ok(State { position: [1, 2], mode: Mode::Driving, said: "on the way".into() }));
    assert_eq!(client.halt().wait(), Ok(()));
    assert!(!order.is_live());
    until("the hook has run", || safe.load(Ordering::SeqCst) == 1);
    assert!(matches!(client.go_to([5, 5], 3).wait(), Err(CallError { error: Error::Inhibited { .. }, .. })));
    drop(held);
    until("it may move again", || client.free().wait().is_ok() && client.go_to([5, 5], 3).wait().is_ok());
    let wanted = RequestOptions { timeout: Some(Duration::from_secs(5)), ..RequestOptions::new() };
    client.with(wanted).say("!").send().unwrap();
    until("the request has run", || client.state().wait().is_ok_and(|state| state.said == "on the way!"));
    manager.stop();
    agv.stop();
}

#[test]
fn typed_and_dynamic_ends_understand_each_other() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(State::default()).build().unwrap());
    let motor = agv.my_function_list().actuator(|| ()).unwrap();
    agv.my_function_list().serve(DriveServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &agv);
    assert!(agv.my_function_list().show_functions().contains("go_to(position: int[2], speed: int)\n"));
    let go_to = peer.function("go_to").unwrap().definition;
    let (help, units) = (go_to.signature().help(), go_to.signature().units());
    assert_eq!((help, units.collect::<Vec<_>>()), ("Drives there.", vec![("position", "mm")]));
    let halt = peer.function("halt").unwrap();
    assert!(halt.attributes.stop && halt.attributes.priority == Priority::Emergency);
    let mut call = Parameters::new();
    call.add_int("position", 2).unwrap();
    call.add_int("speed", 1).unwrap();
    call.set_value("speed", 300).unwrap();
    let refused = Err(Error::Service(ServiceError::Failed(BAD_ARGUMENT)));
    assert_eq!(peer.block_request("go_to", &mut call), refused, "a u8");
    call.set_value("speed", 255).unwrap();
    call.set_value("position", [7, 8]).unwrap();
    peer.block_request("go_to", &mut call).unwrap();
    let mut state = Parameters::new();
    peer.block_request("state", &mut state).unwrap();
    assert_eq!(State::from_parameters(&state).unwrap().position, [7, 8]);
    manager.stop();
    agv.stop();
}

#[test]
fn another_version_of_the_vehicle_is_told_before_anything_is_sent() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let calls = Arc::new(AtomicUsize::new(0));
    let counted = calls.clone();
    let run = move |_: &cara_std::Served, _: &mut cara_std::ParametersView| -> Result<(), ServiceError> {
        counted.fetch_add(1, Ordering::SeqCst);
        Ok(())
    };
    let go_to = Definition::parse("go_to(position: float[2], speed: int)").unwrap();
    agv.my_function_list().add_service(&go_to, ServiceOptions::new(), run.clone()).unwrap();
    let say = Definition::parse("say(text: string[20]) -> (count: int, left: int)").unwrap();
    agv.my_function_list().add_service(&say, ServiceOptions::new(), run).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = DriveClient::at(&peer);
    let reported = client.go_to([1, 2], 3).wait().unwrap_err();
    assert_eq!(reported.error, Error::Mismatch(Part::Argument));
    assert_eq!(
        reported.to_string(),
        "the peer's go_to is of another version: its argument position is float[2] there and int[2] here: update one of the two"
    );
    assert_eq!(client.go_to([1, 2], 3).send(), Err(Error::Mismatch(Part::Argument).into()));
    assert_eq!(calls.load(Ordering::SeqCst), 0);
    assert_eq!(client.state().wait(), Err(Error::UnknownFunction.into()));
    assert_eq!(
        client.say("a newer version gives more").wait(),
        Err(Error::WrongSize { index: 0, expected: 20, found: 26 }.into())
    );
    assert_eq!(client.say("short enough").wait(), Ok(0));
    assert_eq!(calls.load(Ordering::SeqCst), 1);
    manager.stop();
    agv.stop();
    assert_eq!(client.say("gone").wait(), Err(Error::NotConnected.into()));
}

#[cfg(feature = "async")]
#[test]
fn a_task_of_any_thread_awaits_a_typed_call() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(State::default()).build().unwrap());
    let motor = agv.my_function_list().actuator(|| ()).unwrap();
    agv.my_function_list().serve(DriveServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_time().build().unwrap();
    let task = runtime.spawn(async move { DriveClient::at(&peer).say("hello").await });
    assert_eq!(runtime.block_on(task).unwrap(), Ok(5));
    manager.stop();
    agv.stop();
}

#[interface]
trait Door {
    fn open(&mut self, call: &impl AnyCall, width: u8) -> Result<(), ServiceError>;
}

struct Stuck;

impl Door for Stuck {
    fn open(&mut self, call: &impl AnyCall, width: u8) -> Result<(), ServiceError> {
        if width > 1 { Err(call.fail(Failure::new(4, "something is in the way"))) } else { Ok(()) }
    }
}

#[test]
fn a_typed_service_says_why_it_fails() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(Stuck).build().unwrap());
    agv.my_function_list().serve(DoorServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = DoorClient::at(&peer);
    let failed = client.open(2).wait().unwrap_err();
    assert_eq!(failed, Error::Service(ServiceError::Failed(4)));
    assert_eq!((failed.code(), failed.text()), (Some(4), "something is in the way"));
    assert!(failed.may_have_run());
    assert_eq!(client.open(1).wait(), Ok(()));
    manager.stop();
    agv.stop();
}

/// What says itself that it is done.
#[interface]
trait Mast {
    #[actuator(motor)]
    #[lease(ms = 60_000)]
    fn lift(&mut self, call: &impl TypedCall<Left, (), Order = LeaseWatch>) -> Result<(), ServiceError>;

    fn count(&mut self, call: &impl AnyCall<Order = LeaseWatch>);
}

impl Mast for Option<LeaseWatch> {
    fn lift(&mut self, call: &impl TypedCall<Left, (), Order = LeaseWatch>) -> Result<(), ServiceError> {
        *self = call.order();
        Ok(())
    }

    fn count(&mut self, call: &impl AnyCall<Order = LeaseWatch>) {
        assert!(call.order().is_none());
    }
}

#[test]
fn a_typed_service_knows_its_order_and_ends_it() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(None).build().unwrap());
    let motor = agv.my_function_list().actuator(|| ()).unwrap();
    agv.my_function_list().serve(MastServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = MastClient::at(&peer);
    assert_eq!(client.count().wait(), Ok(()));
    let held = client.renewing(Renew::Process).lift().hold().wait().unwrap();
    assert!(held.is_held());
    let order = agv.with_state(Option::take).unwrap().expect("its lease is told");
    assert!(order.is_live() && agv.end_order(&order));
    assert!(!order.is_live() && !agv.end_order(&order));
    until("its caller is told", || !held.is_held());
    manager.stop();
    agv.stop();
}

/// An order as VDA 5050 has it. There an action has parameters, which would be lists in lists deeper than a signature has them.
#[derive(Variables, serde::Serialize, serde::Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
struct Order {
    header_id: u32,
    #[size(24)]
    timestamp: String,
    #[size(36)]
    order_id: String,
    order_update_id: u32,
    #[size(64)]
    nodes: Vec<Node>,
    #[size(63)]
    edges: Vec<Edge>,
}

#[derive(Variables, serde::Serialize, serde::Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
struct Node {
    #[size(32)]
    node_id: String,
    sequence_id: u32,
    released: bool,
    node_position: Option<Position>,
    #[size(4)]
    actions: Vec<Action>,
}

#[derive(Variables, serde::Serialize, serde::Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
struct Position {
    x: f64,
    y: f64,
    theta: f64,
    #[size(32)]
    map_id: String,
}

#[derive(Variables, serde::Serialize, serde::Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
struct Edge {
    #[size(32)]
    edge_id: String,
    sequence_id: u32,
    released: bool,
    #[size(32)]
    start_node_id: String,
    #[size(32)]
    end_node_id: String,
    max_speed: Option<f64>,
    #[size(4)]
    actions: Vec<Action>,
}

#[derive(Variables, serde::Serialize, serde::Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
struct Action {
    #[size(32)]
    action_type: String,
    #[size(36)]
    action_id: String,
    blocking_type: Blocking,
}

#[derive(Variables, serde::Serialize, serde::Deserialize, Clone, Copy, Debug, PartialEq)]
#[serde(rename_all = "UPPERCASE")]
enum Blocking {
    None,
    Soft,
    Hard,
}

#[interface]
trait Planned {
    #[returns(count, last)]
    fn plan(&mut self, #[variables] order: Order) -> Result<(u32, Option<Node>), ServiceError>;

    fn planned(&self) -> Order;
}

impl Planned for Order {
    fn plan(&mut self, order: Order) -> Result<(u32, Option<Node>), ServiceError> {
        *self = order;
        Ok((u32::try_from(self.nodes.len()).map_err(|_| ServiceError::NotReady)?, self.nodes.last().cloned()))
    }

    fn planned(&self) -> Order {
        self.clone()
    }
}

impl Order {
    /// 50 nodes and the 49 edges between them, each with an action.
    fn of_50_nodes() -> Self {
        let action = |kind: &str, sequence: u32, blocking_type| Action {
            action_type: kind.into(),
            action_id: format!("action-{sequence:04}"),
            blocking_type,
        };
        let node = |index: u32| Node {
            node_id: format!("node-{index:02}"),
            sequence_id: 2 * index,
            released: index < 20,
            node_position: Some(Position {
                x: 1.25 * f64::from(index),
                y: -0.1 * f64::from(index),
                theta: 1.2508,
                map_id: "hall-7".into(),
            }),
            actions: vec![action("pick", 2 * index, Blocking::Hard)],
        };
        let edge = |index: u32| Edge {
            edge_id: format!("edge-{index:02}"),
            sequence_id: 2 * index + 1,
            released: index < 19,
            start_node_id: format!("node-{index:02}"),
            end_node_id: format!("node-{:02}", index + 1),
            max_speed: (index.is_multiple_of(2)).then_some(1.5),
            actions: vec![action("beep", 2 * index + 1, if index == 7 { Blocking::Soft } else { Blocking::None })],
        };
        Self {
            header_id: 1,
            timestamp: "2026-11-25T04:45:00.000Z".into(),
            order_id: "order-000017".into(),
            order_update_id: 0,
            nodes: (0..50).map(node).collect(),
            edges: (0..49).map(edge).collect(),
        }
    }
}

#[test]
fn an_order_of_50_nodes_comes_as_it_was_sent() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(Order::default()).build().unwrap());
    agv.my_function_list().serve(PlannedServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = PlannedClient::at(&peer);
    let order = Order::of_50_nodes();
    assert_eq!(client.planned().wait(), Ok(Order::default()));
    assert_eq!(client.plan(order.clone()).wait(), Ok((50, order.nodes.last().cloned())));
    // It takes more than a client puts on its stack.
    assert_eq!(client.planned().cancelled_by(&Canceller::new()).wait(), Ok(order.clone()));
    assert_eq!(client.planned().wait(), Ok(order.clone()));
    let none = Order { nodes: vec![], ..order };
    assert_eq!(client.plan(none.clone()).wait(), Ok((0, None)));
    assert_eq!(client.planned().wait(), Ok(none));
    manager.stop();
    agv.stop();
}

/// A board's messages have 1 KiB.
#[test]
fn an_order_that_a_peer_has_no_room_for_is_refused_before_it_is_sent() {
    let fleet = fleet();
    let small = Constraints { message_size: 1024, ..Constraints::S_UNIT };
    let agv = unit("agv", 7, fleet).constraints(small).state(Order::default()).build().unwrap();
    let manager = system(fleet).build().unwrap();
    agv.my_function_list().serve(PlannedServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = PlannedClient::at(&peer);
    let sent = manager.counted(LinkCounter::MessagesSent);
    let order = Order::of_50_nodes();
    assert_eq!(client.plan(order.clone()).wait(), Err(Error::TooLarge { limit: 1024 }.into()));
    assert_eq!(manager.counted(LinkCounter::MessagesSent), sent);
    assert_eq!(client.planned().wait(), Ok(Order::default()));
    let short = Order { nodes: order.nodes[..2].to_vec(), edges: order.edges[..1].to_vec(), ..order };
    assert_eq!(client.plan(short.clone()).wait(), Ok((2, short.nodes.last().cloned())));
    manager.stop();
    agv.stop();
}

/// The unit could have been built without lists.
#[test]
fn an_order_is_not_sent_to_a_function_without_lists() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let plan = Definition::parse("plan(nodes: string[32]) -> (count: int)").unwrap();
    let run = |_: &cara_std::Served, _: &mut cara_std::ParametersView| -> Result<(), ServiceError> { unreachable!() };
    agv.my_function_list().add_service(&plan, ServiceOptions::new(), run).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let sent = manager.counted(LinkCounter::MessagesSent);
    let reported = PlannedClient::at(&peer).plan(Order::of_50_nodes()).wait().unwrap_err();
    assert_eq!(
        reported.to_string(),
        "the peer's plan is of another version: its argument nodes is string[32] there and a list of at most 64 here: update one of the two"
    );
    let mut order = Parameters::<100_000>::sized();
    Order::of_50_nodes().to_parameters(&mut order).unwrap();
    assert_eq!(peer.block_request("plan", &mut order), Err(Error::WrongType { index: 0 }));
    assert_eq!(manager.counted(LinkCounter::MessagesSent), sent);
    manager.stop();
    agv.stop();
}

/// Bytes of an order's block, of JSON and of postcard.
#[test]
fn an_order_of_50_nodes_takes_so_many_bytes() {
    let order = Order::of_50_nodes();
    let block = order.with_parameters(|variables| {
        let order = Definition::new("order").unwrap().arguments(variables).unwrap();
        block::measure(order.signature().arguments(), variables).unwrap()
    });
    let json = serde_json::to_vec(&order).unwrap().len();
    let postcard = postcard::to_allocvec(&order).unwrap().len();
    assert_eq!((block, json, postcard), (Ok(13_360), 20_082, 5_546));
}

/// Prints how long an order takes to be written and read again, in each form, and by a call to another unit and back: run it with
/// `--release --nocapture`.
#[test]
fn an_order_of_50_nodes_is_timed() {
    let order = Order::of_50_nodes();
    let definition =
        order.with_parameters(|order| Definition::new("order").unwrap().arguments(order).unwrap()).unwrap();
    let specs = || definition.signature().arguments();
    let mut read = Parameters::<100_000>::sized();
    let forms: [(&str, &mut dyn FnMut() -> Order); 3] = [
        ("a block", &mut || {
            let block = order.with_parameters(|order| {
                let mut bytes = vec![0; block::measure(specs(), order).unwrap()];
                block::write(specs(), order, &mut SliceWriter::new(&mut bytes));
                bytes
            });
            block::read_arguments(specs(), &block.unwrap(), &mut read).unwrap();
            Order::from_parameters(&read).unwrap()
        }),
        ("JSON", &mut || serde_json::from_slice(&serde_json::to_vec(&order).unwrap()).unwrap()),
        ("postcard", &mut || postcard::from_bytes(&postcard::to_allocvec(&order).unwrap()).unwrap()),
    ];
    for (form, write_and_read) in forms {
        assert_eq!(write_and_read(), order, "{form}");
        println!("{form}: {:?}", median(|| drop(write_and_read())));
    }
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(Order::default()).build().unwrap());
    agv.my_function_list().serve(PlannedServer).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = PlannedClient::at(&peer);
    println!("a call with it: {:?}", median(|| assert!(client.plan(order.clone()).wait().is_ok())));
    println!("a ping: {:?}", median(|| assert!(peer.ping(Duration::from_secs(5)).is_ok())));
    manager.stop();
    agv.stop();
}

fn median(mut act: impl FnMut()) -> std::time::Duration {
    let mut times: Vec<_> = (0..51)
        .map(|_| {
            let began = std::time::Instant::now();
            act();
            began.elapsed()
        })
        .collect();
    times.sort_unstable();
    times[times.len() / 2]
}
