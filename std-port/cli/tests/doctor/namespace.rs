//! Network namespaces: a test runs itself again in one, and a far host is this binary once more in another one.

use std::io::{Read, Write};
use std::process::{Child, ChildStdin, Command, Stdio};

use cara_processes::network;
use cara_std::CommunicationSystem;
use cara_std::control::Control;

use crate::datagrams::MANAGER;

/// What a far host is.
const PART: &str = "CARA_TEST_PART";
/// Where Debian keeps the programs, which is not on everybody's path.
const PATHS: &str = "/usr/sbin:/sbin:/usr/bin:/bin";

/// Runs `test`, which has this `name`, in a network namespace of its own.
pub(crate) fn inside(name: &str, programs: &[&str], test: impl FnOnce()) {
    if network::test(name, programs, false) {
        test();
    }
}

/// `ip` with these words.
pub(crate) fn ip(words: &str) {
    run(Command::new("ip").args(words.split(' ')));
}

/// A rule in a chain of all that comes in (`input`) or goes out (`output`).
pub(crate) fn nft(hook: &str, rule: &str) {
    run(Command::new("nft").arg(ruleset(hook, rule)));
}

fn ruleset(hook: &str, rule: &str) -> String {
    format!("table inet cara {{\nchain {hook} {{\ntype filter hook {hook} priority 0\n{rule}\n}}\n}}\n")
}

fn run(command: &mut Command) {
    let status = command.env("PATH", PATHS).status().unwrap();
    assert!(status.success(), "{command:?}");
}

/// Another host: a process in a namespace of its own, which begins with its part when it is told to.
pub(crate) struct Peer {
    child: Child,
    input: ChildStdin,
}

impl Peer {
    pub(crate) fn start(part: &[&str]) -> Self {
        let mut command = Command::new("unshare");
        command.env("PATH", PATHS).arg("--net").arg(std::env::current_exe().unwrap());
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

    pub(crate) fn ip(&self, words: &str) {
        run(self.enter().arg("ip").args(words.split(' ')));
    }

    pub(crate) fn nft(&self, hook: &str, rule: &str) {
        run(self.enter().arg("nft").arg(ruleset(hook, rule)));
    }

    pub(crate) fn no_firewall(&self) {
        run(self.enter().args(["nft", "flush", "ruleset"]));
    }

    fn enter(&self) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--target", &self.child.id().to_string(), "--net"]);
        command
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
    let [MANAGER, fleet, port, keys] = words[..] else { panic!("{part}") };
    let mut input = std::io::stdin();
    input.read_exact(&mut [0; 3]).unwrap();
    let system = CommunicationSystem::builder("boss", 1).unwrap().fleet(fleet.parse().unwrap());
    let system =
        system.discovery_port(port.parse().unwrap()).control(Control::Off).key_file(keys).build_system().unwrap();
    system.start().unwrap();
    // Until the other end goes.
    let _ = input.read_to_end(&mut Vec::new());
}
