//! A terminal of the reader: where it is, what it has exported, and what runs in it.

use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_processes::Process;
use cara_processes::ticker::Ticker;
use rustix::process::Signal;
use tempfile::TempDir;

use crate::document::Step;
use crate::expectation::{line_matches, matches};

/// How long a command that stays may take until it has printed what the guide shows.
const PATIENCE: Duration = Duration::from_secs(60);
/// What is said where a vehicle has stopped on its way.
const STOPPED: [&str; 3] = ["it stopped there", "gave no sign of life", "was stopped on its way"];
/// The shortest lease in the guide: if this program, too, got no processor for so long that it may have ended, the host was at fault
/// and the command is run again.
const LEASE: Duration = Duration::from_millis(400);
/// How often it is run again.
const MOST_AGAIN: u32 = 3;

/// Variables that would lead to the user's own keys.
const NOT_INHERITED: [&str; 2] = ["CARA_KEYS", "XDG_CONFIG_HOME"];

/// What all terminals share: the checkout, and a home of their own that is empty.
pub(crate) struct Surroundings {
    root: PathBuf,
    home: TempDir,
}

impl Surroundings {
    pub(crate) fn new(root: &Path) -> Result<Self> {
        Ok(Self { root: root.to_owned(), home: tempfile::tempdir()? })
    }

    /// Differences from the environment of this program: no units of other hosts are met, nothing is left behind, and what
    /// the guide's programs have in common is built once and quickly. Tests beside this one are heard: their managers have
    /// other names than the guide's.
    fn environment(&self) -> Vec<(&'static str, PathBuf)> {
        let before = PathBuf::from(std::env::var_os("HOME").unwrap_or_default());
        let kept = |name: &str, below: &str| std::env::var_os(name).map_or_else(|| before.join(below), PathBuf::from);
        vec![
            ("HOME", self.home.path().to_owned()),
            ("CARGO_HOME", kept("CARGO_HOME", ".cargo")),
            ("RUSTUP_HOME", kept("RUSTUP_HOME", ".rustup")),
            ("CARA_CONTROL_DIR", self.home.path().join("control")),
            ("CARA_INTERFACES", PathBuf::from("lo")),
            ("NO_COLOR", PathBuf::from("1")),
            ("CARGO_BUILD_BUILD_DIR", self.home.path().join("build")),
            ("CARGO_PROFILE_DEV_OPT_LEVEL", PathBuf::from("0")),
            ("CARGO_PROFILE_DEV_DEBUG", PathBuf::from("0")),
        ]
    }
}

/// A terminal.
pub(crate) struct Terminal<'s> {
    name: &'s str,
    surroundings: &'s Surroundings,
    /// `cd` and `export`, which later commands begin with.
    before: String,
    running: Option<Process>,
}

impl<'s> Terminal<'s> {
    pub(crate) fn new(name: &'s str, surroundings: &'s Surroundings) -> Self {
        Self { name, surroundings, before: String::from("set -e\n"), running: None }
    }

    /// Does what the guide asks for.
    pub(crate) fn take(&mut self, step: &Step) -> Result<()> {
        match step {
            Step::File { path, text, .. } => self.write(path, text),
            Step::Interrupt { .. } => self.interrupt(),
            Step::Command { text, .. } if text.starts_with("cd ") || text.starts_with("export ") => {
                self.before += &format!("{text}\n");
                self.run("true", &[])
            }
            Step::Command { text, output, stays: true, .. } => self.start(text, output),
            Step::Command { text, output, .. } => self.run(text, output),
        }
    }

    fn write(&self, path: &str, text: &str) -> Result<()> {
        println!("{path} is written");
        let directory = self.shell("pwd").output()?;
        let path = Path::new(String::from_utf8(directory.stdout)?.trim()).join(path);
        std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
    }

