//! Where the demonstration's processes come from, and what is shown of them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_processes::ticker::Ticker;
use cara_processes::{Line, Process, random_fleet};
use tempfile::TempDir;

/// How long anything may take that takes a second at most when the machine has nothing else to do.
pub(super) const STEP: Duration = Duration::from_secs(60);
/// How long a vehicle may take to set out or to arrive before it is sent once more.
pub(super) const TRY: Duration = Duration::from_secs(10);
/// Between two of them, and between two questions.
const PAUSE: Duration = Duration::from_millis(200);
/// The lease of `go_to`, as `cara-apps` has it.
pub(super) const LEASE: Duration = Duration::from_millis(400);
/// What an AGV prints when the lease has ended for which it drove.
pub(super) const EXPIRED: &str = "lease of go_to expired";

/// The fleet's nodes, as `cara keys` takes them.
const NODES: [&str; 4] = ["AGV_manager/1@m_unit", "agv-1/11", "agv-2/12", "agv-3/13"];

/// One fleet on loopback, with keys of its own.
pub(super) struct Stage {
    /// Where the manager and `cara` are.
    manager: PathBuf,
    /// Where the AGVs' program is.
    agvs: PathBuf,
    fleet: String,
    keys: TempDir,
    began: Instant,
}

impl Stage {
    pub(super) fn new(manager: &Path, agvs: &Path) -> Result<Self> {
        let (manager, agvs) = (manager.to_owned(), agvs.to_owned());
        let keys = tempfile::tempdir().context("there is no room for keys")?;
        Ok(Self { manager, agvs, fleet: random_fleet().to_string(), keys, began: Instant::now() })
    }

    /// Makes the fleet's keys, with the command that a newcomer types.
    pub(super) fn make_keys(&self) -> Result<()> {
        let mut command = Command::new(self.manager.join("cara"));
        command.args(["keys", "new-fleet", "--fleet", &self.fleet]).args(NODES).env("CARA_KEYS", self.keys.path());
        let made = command.output().context("cannot start cara")?;
        ensure!(made.status.success(), "no keys were made: {}", String::from_utf8_lossy(&made.stderr));
        self.show(&format!("cara keys new-fleet --fleet {} {}", self.fleet, NODES.join(" ")));
        Ok(())
    }

    /// The manager, which waits behind each line of the listing and takes commands then.
    pub(super) fn manager(&self) -> Result<Process> {
        self.start("manager", self.manager.join("agv_manager"), &["--console"])
    }

    /// AGV number `number`, as `agv-1/11`.
    pub(super) fn agv(&self, number: u32) -> Result<Process> {
        let (name, id) = (format!("agv-{number}"), (10 + number).to_string());
        let agv = self.start(&name, self.agvs.join("agv"), &["--attended", "--name", &name, "--id", &id])?;
        // Units in plain mode do not meet secured ones, so a node that joins it has proven its key.
        agv.seen(&format!("started {name}/{id}, secured"), STEP)?;
        Ok(agv)
    }

    fn start(&self, name: &str, program: PathBuf, arguments: &[&str]) -> Result<Process> {
        let network = ["--loopback", "--fleet", &self.fleet];
        let keys = format!("CARA_KEYS={}", self.keys.path().display());
        let program = program.display().to_string();
        let words = [keys.as_str(), program.as_str()];
        Process::start(name, Path::new("env"), words.iter().chain(arguments).chain(&network))
    }

    /// Sends a command to the manager's console; its answer, which must contain `wanted`.
    pub(super) fn command(&self, manager: &mut Process, command: &str, wanted: &str) -> Result<String> {
        manager.send(command)?;
        let answer = manager.expect(wanted, STEP).with_context(|| format!("after the command `{command}`"))?;
        println!("{:>6.1} s  {command:<42} {}", self.seconds(), answer.text);
        Ok(answer.text)
    }

    /// As [`command`](Self::command), again where that fails, and for `units`, whose number may change. Any other wrong answer
    /// stays wrong.
    pub(super) fn until(&self, manager: &mut Process, command: &str, wanted: &str) -> Result<String> {
        let deadline = Instant::now() + STEP;
        loop {
            manager.send(command)?;
            let answer = manager.expect_any(&["= ", "! "], STEP)?;
            println!("{:>6.1} s  {command:<42} {}", self.seconds(), answer.text);
            if answer.text.contains(wanted) {
                return Ok(answer.text);
            }
            let may_change = command == "units" || answer.text.starts_with("! ");
            ensure!(
                may_change && Instant::now() < deadline,
                "`{command}` is answered by `{}` and not by `{wanted}`",
                answer.text
            );
            std::thread::sleep(PAUSE);
        }
    }

    /// Sends an AGV somewhere until `is_done`: on a busy machine its lease may end on the way, or the call may come too late to
    /// begin.
    pub(super) fn sends(
        &self,
        manager: &mut Process,
        agv: &mut Process,
        go_to: &str,
        is_done: impl Fn(&Self, &mut Process) -> Result<bool>,
    ) -> Result<()> {
        let deadline = Instant::now() + STEP;
        loop {
            let ticker = Ticker::start();
            let before = agv.lines().len();
            self.until(manager, go_to, "= accepted")?;
            if is_done(self, agv)? {
                return Ok(());
            }
            let longest = ticker.longest();
            ensure!(
                ticker.may_have_ended(LEASE),
                "the order `{go_to}` ended early though the host did not hold this process up: {longest:?} at most"
            );
            ensure!(Instant::now() < deadline, "again and again the order `{go_to}` has ended before its time");
            // One that has stopped says that its lease has ended, which is not to be taken for the end of the next order.
            if agv.lines()[before..].iter().any(|line| line.text.starts_with("stopped at")) {
                agv.seen_behind(before, EXPIRED, STEP).context("it stopped for another reason than its lease")?;
            }
            std::thread::sleep(PAUSE);
        }
    }

    /// Whether an AGV arrives where it was sent, and has not stopped on the way.
    pub(super) fn arrives(&self, agv: &mut Process, place: &str) -> Result<bool> {
        let Ok(line) = agv.expect_any(&["arrived at", "stopped at"], TRY) else { return Ok(false) };
        self.heard(&line, agv);
        Ok(line.text.contains(&format!("arrived at {place}")))
    }

    pub(super) fn title(&self, title: &str) {
        println!("\n== {title}");
    }

    pub(super) fn show(&self, what: &str) {
        println!("{:>6.1} s  {what}", self.seconds());
    }

    /// Shows what a process printed.
    pub(super) fn heard(&self, line: &Line, process: &Process) {
        let seconds = line.at.saturating_duration_since(self.began).as_secs_f64();
        println!("{seconds:>6.1} s  {:>9}: {}", process.name(), line.text);
    }

    /// Shows a line of the listing and what came of it.
    pub(super) fn line(&self, number: u32, code: &str, came: &str) {
        println!("{:>6.1} s  {number:>2}  {code}", self.seconds());
        if !came.is_empty() {
            println!("{:16}-> {came}", "");
        }
    }

    /// Since the demonstration began.
    pub(super) fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }
}
