//! Network namespaces: a test runs itself again in one, and a far host is this binary once more in another one.

use std::io::{Read, Write};
use std::process::{Child, ChildStdin, Command, Stdio};

use cara_std::CommunicationSystem;
use cara_std::control::Control;

use crate::datagrams::MANAGER;

/// Set inside the namespace.
const INSIDE: &str = "CARA_TEST_INSIDE";
/// What a far host is.
const PART: &str = "CARA_TEST_PART";
/// Where Debian keeps the programs, which is not on everybody's path.
const PATHS: &str = "/usr/sbin:/sbin:/usr/bin:/bin";

/// Runs `test`, which has this `name`, in a network namespace of its own, if the system lets this user make one and has
/// the programs that the test needs. What cannot be had is said, and fails where `CI` is set.
pub(crate) fn inside(name: &str, programs: &[&str], test: impl FnOnce()) {
    if std::env::var_os(INSIDE).is_some() {
        return test();
    }
    if let Some(reason) = missing(programs) {
        // Past the test's captured output, so that it is seen.
        std::io::stderr().write_all(format!("skipped {name}: {reason}\n").as_bytes()).unwrap();
        assert!(std::env::var_os("CI").is_none(), "skipped: {reason}");
        return;
    }
    let status = unshare(&["--user", "--map-root-user", "--net"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", name, "--nocapture", "--test-threads=1"])
        .env(INSIDE, "1")
        .status()
        .unwrap();
    assert!(status.success(), "it failed inside the namespace");
}

fn unshare(arguments: &[&str]) -> Command {
    let mut command = Command::new("unshare");
    command.env("PATH", PATHS).arg("--kill-child").arg("--fork").args(arguments);
    command
}

fn missing(programs: &[&str]) -> Option<String> {
    let works = |command: &mut Command| {
        command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
    };
    if !works(unshare(&["--user", "--map-root-user", "--net"]).arg("true")) {
        return Some("`unshare --user --net` does not work here".into());
    }
    let there = |program: &&&str| PATHS.split(':').any(|path| std::path::Path::new(path).join(program).is_file());
    let absent = ["ip"].iter().chain(programs).find(|program| !there(program))?;
    Some(format!("the program `{absent}` is not installed"))
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
    let [MANAGER, fleet, port] = words[..] else { panic!("{part}") };
    let mut input = std::io::stdin();
    input.read_exact(&mut [0; 3]).unwrap();
    let system = CommunicationSystem::builder("boss", 1).unwrap().fleet(fleet.parse().unwrap());
    let system = system.discovery_port(port.parse().unwrap()).control(Control::Off).build_system().unwrap();
    system.start().unwrap();
    // Until the other end goes.
    let _ = input.read_to_end(&mut Vec::new());
}
