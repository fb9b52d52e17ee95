//! A node that was written from `docs/wire.md`, in Python, joins a manager of the Linux port, in plain and in secured mode.
//!
//! On loopback, in fleets of their own. Every wait is bounded.

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use cara_processes::{Process, random_fleet, skip};
use cara_std::{Builder, CommunicationSystem, Error, Identity, Interfaces, MUnit, Parameters, Renew, RequestOptions};
use cara_test_keys::KeyFolder;

const PATIENCE: Duration = Duration::from_secs(20);

/// The Python node, with these options; `None` where there is no Python.
fn python(fleet: u32, options: &[&str]) -> Option<Process> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/node.py");
    let fleet = fleet.to_string();
    let arguments = [&[script, "--fleet", &fleet, "--manager", "python_manager/1"], options].concat();
    match Process::start("node.py", Path::new("python3"), arguments) {
        Ok(node) => Some(node),
        Err(_) => {
            skip("python3 is not installed");
            None
        }
    }
}

fn builder(fleet: u32) -> Builder<(), MUnit> {
    CommunicationSystem::builder("python_manager", 1).unwrap().fleet(fleet).interfaces(Interfaces::Loopback)
}

fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < end, "{what} did not happen");
        thread::sleep(Duration::from_millis(20));
    }
}

fn position(manager: &CommunicationSystem) -> [i64; 2] {
    let mut pos = Parameters::new();
    pos.add_int("position", 2).unwrap();
    manager.s_units()[0].block_request("pos_info", &mut pos).unwrap();
    pos.variable("position").unwrap()
}

/// What the counters of the link to the node say.
fn counted(manager: &CommunicationSystem, counter: &str) -> u64 {
    let counters = manager.s_units()[0].counters();
    counters.iter().find(|(name, _)| *name == counter).map(|(_, count)| *count).unwrap()
}

/// The whole conversation, until the manager stops.
fn talk(mut node: Process, manager: &CommunicationSystem, while_leased: impl FnOnce(&mut Process)) {
    wait_until("joining", || manager.number_of_s_units() == 1);
    let agv = manager.s_units()[0].clone();
    assert_eq!((agv.name(), agv.id()), ("agv_in_python", 77));
    assert!(agv.wait_for_function("go_to", PATIENCE));
    assert_eq!(position(manager), [3, -4]);
    node.seen("datagrams pass", PATIENCE).unwrap();

    // The lease of a second is renewed for longer than it lasts, then given up.
    let mut target = Parameters::new();
    target.add_int("position", 2).unwrap();
    target.set_value("position", [1, 2]).unwrap();
    let wanted = RequestOptions::renewing(Renew::Process);
    agv.call("go_to", &mut target).with(wanted).send().unwrap();
    assert_eq!(node.expect("run go_to", PATIENCE).unwrap().text, "run go_to {'position': [1, 2]}");
    while_leased(&mut node);
    assert_eq!(position(manager), [1, 2]);
    // An operator does not get what the program holds, unless it takes over.
    let operators = |take_over| {
        let options = RequestOptions { operator: true, take_over, ..wanted };
        agv.call("go_to", &mut target.clone()).with(options).wait()
    };
    assert_eq!(operators(false), Err(Error::Held { by: 1, operator: false }.into()));
    assert!(!node.has("replaced"), "{:?}", node.lines());
    assert_eq!(operators(true), Ok(()));
    node.expect("renewals: replaced", PATIENCE).unwrap();
    let programs = agv.call("go_to", &mut target.clone()).with(wanted).wait();
    assert_eq!(programs, Err(Error::Held { by: 1, operator: true }.into()));
    agv.release("go_to").unwrap();
    node.expect("released", PATIENCE).unwrap();
    assert!(!node.has("expired"), "{:?}", node.lines());

    let mut arguments = Parameters::new();
    arguments.add_string("fault", 64).unwrap();
    arguments.add_int("minutes", 1).unwrap();
    manager.my_function_list().add_function("call_mechanic", &arguments, |arguments: Parameters| arguments).unwrap();
    manager.publish_my_function_list().unwrap();
    node.expect("call_mechanic {'fault': 'flat tyre', 'minutes': [7]}", PATIENCE).unwrap();

    wait_until("a datagram", || counted(manager, "DatagramsReceived") > 0);
    for never in ["DatagramsDropped", "DatagramsForged", "DatagramsRepeated", "FramesRefused", "ItemsSkipped"] {
        assert_eq!(counted(manager, never), 0, "{never}");
    }
    manager.stop();
    node.expect("ended close 1", PATIENCE).unwrap();
    assert!(node.wait(PATIENCE).unwrap().success());
}

#[test]
fn a_node_written_from_the_document_joins_a_manager() {
    let fleet = random_fleet();
    let Some(node) = python(fleet, &["--insecure"]) else { return };
    let manager = builder(fleet).insecure().build().unwrap();
    manager.start().unwrap();
    talk(node, &manager, |_| thread::sleep(Duration::from_secs(2)));
}

/// The same as the test above, on a secured link, which the node rekeys about once a second.
#[test]
fn a_node_written_from_the_document_joins_a_secured_manager() {
    let fleet = random_fleet();
    let keys = KeyFolder::draw(fleet, &["python_manager/1@m_unit", "agv_in_python/77"]).unwrap();
    let folder = keys.path().display().to_string();
    let Some(node) = python(fleet, &["--keys", &folder, "--renew", "1"]) else { return };
    let file = keys.file(&Identity::m_unit("python_manager", 1).unwrap()).unwrap();
    let manager = builder(fleet).key_file(file).build().unwrap();
    manager.start().unwrap();
    talk(node, &manager, |node| {
        // The lease is renewed under each of these keys.
        for _ in 0..3 {
            node.expect("new keys", PATIENCE).unwrap();
        }
        wait_until("new keys", || counted(&manager, "KeysRenewed") >= 3);
    });
}
