//! A manager, AGVs, and what a user types.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use cara_std::control::Control;
use cara_std::{
    Builder, CommunicationSystem, Identity, Interfaces, MUnit, ParametersView, SUnit, Served, ServiceError,
    ServiceOptions, Unit,
};
use cara_test_keys::KeyFolder;
use serde_json::Value;
use tempfile::TempDir;

/// Longest wait for anything that is to happen.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

/// What an AGV of these tests offers.
pub(crate) const FUNCTIONS: [&str; 7] = [
    "go_to(position: int[2]) -> (position: int[2])",
    "echo(text: string[20000]) -> (text: string[20000])",
    "mix(f: float, fs: float[2], b: bool, data: bytes[4]) -> (f: float, fs: float[2], b: bool, data: bytes[4])",
    "set_up(speed: float?, load: {name: string[8]?, kg: float?}) -> (speed: float?, load: {name: string[8]?, kg: float?})",
    "fail()",
    "slow()",
    "swallow(text: string[100])",
];

/// A manager in a process of its own, with a control socket of its own.
pub(crate) struct Stage {
    pub(crate) fleet: u32,
    control: TempDir,
    keys: KeyFolder,
    manager: Option<Child>,
    agvs: Vec<Unit>,
}

impl Stage {
    /// Without nodes.
    pub(crate) fn empty() -> Self {
        let fleet = RandomState::new().build_hasher().finish() as u32;
        let control = private_folder();
        let keys = KeyFolder::draw(fleet, &["manager/1@m_unit", "other/2@m_unit"]).unwrap();
        Self { fleet, control, keys, manager: None, agvs: Vec::new() }
    }

    /// `manager/1` and these AGVs, connected, with IDs from 11 on.
    pub(crate) fn with(agvs: &[&str]) -> Self {
        let mut stage = Self::empty();
        agvs.iter().zip(11..).for_each(|(name, id)| stage.know(name, id));
        stage.start_manager();
        agvs.iter().zip(11..).for_each(|(name, id)| stage.start_agv(name, id));
        let start = Instant::now();
        while stage.ready() < agvs.len() {
            assert!(start.elapsed() < PATIENCE, "the AGVs have not joined: {}", stage.cara(&["scan"]).everything());
            std::thread::sleep(Duration::from_millis(50));
        }
        stage
    }

    /// AGVs whose lists the manager has.
    pub(crate) fn ready(&self) -> usize {
        let scan = self.cara(&["scan", "--json"]);
        let nodes = if scan.code == 0 { scan.json()["nodes"].clone() } else { Value::Null };
        let ready = |node: &&Value| node["functions"].as_u64() == Some(FUNCTIONS.len() as u64);
        nodes.as_array().map_or(0, |nodes| nodes.iter().filter(ready).count())
    }

    pub(crate) fn start_manager(&mut self) {
        self.start_manager_with(&[]);
    }

    pub(crate) fn start_manager_with(&mut self, more: &[&str]) {
        let mut command = self.command(&["node", "--name", "manager", "--id", "1"]);
        command.args(more).stdout(Stdio::null()).stderr(Stdio::inherit());
        self.adopt_manager(&mut command);
    }

    /// Starts a command that is `manager/1`, and waits until it answers.
    pub(crate) fn adopt_manager(&mut self, command: &mut Command) {
        self.manager = Some(command.stdin(Stdio::null()).spawn().unwrap());
        let start = Instant::now();
        while self.cara(&["scan", "--unit", "manager/1"]).code != 0 {
            assert!(start.elapsed() < PATIENCE, "the manager does not answer");
            std::thread::sleep(Duration::from_millis(50));
        }
        // Other tests run at the same time.
        self.ends(0, &["set", ".", "request_timeout", "20s"]);
    }

    /// The builder of another m_unit, which has keys.
    pub(crate) fn m_unit(&self, name: &str, id: u32) -> Builder<(), MUnit> {
        let file = self.keys.file(&Identity::m_unit(name, id).unwrap()).unwrap();
        let builder = CommunicationSystem::builder(name, id).unwrap().fleet(self.fleet).key_file(file);
        builder.interfaces(Interfaces::Loopback).control(Control::Off)
    }

