//! Boards in QEMU or rp2040js, each behind a virtual cable to one bridge, and what they log.

use std::cell::Cell;
use std::io::Read;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::rc::Rc;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_processes::network;
use defmt_decoder::{DecodeError, Table};
use rustix::process::{Pid, Signal, kill_process};

use crate::keys::{Keys, MANAGER as DEPOT};
use crate::line::{self, Line};
use crate::machine::Machine;
use crate::rp2040::{self, Events, Wire};
use crate::trace::Trace;

/// Long enough for the slowest machine.
pub(crate) const LONG: Duration = Duration::from_secs(60);
/// The fleet of all units here; the network has no other units.
pub(crate) const FLEET: u32 = 4711;
/// The manager's address.
const MANAGER: &str = "10.77.0.1/24";

/// The bench that boards run on: image, bridge, names.
pub(crate) struct Bench {
    image: PathBuf,
    table: Arc<Table>,
    shows_logs: bool,
    /// Another image, which draws the same random numbers in each boot, and has a service that takes lists.
    constant: Option<PathBuf>,
    /// The board's clock counts instructions.
    counts: bool,
    /// What its boards are.
    machine: Machine,
    /// How many there are, also of other benches on this bridge.
    cables: Rc<Cell<u8>>,
    /// Of the boards, and of their manager.
    pub(crate) keys: Rc<Keys>,
}

impl Bench {
    /// Makes the network.
    pub(crate) fn new(machine: Machine, image: &Path, shows_logs: bool, keys: Rc<Keys>) -> Result<Self> {
        network::run("ip link set lo up")?;
        network::run("ip link add bridge0 type bridge")?;
        network::run(&format!("ip address add {MANAGER} brd + dev bridge0"))?;
        network::run("ip link set bridge0 up")?;
        let (table, image, cables) = (table_of(image)?, image.to_owned(), Rc::default());
        Ok(Self { image, table, shows_logs, constant: None, counts: false, machine, cables, keys })
    }

    /// Times on its boards are counted in instructions, and do not depend on how busy this machine is.
    pub(crate) fn counting(self) -> Self {
        Self { counts: true, ..self }
    }

    /// The image of its boards.
    pub(crate) fn image(&self) -> &Path {
        &self.image
    }

    /// What its boards are.
    pub(crate) fn machine(&self) -> Machine {
        self.machine
    }

    /// Whether its boards can be told to draw the same numbers in each life.
    pub(crate) fn takes_seeds(&self) -> bool {
        self.machine != Machine::Rp2040
    }

    /// The same bench for boards that are told other things.
    pub(crate) fn with(&self, keys: Rc<Keys>) -> Self {
        let (image, table, cables) = (self.image.clone(), Arc::clone(&self.table), Rc::clone(&self.cables));
        let Self { shows_logs, counts, machine, .. } = *self;
        Self { image, table, shows_logs, constant: self.constant.clone(), counts, machine, cables, keys }
    }

    /// Has that image beside.
    pub(crate) fn with_constant(self, constant: Option<PathBuf>) -> Self {
        Self { constant, ..self }
    }

    /// The same bench for that image, if there is one.
    pub(crate) fn constant(&self) -> Result<Option<Self>> {
        let Some(image) = self.constant.clone() else { return Ok(None) };
        let table = table_of(&image)?;
        Ok(Some(Self { image, table, ..self.with(Rc::clone(&self.keys)) }))
    }

    /// A cable with nothing at its end yet.
    pub(crate) fn cable(&self) -> Result<Cable> {
        let number = self.cables.get() + 1;
        self.cables.set(number);
        let name = format!("tap{number}");
        network::run(&format!("ip tuntap add name {name} mode tap"))?;
        network::run(&format!("ip link set {name} master bridge0"))?;
        let wire = (self.machine == Machine::Rp2040).then(|| Wire::lay(&name, self.keys.folder())).transpose()?;
        let cable = Cable { name, number, wire };
        cable.plug_in()?;
        Ok(cable)
    }

    /// Puts power on a board.
    pub(crate) fn board(&self, cable: &Cable, who: &Who) -> Result<Board> {
        let said = if self.machine == Machine::Rp2040 { Stdio::inherit() } else { Stdio::null() };
        self.start(self.emulator(cable, who)?.stderr(said), who)
    }

    /// The same with what happens at the pins of an RP2040.
    pub(crate) fn watched_board(&self, cable: &Cable, who: &Who) -> Result<(Board, Events)> {
        self.watch(&mut self.emulator(cable, who)?, who)
    }

    /// The same, whose power goes at a phase of its second write to flash, which stores its manager's claim.
    pub(crate) fn board_that_loses_power(&self, cable: &Cable, who: &Who, phase: &str) -> Result<(Board, Events)> {
        self.watch(self.emulator(cable, who)?.arg(format!("--cut={phase}:2")), who)
    }

    fn watch(&self, emulator: &mut Command, who: &Who) -> Result<(Board, Events)> {
        let mut board = self.start(emulator.arg("--events").stderr(Stdio::piped()), who)?;
        let output = board.child.stderr.take().context("the emulator has no standard error")?;
        Ok((board, Events::read(output)))
    }

