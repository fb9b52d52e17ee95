//! An emulator session: the firmware, its manager and a prompt for `cara` beside it, in a network of their own.

use std::ffi::OsString;
use std::io::{BufRead, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::rc::Rc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_processes::Process;
use cara_std::Identity;
use clap::Args;
use rustix::process::Signal;
use tempfile::TempDir;

use crate::Arguments;
use crate::board::{Bench, LONG, Who};
use crate::keys::Keys;

/// The board and the manager of a session.
#[derive(Args, Clone, Debug)]
pub(crate) struct Session {
    /// The vehicle's name.
    #[arg(long, default_value = "agv-17", value_parser = word)]
    name: String,
    /// The vehicle's ID number.
    #[arg(long, default_value_t = 17)]
    id: u32,
    /// Its manager, as NAME/ID.
    #[arg(long, value_name = "NAME/ID", default_value = "depot/1", value_parser = manager)]
    manager: String,
    /// Their fleet.
    #[arg(long, default_value_t = 0)]
    fleet: u32,
    /// The `cara` command; the one beside this program if not given.
    #[arg(long)]
    cara: Option<PathBuf>,
}

/// A name that can be told to a board.
fn word(text: &str) -> Result<String, String> {
    if text.contains(char::is_whitespace) {
        return Err("a board is told its settings as words, so that names in a session have no blanks".into());
    }
    Identity::s_unit(text, 1).map_err(|error| error.to_string())?;
    Ok(text.to_owned())
}

fn manager(text: &str) -> Result<String, String> {
    let (name, id) = text.split_once('/').ok_or("write NAME/ID, as in depot/1")?;
    id.parse::<u32>().map_err(|_| "the ID behind the slash is a number from 0 to 4294967295")?;
    word(name).map(|_| text.to_owned())
}

/// What a line is prompted with.
const PROMPT: &str = "cara> ";

/// Starts everything, then runs what is typed until the input ends.
pub(crate) fn run(of: &Arguments, session: &Session) -> Result<()> {
    let Session { name, id, manager, fleet, cara } = session.clone();
    let keys = Keys::draw(cara.as_deref(), fleet, &manager, &[&format!("{name}/{id}")])?;
    let bench = Bench::new(of.board, &of.image, true, Rc::clone(&keys))?;
    let cable = bench.cable()?;
    let cara = Cara(keys);
    let _manager = cara.manager(&manager, fleet)?;
    let board = bench.board(&cable, &Who { name, id, manager, fleet, ..Who::agv(id) })?;
    board.logs("has joined")?;
    cara.wait_for(&session.name)?;
    println!("verbs of cara can be typed, as scan, or: call {0} stop; Ctrl-D or `exit` ends it", session.name);
    let input = std::io::stdin();
    let typed = input.is_terminal();
    prompt()?;
    for line in input.lock().lines() {
        let line = line?;
        if !typed {
            println!("{line}");
        }
        if matches!(line.trim(), "exit" | "quit") {
            return Ok(());
        }
        cara.run(&line)?;
        prompt()?;
    }
    println!();
    Ok(())
}

fn prompt() -> Result<()> {
    print!("{PROMPT}");
    Ok(std::io::stdout().flush()?)
}

/// The command, with keys and control sockets of this session only.
struct Cara(Rc<Keys>);

impl Cara {
    fn command(&self) -> Command {
        self.0.command()
    }

    fn manager(&self, who: &str, fleet: u32) -> Result<Manager> {
        let (name, id) = who.split_once('/').with_context(|| format!("a manager is NAME/ID, not `{who}`"))?;
        let fleet = fleet.to_string();
        let mut command = self.command();
        command.args(["node", "--name", name, "--id", id, "--fleet", &fleet]);
        Ok(Manager(command.spawn().context("cannot start cara")?))
    }

    /// Waits until the manager shows the functions of a vehicle.
    fn wait_for(&self, name: &str) -> Result<()> {
        let deadline = Instant::now() + LONG;
        let shown = || self.command().args(["functions", name]).stderr(Stdio::null()).output();
        while !shown()?.stdout.windows(5).any(|text| text == b"go_to") {
            ensure!(Instant::now() < deadline, "{name} has published nothing");
            std::thread::sleep(Duration::from_millis(100));
        }
        Ok(())
    }

    /// Runs a line. What it says on its error output comes with the rest, in order.
    fn run(&self, line: &str) -> Result<()> {
        let words = match shlex::split(line) {
            None => {
                println!("a quote is open");
                return Ok(());
            }
            Some(words) => words,
        };
        // The leading `cara` of a shell is accepted.
        let words = words.strip_prefix(["cara".to_owned()].as_slice()).unwrap_or(&words);
        if words.is_empty() {
            return Ok(());
        }
        // Open for as long as this session is: what `--hold` holds ends with it.
        let (input, _open) = std::io::pipe()?;
        let output = self.command().args(words).stdin(input).output().context("cannot start cara")?;
        let mut shown = std::io::stdout().lock();
        shown.write_all(&output.stdout)?;
        shown.write_all(&output.stderr)?;
        Ok(())
    }
}

/// The manager's process; dropping it ends it.
struct Manager(Child);

impl Drop for Manager {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What is typed in the test, and what must come of it, in this order.
const TYPED: [(&str, &str); 7] = [
    ("scan", "agv-17"),
    ("cara scan", "agv-17"),
    ("functions agv-17", "go_to(position: int[2])"),
    ("call agv-17 'pos_info(position: [7, 7])'", "position: [0, 0]"),
    ("call agv-17 'go_to(position: [1, 0])' --hold", "agv-17: "),
    ("call agv-17 fly_to", "fly_to"),
    ("call 'agv-17", "a quote is open"),
];

/// The emulator session, with commands piped into it.
pub(crate) fn test(of: &Arguments) -> Result<String> {
    let program = std::env::current_exe()?;
    let mut session = Process::start("the session", &program, arguments(of))?;
    session.seen("INFO started because of", LONG)?;
    for (line, answer) in TYPED {
        session.send(line)?;
        session.expect(&format!("{PROMPT}{line}"), LONG)?;
        session.expect(answer, LONG)?;
    }
    session.seen("INFO arrived at 1 0", LONG)?;
    session.send("exit")?;
    let ended = session.wait(LONG)?;
    if !ended.success() {
        bail!("it ended with {ended}");
    }
    for wrapper in ["env", "nohup"] {
        leaves_no_keys(wrapper, &program, of).with_context(|| format!("started by {wrapper}"))?;
    }
    Ok("what is typed is run, what the board logs is shown, and no keys stay behind".into())
}

fn arguments(of: &Arguments) -> Vec<OsString> {
    let mut arguments = vec!["--board".into(), of.board.name().into()];
    arguments.extend(["--image".into(), of.image.as_os_str().to_owned(), "session".into()]);
    arguments.extend(of.cara.iter().flat_map(|cara| ["--cara".into(), cara.as_os_str().to_owned()]));
    arguments
}

/// A session that a signal ends takes its keys along, whatever signals it was started to ignore.
fn leaves_no_keys(wrapper: &str, program: &Path, of: &Arguments) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let mut session = process_in(&folder, wrapper, program, of)?;
    session.seen("Ctrl-D", LONG)?;
    ensure!(std::fs::read_dir(folder.path())?.next().is_some(), "the session has its keys elsewhere");
    session.terminate(LONG)?;
    becomes_empty(&folder)
}

/// How long a session takes until it can be typed at, on a machine that does nothing else.
const STARTS: Duration = Duration::from_millis(1_500);
/// Signals that end a session; the last one does not below `nohup`.
const ENDS: [Signal; 3] = [Signal::TERM, Signal::INT, Signal::HUP];

/// Ends sessions by signals at random moments of their start, every second one below `nohup`; none leaves keys behind.
pub(crate) fn ends(of: &Arguments, times: u32) -> Result<()> {
    let program = std::env::current_exe()?;
    let mut dice = fastrand::Rng::new();
    let mut with_keys = 0;
    for number in 0..times {
        let folder = tempfile::tempdir()?;
        let (wrapper, signals) = if number.is_multiple_of(2) { ("env", 3) } else { ("nohup", 2) };
        let mut session = process_in(&folder, wrapper, &program, of)?;
        std::thread::sleep(STARTS.mul_f64(dice.f64()));
        with_keys += u32::from(std::fs::read_dir(folder.path())?.next().is_some());
        let signal = dice.choice(ENDS.iter().take(signals)).copied().unwrap_or(Signal::TERM);
        session.signal(signal)?;
        session.wait(LONG)?;
        becomes_empty(&folder).with_context(|| format!("end {number}, below {wrapper}, by {signal:?}"))?;
    }
    println!("{times} sessions ended by a signal, {with_keys} of them with keys; none left any");
    Ok(())
}

/// A session whose keys are in a folder.
fn process_in(folder: &TempDir, wrapper: &str, program: &Path, of: &Arguments) -> Result<Process> {
    let mut place = OsString::from("TMPDIR=");
    place.push(folder.path());
    let words = ["env".into(), place, program.as_os_str().to_owned()].into_iter().chain(arguments(of));
    Process::start("the session", Path::new(wrapper), words)
}

/// What runs in a session's network ends a moment later than the session.
fn becomes_empty(folder: &TempDir) -> Result<()> {
    let deadline = Instant::now() + LONG;
    while std::fs::read_dir(folder.path())?.next().is_some() {
        ensure!(Instant::now() < deadline, "the session has left keys in {}", folder.path().display());
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}