    /// The builder of `manager/1` as a program, with its control socket at the place where `cara` looks.
    pub(crate) fn manager(&self) -> Builder<(), MUnit> {
        let file = self.keys.file(&Identity::m_unit("manager", 1).unwrap()).unwrap();
        let socket = self.control().join(format!("manager-1-{}.sock", self.fleet));
        let builder = CommunicationSystem::builder("manager", 1).unwrap().fleet(self.fleet).key_file(file);
        builder.interfaces(Interfaces::Loopback).control(Control::Path(socket))
    }

    pub(crate) fn start_agv(&mut self, name: &str, id: u32) {
        self.know(name, id);
        self.agvs.push(agv(self.vehicle(name, id)));
    }

    /// Makes the keys of an s_unit, before the manager starts or while it runs.
    pub(crate) fn know(&self, name: &str, id: u32) {
        self.know_all(&[&format!("{name}/{id}")]);
    }

    /// Likewise of several, as `NAME/ID`.
    pub(crate) fn know_all(&self, nodes: &[&str]) {
        self.keys.add(nodes).unwrap();
    }

    /// The builder of an s_unit that is [known](Self::know).
    pub(crate) fn vehicle(&self, name: &str, id: u32) -> Builder<(), SUnit> {
        self.vehicle_of(name, id, "manager", 1)
    }

    /// Likewise, of another manager.
    pub(crate) fn vehicle_of(&self, name: &str, id: u32, manager: &str, manager_id: u32) -> Builder<(), SUnit> {
        let builder = Unit::builder(name, id, manager, manager_id).unwrap().fleet(self.fleet);
        let file = self.keys.file(&Identity::s_unit(name, id).unwrap()).unwrap();
        builder.interfaces(Interfaces::Loopback).key_file(file)
    }

    pub(crate) fn stop_agvs(&mut self) {
        self.agvs.drain(..).for_each(|agv| agv.stop());
    }

    /// Ends the manager by SIGKILL.
    pub(crate) fn kill_manager(&mut self) {
        let mut manager = self.manager.take().expect("it runs");
        manager.kill().unwrap();
        manager.wait().unwrap();
    }

    /// The manager stands still, as after Ctrl-Z: the system still takes connections for it.
    pub(crate) fn freeze_manager(&self) {
        let manager = self.manager.as_ref().expect("it runs");
        cara_processes::freeze(manager).unwrap();
    }

    /// The command with the stage's fleet, on loopback, to be run.
    pub(crate) fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cara"));
        command.args(arguments).args(["--loopback", "--fleet", &self.fleet.to_string()]);
        command.env("CARA_CONTROL_DIR", self.control.path()).env("CARA_KEYS", self.keys.path());
        command.env_remove("CARA_INTERFACES").stdin(Stdio::null());
        command
    }

    /// What a user types, run to its end.
    pub(crate) fn cara(&self, arguments: &[&str]) -> Ran {
        Ran::of(self.command(arguments).output().unwrap())
    }

    /// As [`cara`](Self::cara), and it ends with `code`.
    #[track_caller]
    pub(crate) fn ends(&self, code: i32, arguments: &[&str]) -> Ran {
        let ran = self.cara(arguments);
        assert_eq!(ran.code, code, "cara {}\n{}", arguments.join(" "), ran.everything());
        ran
    }

    pub(crate) fn control(&self) -> &Path {
        self.control.path()
    }
}

/// Waits until `condition` holds.
pub(crate) fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < PATIENCE, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A folder for control sockets; one that others can enter would be refused.
pub(crate) fn private_folder() -> TempDir {
    let folder = TempDir::new().unwrap();
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o700)).unwrap();
    folder
}

impl Drop for Stage {
    fn drop(&mut self) {
        self.stop_agvs();
        if let Some(mut manager) = self.manager.take() {
            // One that has ended cannot be killed, which is what is wanted.
            let _ = manager.kill();
            let _ = manager.wait();
        }
    }
}

/// How a command ended, and what it printed.
pub(crate) struct Ran {
    pub(crate) code: i32,
    pub(crate) out: String,
    pub(crate) err: String,
}

impl Ran {
    pub(crate) fn of(output: Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Self { code: output.status.code().unwrap_or(-1), out: text(&output.stdout), err: text(&output.stderr) }
    }

    pub(crate) fn everything(&self) -> String {
        format!("code {}\n--- stdout\n{}\n--- stderr\n{}", self.code, self.out, self.err)
    }

