//! The control socket of a running m_unit, from its client's side.

use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, Question};
use cara_std::control::{Client, Control};
use cara_std::{CommunicationSystem, Interfaces};

#[test]
fn first() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("deep/x.sock");
    let system = CommunicationSystem::builder("manager", 1).unwrap().fleet(77).interfaces(Interfaces::Loopback);
    let system = system.control(Control::Path(path.clone())).build_system().unwrap();
    system.start().unwrap();
    let mut client = Client::connect(&path).unwrap();
    for question in [Question::Unit, Question::Nodes { offering: None }, Question::Counters { node: None }, Question::Functions { node: "x".into() }] {
        for answer in client.ask(&question).unwrap() {
            println!("{answer:?}");
        }
    }
    let _ = (Duration::ZERO, Instant::now(), Answer::Done);
    system.stop();
    assert!(!path.exists());
}
