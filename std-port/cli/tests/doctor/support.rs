//! Units on loopback with a fleet and a port of their own, and the doctor that is called to them.

use std::fs::Permissions;
use std::net::{Ipv4Addr, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cara_std::control::Control;
use cara_std::keys::{FleetKeys, KeyRing, Store, location};
use cara_std::{Builder, CommunicationSystem, Constraints, Fleet, Identity, Interfaces, MUnit, SUnit, Unit};
use serde_json::Value;

use crate::datagrams::Search;
use crate::namespace::Peer;

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(180);

/// A network of its own.
pub(crate) struct Clinic {
    pub(crate) fleet: u32,
    pub(crate) port: u16,
    sockets: tempfile::TempDir,
    /// Where the fleet's root is, and the files of all nodes.
    keys: tempfile::TempDir,
    loopback: bool,
}

impl Clinic {
    pub(crate) fn new() -> Self {
        Self { loopback: true, ..Self::on_all_interfaces() }
    }

    /// For inside a namespace alone.
    pub(crate) fn on_all_interfaces() -> Self {
        let (sockets, keys, fleet) = (private_directory(), private_directory(), cara_processes::random_fleet());
        Store::create(keys.path(), draw(fleet)).unwrap().save().unwrap();
        Self { fleet, port: cara_processes::discovery_port(), sockets, keys, loopback: false }
    }

    /// A builder of an m_unit `name/1`.
    pub(crate) fn system(&self, name: &str) -> Builder<(), MUnit> {
        let system = CommunicationSystem::builder(name, 1).unwrap().fleet(self.fleet).discovery_port(self.port);
        let socket = self.sockets.path().join(format!("{name}.sock"));
        let system = system.keys(self.ring(&Identity::m_unit(name, 1).unwrap()));
        system.interfaces(Interfaces::Loopback).control(Control::Path(socket))
    }

    /// A running manager `name/1`.
    pub(crate) fn manager(&self, name: &str, maximum_nodes: u16) -> CommunicationSystem {
        let constraints = Constraints { maximum_nodes, ..Constraints::M_UNIT };
        let manager = self.system(name).constraints(constraints).build().unwrap();
        manager.start().unwrap();
        manager
    }

    /// A manager `boss/1` in a process of its own, which may open few files.
    pub(crate) fn manager_of_few_files(&self, files: u32) -> Killed {
        let mut command = Command::new("sh");
        command.args([
            "-c",
            "ulimit -n \"$1\"; shift; exec \"$@\"",
            "sh",
            &files.to_string(),
            env!("CARGO_BIN_EXE_cara"),
        ]);
        command.args(["node", "--name", "boss", "--id", "1", "--loopback", "--fleet", &self.fleet.to_string()]);
        command.arg("--key-file").arg(self.key_file("boss"));
        command.args(["--discovery-port", &self.port.to_string()]).env("CARA_CONTROL_DIR", self.sockets.path());
        command.stdout(Stdio::null()).stderr(Stdio::null());
        Killed(command.spawn().unwrap())
    }

    /// An s_unit of the manager `manager/1`.
    pub(crate) fn unit(&self, name: &str, id: u32, manager: &str) -> Builder<(), SUnit> {
        let unit = Unit::builder(name, id, manager, 1).unwrap().fleet(self.fleet).discovery_port(self.port);
        unit.keys(self.ring(&Identity::s_unit(name, id).unwrap())).interfaces(Interfaces::Loopback)
    }

    /// The keys of a node of [`draw`], as they are in the folder now.
    pub(crate) fn ring(&self, identity: &Identity) -> KeyRing {
        self.root().ring(identity).unwrap()
    }

    /// The fleet's root.
    pub(crate) fn root(&self) -> FleetKeys {
        Store::peek(self.keys.path(), Fleet(self.fleet)).unwrap()
    }

    /// The same, to be changed.
    pub(crate) fn store(&self) -> Store {
        Store::open(self.keys.path(), Fleet(self.fleet)).unwrap()
    }

    /// The file with the keys of the m_unit `name/1`.
    pub(crate) fn key_file(&self, name: &str) -> PathBuf {
        self.key_file_of(&Identity::m_unit(name, 1).unwrap())
    }

    /// The file with the keys of any node.
    pub(crate) fn key_file_of(&self, identity: &Identity) -> PathBuf {
        self.keys.path().join(location::file_name(identity, Fleet(self.fleet)))
    }

    /// Another host on which this node plays its part once it is told to.
    pub(crate) fn peer(&self, part: &str, identity: &Identity) -> Peer {
        let (fleet, port) = (self.fleet.to_string(), self.port.to_string());
        Peer::start(&[part, &fleet, &port, self.key_file_of(identity).to_str().unwrap()])
    }

    pub(crate) fn started(&self, unit: Builder<(), SUnit>) -> Unit {
        let unit = unit.build().unwrap();
        unit.start().unwrap();
        unit
    }

    /// A search of an s_unit that is not there, for `boss/1`.
    pub(crate) fn search(&self, name: &'static str, id: u8, epoch: u8) -> Search {
        Search::new(self.fleet, self.port, self.root().discovery(1), name, id, epoch)
    }

    /// Any datagram.
    pub(crate) fn send(&self, bytes: &[u8]) {
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        socket.send_to(bytes, (Ipv4Addr::LOCALHOST, self.port)).unwrap();
    }

    /// What the doctor says on this host.
    pub(crate) fn doctor(&self, arguments: &[&str]) -> Report {
        self.reported(arguments, self.sockets.path(), self.keys.path())
    }

    /// What it says where only these keys are.
    pub(crate) fn doctor_with_keys(&self, keys: &Path, arguments: &[&str]) -> Report {
        self.reported(arguments, self.sockets.path(), keys)
    }

    /// What it says where no unit can be asked.
    pub(crate) fn doctor_elsewhere(&self, arguments: &[&str]) -> Report {
        self.reported(arguments, private_directory().path(), self.keys.path())
    }

    fn reported(&self, arguments: &[&str], sockets: &Path, keys: &Path) -> Report {
        let (code, output, errors) = self.run(arguments, sockets, keys);
        let reported = serde_json::from_str(&output).unwrap_or_else(|_| panic!("{output}{errors}"));
        Report { reported, code }
    }

    /// From then on no unit can be asked.
    pub(crate) fn let_others_write_sockets(&self) {
        std::fs::set_permissions(self.sockets.path(), Permissions::from_mode(0o722)).unwrap();
    }

    /// Exit code, standard output and standard error.
    pub(crate) fn output(&self, arguments: &[&str]) -> (i32, String, String) {
        self.run(arguments, self.sockets.path(), self.keys.path())
    }

    fn run(&self, arguments: &[&str], sockets: &Path, keys: &Path) -> (i32, String, String) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command.args([
            "doctor",
            "--json",
            "--fleet",
            &self.fleet.to_string(),
            "--discovery-port",
            &self.port.to_string(),
        ]);
        command.args(self.loopback.then_some("--loopback")).args(arguments);
        command.env("CARA_CONTROL_DIR", sockets).env("CARA_KEYS", keys).env_remove("CARA_INTERFACES");
        let output = command.output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
    }
}