    /// The same with everything that it executes, instruction by instruction.
    pub(crate) fn traced_board(&self, cable: &Cable, who: &Who) -> Result<(Board, Trace)> {
        let mut emulator = self.emulator(cable, who)?;
        let mut board = self.start(emulator.args(Trace::ARGUMENTS).stderr(Stdio::piped()), who)?;
        let output = board.child.stderr.take().context("the emulator has no standard error")?;
        Ok((board, Trace::read(output)))
    }

    /// Puts power on a board whose network is a serial line.
    pub(crate) fn board_on_line(&self, line: &Line, who: &Who) -> Result<Board> {
        let uart = format!("unix:{}", line.socket().display());
        let network = ["-serial", &uart, "-nic", "none"];
        self.start(self.emulator_with(&network, line::BOARD, who)?.stderr(Stdio::null()), who)
    }

    fn emulator(&self, cable: &Cable, who: &Who) -> Result<Command> {
        let Cable { name, number, wire } = cable;
        let address = format!("{}/24", address(cable));
        if let Some(wire) = wire {
            let (settings, flash) = self.keys.reported(self.machine.name(), who, &address)?;
            let mut command = first("node");
            command.arg(rp2040::SCRIPTS.to_owned() + "board.mjs").arg(wire.socket()).arg(flash);
            command.arg(self.image.with_extension("uf2")).arg(settings);
            return Ok(command);
        }
        let model = self.machine.controller();
        let nic = format!("tap,ifname={name},script=no,downscript=no,model={model},mac=52:54:00:00:00:{number:02x}");
        self.emulator_with(&["-serial", "none", "-nic", &nic], &address, who)
    }

    fn emulator_with(&self, network: &[&str], address: &str, who: &Who) -> Result<Command> {
        let (reported, boots) = self.keys.reported(self.machine.name(), who, address)?;
        let seed = who.seed.map_or_else(String::new, |seed| format!(" seed={seed}"));
        let reported = format!("file={} boots={}{seed}", reported.display(), boots.display());
        let mut command = first("qemu-system-arm");
        command
            .args(["-M", self.machine.name(), "-display", "none", "-monitor", "none"])
            .arg("-semihosting-config")
            .arg(format!("enable=on,target=native,arg=agv,arg={reported}"))
            .arg("-kernel")
            .arg(&self.image)
            .args(
                self.counts
                    .then(|| ["-icount".to_owned(), format!("shift={}", self.machine.instruction())])
                    .into_iter()
                    .flatten(),
            )
            .args(network);
        Ok(command)
    }

    fn start(&self, emulator: &mut Command, who: &Who) -> Result<Board> {
        let emulator = emulator.stdin(Stdio::null()).stdout(Stdio::piped());
        let mut child = emulator.spawn().context("cannot start qemu-system-arm")?;
        let log = Arc::new(Log::default());
        if let Some(output) = child.stdout.take() {
            let (log, table) = (log.clone(), self.table.clone());
            let shown = self.shows_logs.then(|| who.name.clone());
            std::thread::spawn(move || log.read(output, &table, shown.as_deref()));
        }
        Ok(Board { child, log, name: who.name.clone() })
    }
}

/// A program ahead of what else the host runs, where that is allowed: a clock that counts instructions loses the time in which the
/// emulator has no turn, as no chip does.
fn first(program: &str) -> Command {
    let mut command = Command::new("nice");
    command.args(["-n", "-10", program]);
    command
}

/// How the lines of an image's log are read.
fn table_of(image: &Path) -> Result<Arc<Table>> {
    let elf = std::fs::read(image).with_context(|| format!("cannot read {}", image.display()))?;
    Ok(Arc::new(Table::parse(&elf)?.with_context(|| format!("{} has no defmt table", image.display()))?))
}

/// The address of the board at the end of a cable.
pub(crate) fn address(cable: &Cable) -> Ipv4Addr {
    Ipv4Addr::new(10, 77, 0, 100 + cable.number)
}

/// A virtual cable between a board and the bridge.
pub(crate) struct Cable {
    name: String,
    number: u8,
    /// To a board that does not open the device by itself.
    wire: Option<Wire>,
}

impl Cable {
    pub(crate) fn plug_in(&self) -> Result<()> {
        self.wire.iter().for_each(|wire| wire.plug(true));
        network::run(&format!("ip link set {} up", self.name))
    }

    pub(crate) fn pull(&self) -> Result<()> {
        if let Some(wire) = &self.wire {
            wire.plug(false);
            return Ok(());
        }
        network::run(&format!("ip link set {} down", self.name))
    }

    /// Cuts one of its wires: nothing goes that way any more, and neither end is told.
    pub(crate) fn cut(&self, way: Way) -> Result<()> {
        let Self { name, .. } = self;
        let (hook, port) = match way {
            Way::ToBoard => ("output", "oifname"),
            Way::FromBoard => ("input", "iifname"),
        };
        network::filter(&format!("bridge {name}"), hook, &format!("{port} {name} drop"))
    }

