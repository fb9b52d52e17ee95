//! A process of the run: what it prints goes to one channel, and it does not outlive this one.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child as Process, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use rustix::process::{Pid, Signal, kill_process};

use super::board::Log;
use crate::vehicle::now;

/// A line of a process, or its end.
#[derive(Debug)]
pub(super) struct Said {
    /// Which process.
    pub(super) child: usize,
    /// Its line; `None` at the end of its output.
    pub(super) line: Option<String>,
}

/// What the kernel tells of a process.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Usage {
    pub(super) cpu: Duration,
    pub(super) resident_kib: u64,
    pub(super) threads: u64,
}

/// What it holds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Held {
    /// Its share of what it has in common with others included.
    pub(super) proportional_kib: u64,
    pub(super) descriptors: usize,
}

/// A process.
pub(super) struct Child {
    pub(super) usage: Usage,
    process: Process,
    input: Option<ChildStdin>,
}

impl Child {
    /// Starts this program in another role.
    pub(super) fn start(number: usize, keys: &Path, arguments: &[String], said: Sender<Said>) -> Result<Self> {
        let program = std::env::current_exe()?;
        let mut command = Command::new(program);
        command.args(arguments).env("CARA_KEYS", keys);
        Self::run(number, command, said)
    }

    /// Starts a program, and hears what it prints.
    pub(super) fn run(number: usize, mut command: Command, said: Sender<Said>) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        if std::env::var_os("RUST_LOG").is_none() {
            // What is broken on purpose is no news.
            command.env("RUST_LOG", "off");
        }
        let mut process = command.spawn().with_context(|| format!("cannot start {command:?}"))?;
        let output = process.stdout.take();
        Ok(Self::hear(number, process, output, said, Some))
    }

    /// Starts the emulator of a board, whose log is its standard error.
    pub(super) fn emulate(number: usize, mut emulator: Command, mut log: Log, said: Sender<Said>) -> Result<Self> {
        emulator.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut process = emulator.spawn().context("cannot start qemu-system-arm")?;
        let output = process.stderr.take();
        Ok(Self::hear(number, process, output, said, move |line| log.line(now(), &line)))
    }

    /// Passes on what a process says, as `line` has it.
    fn hear(
        number: usize,
        mut process: Process,
        output: Option<impl Read + Send + 'static>,
        said: Sender<Said>,
        mut line: impl FnMut(String) -> Option<String> + Send + 'static,
    ) -> Self {
        let input = process.stdin.take();
        if let Some(output) = output {
            std::thread::spawn(move || {
                for line in BufReader::new(output).lines().map_while(Result::ok).filter_map(&mut line) {
                    let _ = said.send(Said { child: number, line: Some(line) });
                }
                let _ = said.send(Said { child: number, line: None });
            });
        }
        Self { usage: Usage::default(), process, input }
    }

    /// Writes a line to it. One that has ended hears nothing, which its end tells.
    pub(super) fn show(&mut self, line: &str) {
        if let Some(input) = &mut self.input {
            let _ = writeln!(input, "{line}");
        }
    }

    /// Sends it a signal.
    pub(super) fn signal(&self, signal: Signal) -> Result<()> {
        Ok(kill_process(Pid::from_child(&self.process), signal)?)
    }

    /// Ends it at once, as a loss of power would.
    pub(super) fn kill(&mut self) -> Result<()> {
        self.look();
        self.process.kill()?;
        self.process.wait()?;
        Ok(())
    }

    /// Closes its input, upon which it ends; after `patience` it is killed.
    pub(super) fn end(&mut self, patience: Duration) -> Result<ExitStatus> {
        self.look();
        self.input = None;
        let deadline = Instant::now() + patience;
        while Instant::now() < deadline {
            if let Some(status) = self.process.try_wait()? {
                return Ok(status);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        self.process.kill()?;
        Ok(self.process.wait()?)
    }

    /// Notes its CPU time and memory; what was noted last stays when it is gone.
    pub(super) fn look(&mut self) {
        if let Some(usage) = usage(self.process.id()) {
            self.usage = usage;
        }
    }

    pub(super) fn id(&self) -> u32 {
        self.process.id()
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        // One that has ended cannot be killed, which is what is wanted.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// `None` once it is gone.
pub(super) fn usage(pid: u32) -> Option<Usage> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name of the program, in brackets, may have spaces.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |index: usize| fields.get(index)?.parse::<u64>().ok();
    // Linux counts these in hundredths of a second for programs.
    let cpu = Duration::from_millis((ticks(11)? + ticks(12)?) * 10);
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let (resident_kib, threads) = (field(&status, "VmRSS:")?, field(&status, "Threads:")?);
    Some(Usage { cpu, resident_kib, threads })
}

pub(super) fn held(pid: u32) -> Option<Held> {
    let memory = std::fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?;
    let descriptors = std::fs::read_dir(format!("/proc/{pid}/fd")).ok()?.count();
    Some(Held { proportional_kib: field(&memory, "Pss:")?, descriptors })
}

/// The first number behind a word.
fn field(text: &str, word: &str) -> Option<u64> {
    text.lines().find_map(|line| line.strip_prefix(word))?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_kernel_tells_of_this_process() {
        let usage = super::usage(std::process::id()).unwrap();
        assert!(usage.resident_kib > 100 && usage.threads > 0);
        let held = super::held(std::process::id()).unwrap();
        assert!(held.proportional_kib > 100 && held.descriptors > 2);
        assert!(super::usage(u32::MAX).is_none());
    }
}
