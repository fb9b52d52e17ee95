//! Network namespaces: a test runs itself again in one, and a far host is this binary once more in another one.

use std::io::{Read, Write};
use std::process::{Child, ChildStdin, Command, Stdio};

use cara_processes::network::{self, Namespace};
use cara_std::control::Control;
use cara_std::{CommunicationSystem, Unit};

use crate::datagrams::{MANAGER, VEHICLE};

/// What a far host is.
const PART: &str = "CARA_TEST_PART";

/// Runs `test`, which has this `name`, in a network namespace of its own.
pub(crate) fn inside(name: &str, programs: &[&str], test: impl FnOnce()) {
    if network::test(name, programs, false) {
        test();
    }
}

/// Another host: a process in a namespace of its own, which begins with its part when it is told to.
pub(crate) struct Peer {
    child: Child,
    input: ChildStdin,
}

impl Peer {
    pub(crate) fn start(part: &[&str]) -> Self {
        let mut command = Command::new("unshare");
        command.env("PATH", network::paths()).arg("--net").arg(std::env::current_exe().unwrap());
        command.args(["--exact", "namespace::as_peer", "--ignored", "--nocapture"]).env(PART, part.join(" "));
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let input = child.stdin.take().unwrap();
        // It runs in its namespace once it has said something.
        let mut byte = [0];
        child.stdout.as_mut().unwrap().read_exact(&mut byte).unwrap();
        Self { child, input }
    }

    pub(crate) fn process(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn network(&self) -> Namespace {
        Namespace::of(self.child.id()).unwrap()
    }

    /// Its network is ready.
    pub(crate) fn go(&self) {
        (&self.input).write_all(b"go\n").unwrap();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
#[ignore = "run by the other tests here, in processes of their own"]
fn as_peer() {
    let part = std::env::var(PART).expect("the part to play");
    let words: Vec<&str> = part.split(' ').collect();
    let [part, fleet, port, keys] = words[..] else { panic!("{part}") };
    let mut input = std::io::stdin();
    input.read_exact(&mut [0; 3]).unwrap();
    let (fleet, port): (u32, u16) = (fleet.parse().unwrap(), port.parse().unwrap());
    let _unit: Box<dyn std::any::Any> = match part {
        MANAGER => {
            let system = CommunicationSystem::builder("boss", 1).unwrap().fleet(fleet).discovery_port(port);
            let system = system.control(Control::Off).key_file(keys).build().unwrap();
            system.start().unwrap();
            Box::new(system)
        }
        VEHICLE => {
            let unit = Unit::builder("agv", 7, "boss", 1).unwrap().fleet(fleet).discovery_port(port);
            let unit = unit.key_file(keys).build().unwrap();
            unit.start().unwrap();
            Box::new(unit)
        }
        part => panic!("{part}"),
    };
    // Until the other end goes.
    let _ = input.read_to_end(&mut Vec::new());
}
