//! Processes under test: what they print as lines with the time at which they came, waits with deadlines, and no
//! process that outlives its owner. Nothing here knows CARA.

pub mod cable;
pub mod faults;
pub mod files;
pub mod network;
pub mod switch;
pub mod ticker;

use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Write};
use std::net::{Ipv4Addr, TcpListener, UdpSocket};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail, ensure};
use rustix::process::{Pid, Signal, kill_process};

/// How often a process that is to end is looked at: there is no wait with a deadline.
const LOOK: Duration = Duration::from_millis(5);
/// Lines shown of a process that did not print what was expected.
const LAST_LINES: usize = 12;

/// A line that a process printed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// When it was read.
    pub at: Instant,
    /// Without its end.
    pub text: String,
}

/// A running process; dropping it kills it.
pub struct Process {
    name: String,
    child: Child,
    input: Option<ChildStdin>,
    output: Arc<Output>,
    /// Lines that [`Process::expect`] has passed.
    passed: usize,
}

#[derive(Default)]
struct Output {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    lines: Vec<Line>,
    ended: bool,
}

impl Process {
    /// Starts a program; `name` stands in messages about it.
    pub fn start<A: AsRef<OsStr>>(name: &str, program: &Path, arguments: impl IntoIterator<Item = A>) -> Result<Self> {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("cannot start {}", program.display()))?;
        let output = Arc::new(Output::default());
        if let Some(pipe) = child.stdout.take() {
            let output = output.clone();
            std::thread::spawn(move || output.read(pipe));
        }
        let input = child.stdin.take();
        Ok(Self { name: name.to_owned(), child, input, output, passed: 0 })
    }

    /// Its number on this host.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Its name in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Waits for a line that contains `text`, behind the one that the last call found.
    pub fn expect(&mut self, text: &str, within: Duration) -> Result<Line> {
        self.expect_any(&[text], within)
    }

    /// As [`expect`](Self::expect), for a line that contains any of these.
    pub fn expect_any(&mut self, texts: &[&str], within: Duration) -> Result<Line> {
        let found = self.output.wait(self.passed, texts, within);
        let (index, line) = found.ok_or_else(|| self.missing(&texts.join("` or `"), within))?;
        self.passed = index + 1;
        Ok(line)
    }

    /// Waits for a line that contains `text`, among all of them; those that have come count.
    pub fn seen(&self, text: &str, within: Duration) -> Result<Line> {
        self.seen_behind(0, text, within)
    }

    /// As [`seen`](Self::seen), among those behind the first `count`.
    pub fn seen_behind(&self, count: usize, text: &str, within: Duration) -> Result<Line> {
        self.output.wait(count, &[text], within).map(|(_, line)| line).ok_or_else(|| self.missing(text, within))
    }

    /// Whether a line that contains `text` has come.
    pub fn has(&self, text: &str) -> bool {
        self.seen(text, Duration::ZERO).is_ok()
    }

    /// The lines that have come.
    pub fn lines(&self) -> Vec<Line> {
        self.output.lock().lines.clone()
    }

    /// Writes a line to its standard input.
    pub fn send(&mut self, line: &str) -> Result<()> {
        let input = self.input.as_mut().ok_or_else(|| anyhow!("{} reads no more", self.name))?;
        writeln!(input, "{line}").with_context(|| format!("{} reads no more", self.name))
    }

    /// Closes its standard input.
    pub fn end_input(&mut self) {
        self.input = None;
    }

    /// Ends it at once, as a loss of power would. When it was done.
    pub fn kill(&mut self) -> Result<Instant> {
        let at = Instant::now();
        self.child.kill()?;
        self.child.wait()?;
        Ok(at)
    }

    /// Holds it up, as a hung program: its connections stay open. When that began; it stands still when this returns.
    pub fn freeze(&mut self) -> Result<Instant> {
        let at = Instant::now();
        freeze(&self.child).with_context(|| format!("{} cannot be held up", self.name)).map(|()| at)
    }

    /// Lets it go on.
    pub fn thaw(&mut self) -> Result<()> {
        self.signal(Signal::CONT)
    }

    /// Asks it to end, as Ctrl-C or a service manager does, and waits for its end.
    pub fn terminate(&mut self, within: Duration) -> Result<ExitStatus> {
        self.signal(Signal::TERM)?;
        self.wait(within)
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) -> Result<()> {
        let sent = kill_process(Pid::from_child(&self.child), signal);
        sent.with_context(|| format!("{} takes no signal", self.name))
    }

    /// Waits for its end.
    pub fn wait(&mut self, within: Duration) -> Result<ExitStatus> {
        let deadline = Instant::now() + within;
        loop {
            if let Some(status) = self.child.try_wait()? {
                return Ok(status);
            }
            if Instant::now() >= deadline {
                bail!("{} runs on after {within:?}{}", self.name, self.shown());
            }
            std::thread::sleep(LOOK);
        }
    }

    fn missing(&self, text: &str, within: Duration) -> anyhow::Error {
        let why = if self.output.lock().ended { "before it ended" } else { "in time" };
        anyhow!("{} did not print `{text}` {why} ({within:?}){}", self.name, self.shown())
    }

    /// Its last lines, for a message.
    fn shown(&self) -> String {
        let lines = self.lines();
        let last = &lines[lines.len().saturating_sub(LAST_LINES)..];
        last.iter().fold(String::from("; it printed last:"), |text, line| text + "\n    " + &line.text)
    }
}