    fn run(&mut self, text: &str, shown: &[String]) -> Result<()> {
        ensure!(self.running.is_none(), "something runs in this terminal already");
        println!("{}$ {text}", self.name);
        let start = Instant::now();
        for again in 0.. {
            let ticker = Ticker::start();
            let (said, wrong) = self.attempt(text, shown)?;
            let Some(wrong) = wrong else { break };
            // What waits first may have waited too little for a host that was held up.
            let may_be_late = text.starts_with("sleep ") || STOPPED.iter().any(|told| said.contains(told));
            let longest = ticker.longest();
            let is_excused = may_be_late && ticker.may_have_ended(LEASE) && again < MOST_AGAIN;
            ensure!(is_excused, "{wrong}\nand this program had its turn after {longest:?} at most");
            println!("  again, since this program had no turn for {longest:?} and {wrong}");
        }
        println!("  {:.1} s", start.elapsed().as_secs_f64());
        Ok(())
    }

    /// Runs a command once: what it says, and what is wrong with that.
    fn attempt(&self, text: &str, shown: &[String]) -> Result<(String, Option<String>)> {
        // As a terminal, it stays open and says nothing: what `--hold` holds goes on.
        let (input, _open) = std::io::pipe()?;
        let finished = self.shell(text).stdin(input).output()?;
        let output = String::from_utf8_lossy(&finished.stdout).into_owned();
        let said = format!("{output}{}", String::from_utf8_lossy(&finished.stderr));
        let printed = without_loopback(&output);
        let wrong = if !finished.status.success() {
            Some(format!("`{text}` failed: {}\n{said}", finished.status))
        } else if !shown.is_empty() && !matches(shown, &printed) {
            Some(format!("`{text}` should print\n{}\nand printed\n{said}", shown.join("\n")))
        } else {
            None
        };
        Ok((said, wrong))
    }

    fn start(&mut self, text: &str, shown: &[String]) -> Result<()> {
        ensure!(self.running.is_none(), "something runs in this terminal already");
        println!("{}$ {text}", self.name);
        // Standard error belongs to what the reader sees; a process in the background is read from one pipe.
        let script = format!("{}exec 2>&1\nexec {text}", self.before);
        let environment = self.surroundings.environment();
        let variables = environment.iter().map(|(name, value)| format!("{name}={}", value.display()));
        let directory = self.surroundings.root.display().to_string();
        let arguments = ["-C".into(), directory].into_iter().chain(NOT_INHERITED.map(|name| format!("--unset={name}")));
        let arguments = arguments.chain(variables).chain(["bash".into(), "-c".into(), script]);
        let process = Process::start(text, Path::new("env"), arguments)?;
        shown.iter().filter(|line| line.trim() != "…").try_for_each(|line| await_line(&process, line))?;
        self.running = Some(process);
        Ok(())
    }

    fn interrupt(&mut self) -> Result<()> {
        let mut process = self.running.take().context("nothing runs in this terminal")?;
        println!("{}^C", self.name);
        let status = process.terminate(PATIENCE)?;
        // A program that does not care for signals is ended by one.
        let by_signal = status.signal() == Some(Signal::TERM.as_raw());
        ensure!(status.success() || by_signal, "it ended with {status}: {:?}", process.lines());
        Ok(())
    }

    /// Ends what still runs.
    pub(crate) fn close(&mut self) -> Result<()> {
        self.running.take().map_or(Ok(()), |process| bail!("`{}` still runs at the guide's end", process.name()))
    }

    fn shell(&self, text: &str) -> Command {
        let mut command = Command::new("bash");
        command.args(["-c", &format!("{}{text}", self.before)]).current_dir(&self.surroundings.root);
        for name in NOT_INHERITED {
            command.env_remove(name);
        }
        command.envs(self.surroundings.environment());
        command
    }
}

/// What a reader sees, who sets no `CARA_INTERFACES`: the doctor says of it, in two lines, that it keeps commands to loopback.
fn without_loopback(output: &str) -> Vec<&str> {
    let mut seen: Vec<&str> = output.lines().collect();
    if let Some(first) = seen.iter().position(|line| line.starts_with("error loopback-only: ")) {
        seen.drain(first..(first + 2).min(seen.len()));
    }
    seen
}

fn await_line(process: &Process, shown: &str) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    while !process.lines().iter().any(|line| line_matches(shown, &line.text)) {
        if Instant::now() >= deadline {
            let lines: Vec<String> = process.lines().into_iter().map(|line| line.text).collect();
            bail!("it should print `{shown}` and printed\n{}", lines.join("\n"));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}