/// A process that ends with its owner.
pub(crate) struct Killed(Child);

impl Killed {
    /// As a program that hangs: it holds what it has, and does nothing.
    pub(crate) fn stand_still(&self) {
        let stopped = Command::new("kill").args(["-STOP", &self.0.id().to_string()]).status().unwrap();
        assert!(stopped.success());
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What the doctor said.
#[derive(Debug)]
pub(crate) struct Report {
    reported: Value,
    pub(crate) code: i32,
}

impl Report {
    /// The names of the findings, in their order.
    pub(crate) fn ids(&self) -> Vec<&str> {
        self.findings().iter().map(|finding| finding["id"].as_str().unwrap()).collect()
    }

    /// These findings and no others, in this order.
    #[track_caller]
    pub(crate) fn is(&self, ids: &[&str], code: i32) {
        assert_eq!((self.ids(), self.code), (ids.to_vec(), code), "{}", self.reported);
        assert!(self.findings().iter().all(|finding| !finding["advice"].as_str().unwrap().is_empty()));
    }

    /// What was seen.
    pub(crate) fn found(&self, index: usize) -> &str {
        self.findings()[index]["found"].as_str().unwrap()
    }

    /// What to do.
    pub(crate) fn advice(&self, index: usize) -> &str {
        self.findings()[index]["advice"].as_str().unwrap()
    }

    fn findings(&self) -> &Vec<Value> {
        self.reported["findings"].as_array().unwrap()
    }
}

/// Waits until `condition` holds.
pub(crate) fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Does `again` over and over, beside `once`.
pub(crate) fn while_running(again: impl Fn() + Sync, once: impl FnOnce()) {
    struct Stop<'s>(&'s AtomicBool);
    impl Drop for Stop<'_> {
        fn drop(&mut self) {
            self.0.store(true, Ordering::Relaxed);
        }
    }
    let stopped = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !stopped.load(Ordering::Relaxed) {
                again();
                std::thread::sleep(Duration::from_millis(100));
            }
        });
        // Also when an assertion fails.
        let _stop = Stop(&stopped);
        once();
    });
}

/// A root for all nodes of these tests, each of which belongs to every m_unit.
pub(crate) fn draw(fleet: u32) -> FleetKeys {
    let mut keys = FleetKeys::draw(Fleet(fleet)).unwrap();
    let managers = ["boss", "chief", "bos"].map(|name| Identity::m_unit(name, 1).unwrap());
    managers.iter().for_each(|manager| keys.add(manager, &[]).unwrap());
    for (name, id) in [("agv", 7), ("agv-8", 8), ("first", 1), ("second", 2), ("lost", 3), ("far", 4)] {
        keys.add(&Identity::s_unit(name, id).unwrap(), &managers).unwrap();
    }
    keys
}

pub(crate) fn private_directory() -> tempfile::TempDir {
    tempfile::Builder::new().permissions(Permissions::from_mode(0o700)).tempdir().unwrap()
}