/// Stops a process by a signal. On a busy machine its threads go on until each has had a turn, so this returns when all of them
/// stand still.
pub fn freeze(child: &Child) -> Result<()> {
    kill_process(Pid::from_child(child), Signal::STOP)?;
    let deadline = Instant::now() + STANDS_STILL;
    while !stands_still(child.id())? {
        ensure!(Instant::now() < deadline, "it does not stand still");
        std::thread::sleep(LOOK);
    }
    Ok(())
}

/// Longest wait for a process to stand still.
const STANDS_STILL: Duration = Duration::from_secs(30);

fn stands_still(process: u32) -> Result<bool> {
    for task in std::fs::read_dir(format!("/proc/{process}/task"))? {
        // A thread may have ended since.
        let stat = std::fs::read_to_string(task?.path().join("stat")).unwrap_or_default();
        // The state follows the name, which ends with a bracket.
        if stat.rsplit(')').next().is_some_and(|rest| !rest.is_empty() && !rest.starts_with(" T")) {
            return Ok(false);
        }
    }
    Ok(true)
}

impl Drop for Process {
    fn drop(&mut self) {
        // A process that has ended cannot be killed, which is what is wanted.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Output {
    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn read(&self, pipe: ChildStdout) {
        for text in BufReader::new(pipe).lines().map_while(Result::ok) {
            self.lock().lines.push(Line { at: Instant::now(), text });
            self.changed.notify_all();
        }
        self.lock().ended = true;
        self.changed.notify_all();
    }

    fn wait(&self, from: usize, texts: &[&str], within: Duration) -> Option<(usize, Line)> {
        let deadline = Instant::now() + within;
        let mut state = self.lock();
        let mut looked = from;
        loop {
            let fresh = state.lines.iter().enumerate().skip(looked);
            let mut fresh = fresh.filter(|(_, line)| texts.iter().any(|text| line.text.contains(*text)));
            if let Some((index, line)) = fresh.next() {
                return Some((index, line.clone()));
            }
            looked = looked.max(state.lines.len());
            let left = deadline.saturating_duration_since(Instant::now());
            if state.ended || left.is_zero() {
                return None;
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// A number for a fleet of its own, so that runs on one machine or network do not meet.
pub fn random_fleet() -> u32 {
    use std::hash::{BuildHasher, Hasher};
    (std::hash::RandomState::new().build_hasher().finish() as u32).max(1)
}

/// A UDP port for discovery that no other test uses, below those that the system gives away: it gives one that is shared to
/// several. The TCP port of the same number is kept until this process ends, which keeps others off.
pub fn discovery_port() -> u16 {
    loop {
        let port = 20_000 + (random_fleet() % 12_000) as u16;
        let kept = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map(std::mem::forget);
        if kept.is_ok() && UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok() {
            return port;
        }
    }
}

/// Says past a test's captured output why something is skipped, which counts as failed where `CI` is set.
pub fn skip(reason: impl std::fmt::Display) {
    std::io::stderr().write_all(format!("skipped: {reason}\n").as_bytes()).expect("standard error is open");
    assert!(std::env::var_os("CI").is_none(), "skipped, which counts as failed where CI is set: {reason}");
}

#[cfg(test)]
mod tests {
    use super::Process;
    use std::path::Path;
    use std::time::Duration;

    const LONG: Duration = Duration::from_secs(30);

    fn shell(script: &str) -> Process {
        Process::start("shell", Path::new("sh"), ["-c", script]).unwrap()
    }

    #[test]
    fn lines_are_expected_in_their_order() {
        let mut process = shell("echo one; echo two; echo one more; cat");
        process.expect("two", LONG).unwrap();
        assert_eq!(process.expect("one", LONG).unwrap().text, "one more");
        assert!(process.has("one") && !process.has("three"));
        process.send("three").unwrap();
        process.expect("three", LONG).unwrap();
        process.end_input();
        assert!(process.wait(LONG).unwrap().success());
    }

    #[test]
    fn what_does_not_come_is_told_with_what_came() {
        let mut process = shell("echo one");
        let error = process.expect("two", LONG).unwrap_err().to_string();
        assert!(error.contains("`two` before it ended") && error.contains("\n    one"), "{error}");
    }

    #[test]
    fn what_is_frozen_says_nothing() {
        let mut process = shell("echo $$; exec cat");
        process.expect("", LONG).unwrap();
        process.freeze().unwrap();
        process.send("one").unwrap();
        assert!(process.expect("one", Duration::from_millis(100)).is_err());
        process.thaw().unwrap();
        process.expect("one", LONG).unwrap();
    }

    #[test]
    fn nothing_outlives_its_owner() {
        let process = shell("echo $$; exec sleep 1000");
        let pid = process.seen("", LONG).unwrap().text;
        assert!(Path::new("/proc").join(&pid).exists());
        drop(process);
        assert!(!Path::new("/proc").join(&pid).exists());
    }
}
