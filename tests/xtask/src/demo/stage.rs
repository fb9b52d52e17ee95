//! Where the demonstration's processes come from, and what is shown of them.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_processes::{Line, Process, random_fleet};

/// How long anything may take that takes a second at most when the machine has nothing else to do.
pub(super) const STEP: Duration = Duration::from_secs(10);

/// One fleet on loopback.
pub(super) struct Stage {
    programs: PathBuf,
    fleet: String,
    began: Instant,
}

impl Stage {
    /// The examples lie beside this program.
    pub(super) fn new() -> Result<Self> {
        let own = std::env::current_exe().context("cannot tell where the examples are")?;
        let programs = own.parent().context("this program is in no folder")?.to_owned();
        Ok(Self { programs, fleet: random_fleet().to_string(), began: Instant::now() })
    }

    /// The manager, which waits behind each line of the listing and takes commands then.
    pub(super) fn manager(&self) -> Result<Process> {
        self.start("manager", "agv_manager", &["--console"])
    }

    /// AGV number `number`, as `agv-1/11`.
    pub(super) fn agv(&self, number: u32) -> Result<Process> {
        let (name, id) = (format!("agv-{number}"), (10 + number).to_string());
        self.start(&name, "agv", &["--attended", "--name", &name, "--id", &id])
    }

    fn start(&self, name: &str, program: &str, arguments: &[&str]) -> Result<Process> {
        let network = ["--loopback", "--fleet", &self.fleet];
        Process::start(name, &self.programs.join(program), arguments.iter().chain(&network))
    }

    /// Sends a command to the manager's console; its answer, which must contain `wanted`.
    pub(super) fn command(&self, manager: &mut Process, command: &str, wanted: &str) -> Result<String> {
        manager.send(command)?;
        let answer = manager.expect(wanted, STEP).with_context(|| format!("after the command `{command}`"))?;
        println!("{:>6.1} s  {command:<42} {}", self.seconds(), answer.text);
        Ok(answer.text)
    }

    pub(super) fn title(&self, title: &str) {
        println!("\n== {title}");
    }

    pub(super) fn tell(&self, what: &str) {
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
