//! A manager with a control socket of its own, and vehicles.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex};
use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, Argument, ArgumentValue, CallQuestion, Failure, Question};
use cara_std::control::{Client, Control, ControlError};
use cara_std::{
    Builder, CommunicationSystem, Identity, Interfaces, MUnit, ParametersView, Priority, SUnit, Served, ServiceError,
    ServiceOptions, Unit,
};
use tempfile::TempDir;

use crate::keyed::keyed;

/// Longest wait for anything that is to happen.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);
/// The arguments and results of `echo`.
pub(crate) const EVERY_TYPE: &str = "(i: int[2], f: float[4], s: string[20], b: bool[2], y: bytes[8])";

/// Waits until `condition` holds.
pub(crate) fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A fleet of its own.
pub(crate) fn fleet() -> u32 {
    RandomState::new().build_hasher().finish() as u32
}

/// A directory that its owner alone enters.
pub(crate) fn directory() -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    std::fs::set_permissions(directory.path(), std::fs::Permissions::from_mode(0o700)).unwrap();
    directory
}

/// A gate that handlers wait at.
#[derive(Default)]
pub(crate) struct Gate(Mutex<bool>, Condvar);

impl Gate {
    pub(crate) fn open(&self) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }

    fn pass(&self) {
        let open = self.0.lock().unwrap();
        let _open = self.1.wait_timeout_while(open, PATIENCE, |open| !*open).unwrap();
    }
}

/// A running manager with its socket.
pub(crate) struct Depot {
    pub(crate) fleet: u32,
    pub(crate) directory: TempDir,
    pub(crate) system: CommunicationSystem,
    pub(crate) gate: std::sync::Arc<Gate>,
}

impl Depot {
    pub(crate) fn new() -> Self {
        Self::of(|fleet, directory| manager("manager", 1, fleet).control(Control::Path(directory.join("manager.sock"))))
    }

    /// With a manager of the caller's making, by fleet and directory.
    pub(crate) fn of(manager: impl FnOnce(u32, &Path) -> Builder<(), MUnit>) -> Self {
        let fleet = fleet();
        let directory = directory();
        let system = manager(fleet, directory.path()).build().unwrap();
        system.start().unwrap();
        // All have keys, and each test starts those that it is about.
        system.roster().iter().for_each(|absent| assert!(absent.retire()));
        Self { fleet, directory, system, gate: Default::default() }
    }

    /// A depot with one vehicle, `agv/7`.
    pub(crate) fn with_agv() -> (Self, Unit) {
        let depot = Self::new();
        let agv = depot.agv("agv", 7);
        (depot, agv)
    }

    pub(crate) fn path(&self) -> PathBuf {
        self.directory.path().join("manager.sock")
    }

    pub(crate) fn client(&self) -> Client {
        Client::connect(&self.path()).unwrap()
    }

    /// A vehicle that has joined and published `echo`, `fail`, `slow` and `go_to`.
    pub(crate) fn agv(&self, name: &str, id: u32) -> Unit {
        let agv = vehicle(name, id, self.fleet).build().unwrap();
        let list = agv.my_function_list();
        let echo = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let fail = |_: &Served, _: &mut ParametersView| Err(ServiceError::Failed(4));
        let gate = self.gate.clone();
        let slow = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            gate.pass();
            Ok(())
        };
        let leased = ServiceOptions::new().priority(Priority::High).idempotent().lease(Duration::from_secs(2), || {});
        list.add_service(&format!("echo{EVERY_TYPE} -> {EVERY_TYPE}").parse().unwrap(), ServiceOptions::new(), echo)
            .unwrap();
        list.add_service(&"fail()".parse().unwrap(), ServiceOptions::new(), fail).unwrap();
        list.add_service(&"slow()".parse().unwrap(), ServiceOptions::new(), slow).unwrap();
        list.add_service(&"go_to(position: int[2])".parse().unwrap(), leased, echo).unwrap();
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
        until("it has published", || {
            let peer = self.system.s_units().into_iter().find(|peer| peer.name() == name && peer.id() == id);
            peer.is_some_and(|peer| peer.their_function_list().len() == 4)
        });
        // Its list goes out before its end of the link counts as joined.
        until("it knows its manager", || agv.manager().is_some_and(|manager| manager.is_connected()));
        agv
    }
}

pub(crate) fn manager(name: &str, id: u32, fleet: u32) -> Builder<(), MUnit> {
    let builder = CommunicationSystem::builder(name, id).unwrap().interfaces(Interfaces::Loopback);
    keyed(builder, fleet, &Identity::m_unit(name, id).unwrap(), &vehicles())
}

pub(crate) fn vehicle(name: &str, id: u32, fleet: u32) -> Builder<(), SUnit> {
    vehicle_of(("manager", 1), name, id, fleet)
}

/// A vehicle that joins another manager than `manager/1`.
pub(crate) fn vehicle_of(manager: (&str, u32), name: &str, id: u32, fleet: u32) -> Builder<(), SUnit> {
    let own = Identity::s_unit(name, id).unwrap();
    assert!(vehicles().contains(&own), "the managers have no key for {own}: name it in vehicles");
    let builder = Unit::builder(name, id, manager.0, manager.1).unwrap().interfaces(Interfaces::Loopback);
    keyed(builder, fleet, &own, &[Identity::m_unit(manager.0, manager.1).unwrap()])
}

/// All vehicles of these tests.
fn vehicles() -> Vec<Identity> {
    let numbered = (0..4).map(|id| (format!("agv{id}"), id));
    let named =
        [("agv", 7), ("duplicate", 7), ("duplicate", 8), ("lone-agv", 9)].map(|(name, id)| (name.to_owned(), id));
    let all = named.into_iter().chain(numbered);
    all.map(|(name, id)| Identity::s_unit(&name, id).unwrap()).collect()
}

/// All answers to a question, or why there are none.
pub(crate) fn ask(client: &mut Client, question: Question) -> Result<Vec<Answer>, Failure> {
    match client.ask(&question).unwrap().collect() {
        Ok(answers) => Ok(answers),
        Err(ControlError::Failed(failure)) => Err(failure),
        Err(error) => panic!("{question:?}: {error}"),
    }
}

/// The name of the error.
pub(crate) fn refused(client: &mut Client, question: Question) -> String {
    let failure = ask(client, question.clone()).expect_err(&format!("{question:?}"));
    assert!(!failure.text.is_empty(), "{failure:?}");
    failure.error
}

pub(crate) fn call(node: Option<&str>, function: &str, arguments: Vec<Argument>) -> CallQuestion {
    CallQuestion {
        node: node.map(str::to_owned),
        function: function.to_owned(),
        arguments,
        asynchronous: false,
        timeout_ms: Some(20_000),
        priority: None,
        best_effort: false,
        take_over: false,
        progress: false,
    }
}

pub(crate) fn argument(name: &str, size: u32, value: ArgumentValue) -> Argument {
    Argument { name: name.to_owned(), size, value }
}

pub(crate) fn ping(node: &str, count: u32, timeout_ms: u64) -> Question {
    Question::Ping { node: node.to_owned(), count, pause_us: 1_000, timeout_ms }
}