    /// Joins the wire that was cut.
    pub(crate) fn join(&self) -> Result<()> {
        network::run(&format!("nft delete table bridge {}", self.name))
    }
}

/// One of the ways through a cable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    ToBoard,
    FromBoard,
}

/// What a board is told.
#[derive(Clone, Debug)]
pub(crate) struct Who {
    pub(crate) name: String,
    pub(crate) id: u32,
    /// Its manager, as NAME/ID.
    pub(crate) manager: String,
    pub(crate) fleet: u32,
    /// The same numbers in each life.
    pub(crate) seed: Option<u64>,
    /// Where its manager is, if it is not to search.
    pub(crate) manager_address: Option<&'static str>,
}

impl Who {
    pub(crate) fn agv(id: u32) -> Self {
        let (name, manager) = (format!("agv-{id}"), DEPOT.into());
        Self { name, id, manager, fleet: FLEET, seed: None, manager_address: None }
    }
}

/// A board that has power. Dropping it takes the power away.
pub(crate) struct Board {
    child: Child,
    log: Arc<Log>,
    name: String,
}

impl Board {
    /// Waits until the board has logged `text`, among all that it has logged in this life.
    pub(crate) fn logs(&self, text: &str) -> Result<()> {
        self.logs_behind(0, text).map(drop)
    }

    /// Waits until the board has logged `text` at or behind line `from`; the number of the line behind it.
    pub(crate) fn logs_behind(&self, from: usize, text: &str) -> Result<usize> {
        self.finds(from, text).map(|(line, _)| line)
    }

    /// As [`logs_behind`](Self::logs_behind), with what the line says.
    pub(crate) fn finds(&self, from: usize, text: &str) -> Result<(usize, String)> {
        self.finds_any(from, &[text])
    }

    /// As [`finds`](Self::finds), with the first line that has one of several texts.
    pub(crate) fn finds_any(&self, from: usize, texts: &[&str]) -> Result<(usize, String)> {
        self.finds_within(LONG, from, texts)
    }

    /// As [`finds_any`](Self::finds_any), for so long.
    pub(crate) fn finds_within(&self, span: Duration, from: usize, texts: &[&str]) -> Result<(usize, String)> {
        let deadline = Instant::now() + span;
        let has = |line: &str| texts.iter().any(|text| line.contains(text));
        let mut lines = self.log.lock();
        loop {
            if let Some((at, line)) = lines.iter().enumerate().skip(from).find(|(_, line)| has(line)) {
                return Ok((at + 1, line.clone()));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                bail!("{} did not log `{}`; it logged:\n    {}", self.name, texts.join("` or `"), lines.join("\n    "));
            }
            lines = self.log.news.wait_timeout(lines, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// The last line so far that contains `text`.
    pub(crate) fn last_with(&self, text: &str) -> Option<String> {
        self.log.lock().iter().rev().find(|line| line.contains(text)).cloned()
    }

    /// The lines logged at or behind line `from`.
    pub(crate) fn lines(&self, from: usize) -> Vec<String> {
        self.log.lock().iter().skip(from).cloned().collect()
    }

    /// Lines logged so far.
    pub(crate) fn line(&self) -> usize {
        self.log.lock().len()
    }

    /// Holds it up, as a hung processor.
    pub(crate) fn freeze(&self) -> Result<()> {
        cara_processes::freeze(&self.child).with_context(|| format!("{} cannot be held up", self.name))
    }

    /// Lets it go on.
    pub(crate) fn thaw(&self) -> Result<()> {
        self.signal(Signal::CONT)
    }

    /// Presses the button of an RP2040.
    pub(crate) fn press(&self) -> Result<()> {
        self.signal(Signal::USR2)
    }

    fn signal(&self, signal: Signal) -> Result<()> {
        kill_process(Pid::from_child(&self.child), signal).with_context(|| format!("{} takes no signal", self.name))
    }

    /// Does something until it has lost its power by itself.
    pub(crate) fn loses_power(mut self, mut act: impl FnMut()) -> Result<()> {
        let deadline = Instant::now() + LONG;
        while self.child.try_wait()?.is_none() {
            ensure!(Instant::now() < deadline, "{} runs on", self.name);
            act();
        }
        Ok(())
    }

    /// Takes its power.
    pub(crate) fn cut_power(mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What a board has logged, decoded.
#[derive(Default)]
struct Log {
    lines: Mutex<Vec<String>>,
    news: Condvar,
}

impl Log {
    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<String>> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn read(&self, mut from: impl Read, table: &Table, shown: Option<&str>) {
        let mut decoder = table.new_stream_decoder();
        let mut bytes = [0; 1024];
        while let Ok(length @ 1..) = from.read(&mut bytes) {
            decoder.received(&bytes[..length]);
            loop {
                match decoder.decode() {
                    Ok(frame) => {
                        let line = frame.display(false).to_string();
                        shown.into_iter().for_each(|name| println!("    {name}: {line}"));
                        self.lock().push(line);
                        self.news.notify_all();
                    }
                    Err(DecodeError::UnexpectedEof) => break,
                    Err(DecodeError::Malformed) => {}
                }
            }
        }
    }
}