    /// The one object that it printed.
    #[track_caller]
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(self.out.trim()).unwrap_or_else(|error| panic!("{error}: {}", self.everything()))
    }

    /// The objects that it printed, one a line.
    #[track_caller]
    pub(crate) fn lines(&self) -> Vec<Value> {
        let parse = |line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {}", self.everything()));
        self.out.lines().map(parse).collect()
    }

    /// The error that it printed as JSON.
    #[track_caller]
    pub(crate) fn error(&self) -> Value {
        let reported: Value = serde_json::from_str(self.err.trim()).unwrap_or_else(|_| panic!("{}", self.everything()));
        reported["error"].clone()
    }

    #[track_caller]
    pub(crate) fn says(&self, text: &str) -> &Self {
        assert!(self.out.contains(text) || self.err.contains(text), "no `{text}` in\n{}", self.everything());
        self
    }
}

/// A command that runs on, read line by line.
pub(crate) struct Running {
    child: Child,
    /// Not the child's, which closes it when it waits.
    typed: Option<std::process::ChildStdin>,
    lines: Option<std::io::Lines<BufReader<std::process::ChildStdout>>>,
}

impl Running {
    pub(crate) fn start(mut command: Command) -> Self {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = Some(BufReader::new(child.stdout.take().unwrap()).lines());
        Self { typed: child.stdin.take(), child, lines }
    }

    /// The next line that contains `text`; all before it are dropped.
    pub(crate) fn expect(&mut self, text: &str) -> String {
        let lines = self.lines.as_mut().expect("it is read");
        let found = lines.map_while(Result::ok).find(|line| line.contains(text));
        found.unwrap_or_else(|| panic!("it ended without a line with `{text}`"))
    }

    /// The next line; `None` at its end.
    pub(crate) fn line(&mut self) -> Option<String> {
        self.lines.as_mut().expect("it is read").next()?.ok()
    }

    pub(crate) fn type_in(&mut self, text: &str) {
        self.typed.as_mut().expect("it is open").write_all(text.as_bytes()).unwrap();
    }

    /// Its standard input ends.
    pub(crate) fn type_no_more(&mut self) {
        self.typed = None;
    }

    /// Its standard output has no reader any more.
    pub(crate) fn read_no_more(&mut self) {
        self.lines = None;
    }

    /// Ctrl-C.
    pub(crate) fn interrupt(&self) {
        self.signal(rustix::process::Signal::INT);
    }

    /// Ctrl-C once it is caught, and the exit code.
    pub(crate) fn interrupted(mut self) -> i32 {
        let status = format!("/proc/{}/status", self.child.id());
        let caught = |line: &str| Some(u64::from_str_radix(line.strip_prefix("SigCgt:")?.trim(), 16).unwrap());
        let sigint = 1 << (rustix::process::Signal::INT.as_raw() - 1);
        until("Ctrl-C is caught", || {
            let text = std::fs::read_to_string(&status).unwrap();
            text.lines().find_map(caught).is_some_and(|signals| signals & sigint != 0)
        });
        // The first may come before it is listened to.
        until("Ctrl-C ends it", || {
            self.interrupt();
            self.child.try_wait().unwrap().is_some()
        });
        self.end()
    }

    /// Ctrl-Z, as far as one process is concerned, and not to be caught.
    pub(crate) fn freeze(&self) {
        cara_processes::freeze(&self.child).unwrap();
    }

    pub(crate) fn thaw(&self) {
        self.signal(rustix::process::Signal::CONT);
    }

    fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, signal).unwrap();
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// SIGKILL, from which it learns nothing.
    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    pub(crate) fn has_ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Waits for its end.
    pub(crate) fn end(mut self) -> i32 {
        self.child.wait().unwrap().code().unwrap_or(-1)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // One that has ended cannot be killed, which is what is wanted.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub(crate) fn agv(builder: Builder<(), SUnit>) -> Unit {
    let unit = builder.build().unwrap();
    for signature in FUNCTIONS {
        let definition = signature.parse::<cara_std::Definition>().unwrap();
        let options = ServiceOptions::new();
        let list = unit.my_function_list();
        match definition.name() {
            "fail" => list.add_service(&definition, options, failing).map(drop).unwrap(),
            "slow" => list.add_service(&definition, options, slow).map(drop).unwrap(),
            _ => list.add_service(&definition, options, unchanged).map(drop).unwrap(),
        }
    }
    unit.publish_my_function_list().unwrap();
    unit.start().unwrap();
    unit
}

fn unchanged(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    Ok(())
}

fn failing(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    Err(ServiceError::Failed(7))
}

fn slow(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    std::thread::sleep(Duration::from_secs(3));
    Ok(())
}
