//! A node that was written from `docs/wire.md`, in Python, joins a manager of the Linux port.
//!
//! On loopback, in a fleet of its own. Every wait is bounded.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use cara_std::{CommunicationSystem, Interfaces, Parameters};

const PATIENCE: Duration = Duration::from_secs(20);

/// The Python node, and the lines that it says.
struct PythonNode {
    child: Child,
    lines: Receiver<String>,
    said: Vec<String>,
}

impl PythonNode {
    /// `None` where there is no Python.
    fn start(fleet: u32) -> Option<Self> {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/node.py");
        let mut child = Command::new("python3")
            .args([script, "--fleet", &fleet.to_string(), "--manager", "python_manager/1"])
            .stdout(Stdio::piped())
            .spawn()
            .ok()?;
        let stdout = BufReader::new(child.stdout.take()?);
        let (sender, lines) = channel();
        thread::spawn(move || stdout.lines().map_while(Result::ok).for_each(|line| drop(sender.send(line))));
        Some(Self { child, lines, said: Vec::new() })
    }

    /// Waits for a line that begins so.
    fn says(&mut self, beginning: &str) -> String {
        let end = Instant::now() + PATIENCE;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            let line = self.lines.recv_timeout(left).unwrap_or_else(|_| panic!("no {beginning:?} in {:?}", self.said));
            self.said.push(line.clone());
            if line.starts_with(beginning) {
                return line;
            }
        }
    }
}

impl Drop for PythonNode {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
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

#[test]
fn a_node_written_from_the_document_joins_a_manager() {
    let fleet = std::process::id() ^ 0x5AFE_0000;
    let Some(mut node) = PythonNode::start(fleet) else {
        eprintln!("skipped: there is no python3");
        return;
    };
    let manager = CommunicationSystem::builder("python_manager", 1).unwrap().fleet(fleet);
    // The node in Python has no cipher.
    let manager = manager.interfaces(Interfaces::Loopback).insecure().build().unwrap();
    manager.start().unwrap();

    wait_until("joining", || manager.number_of_s_units() == 1);
    let agv = manager.s_units()[0].clone();
    assert_eq!((agv.name(), agv.id()), ("agv_in_python", 77));
    assert!(agv.wait_for_function("go_to", PATIENCE));
    assert_eq!(position(&manager), [3, -4]);
    node.says("datagrams pass");

    // The lease of 400 ms is renewed for longer than it lasts, then given up.
    let mut target = Parameters::new();
    target.add_int("position", 2).unwrap();
    target.set_value("position", [1, 2]).unwrap();
    agv.request("go_to", &target).unwrap();
    assert_eq!(node.says("run go_to"), "run go_to {'position': [1, 2]}");
    thread::sleep(Duration::from_millis(1_000));
    assert_eq!(position(&manager), [1, 2]);
    agv.release("go_to").unwrap();
    node.says("released");
    assert!(!node.said.iter().any(|line| line.starts_with("stopped")), "{:?}", node.said);

    let mut arguments = Parameters::new();
    arguments.add_string("fault", 64).unwrap();
    arguments.add_int("minutes", 1).unwrap();
    manager.my_function_list().add_function("call_mechanic", &arguments, |arguments: Parameters| arguments).unwrap();
    manager.publish_my_function_list().unwrap();
    assert_eq!(node.says("call_mechanic"), "call_mechanic {'fault': 'flat tyre', 'minutes': [7]}");

    manager.stop();
    assert_eq!(node.says("ended"), "ended close 1");
    assert!(node.child.wait().unwrap().success());
}
