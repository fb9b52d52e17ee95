//! A manager and a vehicle in processes, what they print, and what follows from it.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail};
use cara_processes::faults::{Calls, PATIENCE};
use cara_processes::{network, random_fleet};
use cara_test_keys::KeyFolder;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

use crate::Kind;
use crate::disk::Disk;
use crate::group::Group;
use crate::motion::{LEASE, Motion, Why};

pub(crate) const MANAGER: usize = 0;
pub(crate) const VEHICLE: usize = 1;
/// Between two tries to start what has ended, as a service manager does.
const RESTART: Duration = Duration::from_millis(300);
/// Units of CPU time in `/proc`, a second.
const TICKS: f64 = 100.0;

/// A line of a process of this life, or its end.
struct Said {
    at: Instant,
    side: usize,
    /// `None` of a program of `cara node`.
    life: Option<i64>,
    line: Option<String>,
}

/// A unit's process, if it runs.
#[derive(Default)]
struct Side {
    child: Option<Child>,
    /// How often it has been started.
    lives: i64,
    tried: Option<Instant>,
    frozen: Option<Instant>,
}

pub(crate) struct Pair {
    kind: Kind,
    fleet: u32,
    keys: KeyFolder,
    /// Control sockets, and what a process keeps that has no disk that fails.
    pub(crate) folder: TempDir,
    pub(crate) disk: Option<Disk>,
    sides: [Side; 2],
    said: (Sender<Said>, Receiver<Said>),
    calls: Calls,
    pub(crate) motion: Motion,
    pub(crate) answered_in_turn: usize,
    /// When a call was answered last.
    pub(crate) answered: Option<Instant>,
    /// By how many seconds the manager's time of day is ahead.
    pub(crate) clock_ahead: i64,
    /// During which processes may end by themselves.
    pub(crate) allowed: Option<Kind>,
    /// For how long the manager stood still.
    pub(crate) grace: Duration,
    crashes: usize,
    busiest: f64,
    /// Further processes of a fault.
    pub(crate) others: Vec<Child>,
    /// Words before the vehicle's command.
    pub(crate) vehicle_on: String,
}

impl Pair {
    pub(crate) fn start(kind: Kind) -> Result<Self> {
        let fleet = random_fleet();
        let keys = KeyFolder::draw(fleet, &["manager/1@m_unit", "agv/7@s_unit", "other/8@s_unit"])?;
        let folder = tempfile::tempdir()?;
        std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o700))?;
        let disk = matches!(kind, Kind::State(..) | Kind::Records(_)).then(Disk::new).transpose()?;
        let mut pair = Self {
            kind,
            fleet,
            keys,
            folder,
            disk,
            sides: Default::default(),
            said: channel(),
            calls: Calls::default(),
            motion: Motion::default(),
            answered_in_turn: 0,
            answered: None,
            clock_ahead: 0,
            allowed: None,
            grace: Duration::ZERO,
            crashes: 0,
            busiest: 0.0,
            others: Vec::new(),
            vehicle_on: String::new(),
        };
        if let Kind::Killed(side) = kind {
            Group::make(side)?;
        }
        if let Kind::Records(_) = kind {
            pair.listen_to_programs()?;
        }
        pair.set_clock(0)?;
        pair.launch(VEHICLE)?;
        pair.launch(MANAGER)?;
        Ok(pair)
    }

    /// A program of this test's fleet, whose state is in the folder of that side.
    pub(crate) fn command(&self, program: &Path, side: usize) -> Command {
        let mut command = Command::new(program);
        command.env("CARA_KEYS", self.keys.path()).env("CARA_CONTROL_DIR", self.folder.path());
        command.env("CARA_TEST_FLEET", self.fleet.to_string()).env("PATH", network::paths());
        command.env_remove("CARA_STATE").env_remove("STATE_DIRECTORY").env_remove("RUST_LOG");
        // A manager that keeps no claim claims by the time of day.
        if !(side == MANAGER && matches!(self.kind, Kind::Clock(_))) {
            command.env("CARA_STATE", self.state(side));
        }
        command
    }

    fn state(&self, side: usize) -> PathBuf {
        let fails = match self.kind {
            Kind::State(one, _) => one == side,
            Kind::Records(_) => side == VEHICLE,
            _ => false,
        };
        let disk = self.disk.as_ref().filter(|_| fails).map(Disk::path);
        disk.unwrap_or_else(|| self.folder.path().to_owned()).join(format!("state-{side}"))
    }

    fn pipe(&self) -> PathBuf {
        self.folder.path().join("pipe")
    }

    fn clock(&self) -> PathBuf {
        self.folder.path().join("clock")
    }

    /// What units that follow this clock take for the time of day is ahead by so much.
    pub(crate) fn set_clock(&self, seconds: i64) -> Result<()> {
        let path = self.folder.path().join("clock-next");
        std::fs::write(&path, format!("{seconds:+}"))?;
        Ok(std::fs::rename(path, self.clock())?)
    }

    /// Starts what does not run.
    pub(crate) fn launch(&mut self, side: usize) -> Result<()> {
        let words = format!("{} --exact as_child --ignored", std::env::current_exe()?.display());
        let words = match self.kind {
            Kind::Records(_) if side == VEHICLE => {
                let log = self.disk.as_ref().context("records have a disk")?.path().join("log");
                format!("exec {} node {} 2>>{}", env!("CARGO_BIN_EXE_cara"), self.node_file()?.display(), log.display())
            }
            Kind::Killed(one) if one == side => {
                format!("echo $$ >{}/cgroup.procs; exec {words}", Group::of(side)?.path())
            }
            _ if side == VEHICLE => format!("exec {} {words}", self.vehicle_on),
            _ => format!("exec {words}"),
        };
        let state = &mut self.sides[side];
        (state.lives, state.tried) = (state.lives + 1, Some(Instant::now()));
        let life = state.lives;
        let mut command = self.command(Path::new("sh"), side);
        command.args(["-c", &words]).env("CARA_TEST_LIFE", life.to_string());
        command.env("CARA_TEST_PART", ["manager", "vehicle"][side]);
        if let Kind::Clock(_) = self.kind {
            command.env("LD_PRELOAD", faketime()?).env("FAKETIME_TIMESTAMP_FILE", self.clock());
            command.env("FAKETIME_NO_CACHE", "1").env("FAKETIME_DONT_FAKE_MONOTONIC", "1");
            command.env("DONT_FAKE_MONOTONIC", "1");
        }
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let output = child.stdout.take().context("it has an output")?;
        self.listen(output, side, Some(life));
        self.sides[side].child = Some(child);
        Ok(())
    }

    fn listen(&self, output: impl Read + Send + 'static, side: usize, life: Option<i64>) {
        let said = self.said.0.clone();
        std::thread::spawn(move || {
            let lines = BufReader::new(output).lines().map_while(Result::ok).map(Some);
            for line in lines.chain([None]) {
                let _ = said.send(Said { at: Instant::now(), side, life, line });
            }
        });
    }

    /// `cara node` as the vehicle: its programs write into a pipe what they do.
    fn node_file(&self) -> Result<PathBuf> {
        let (fleet, pipe) = (self.fleet, self.pipe());
        let tell = |text: &str, rest: &str| {
            format!("run = ['sh', '-c', 'read -r line; echo {text} >{} {rest}']", pipe.display())
        };
        let text = format!(
            "name = 'agv'\nid = 7\nrole = 's_unit'\nfleet = {fleet}\ninterfaces = 'lo'\nmanager = {{ name = 'manager', id = 1 }}\n\
             [log]\nlevel = 'debug'\n\
             [[functions]]\nsignature = 'count(number: int) -> (number: int)'\n{}\n\
             [[functions]]\nsignature = 'drive()'\n{}\nlease = '{} ms'\nat_lease_end = ['sh', '-c', 'echo stands >{}']\n",
            tell("ran \"$line\"", "; echo \"$line\""),
            tell("drives", "; echo {}"),
            LEASE.as_millis(),
            pipe.display(),
        );
        let path = self.folder.path().join("agv.toml");
        std::fs::write(&path, text)?;
        Ok(path)
    }

    fn listen_to_programs(&self) -> Result<()> {
        network::run(&format!("mkfifo {}", self.pipe().display()))?;
        // It has a writer as long as it is read, and so no end.
        let pipe = std::fs::OpenOptions::new().read(true).write(true).open(self.pipe())?;
        self.listen(pipe, VEHICLE, None);
        Ok(())
    }

    /// Follows what is said until then.
    pub(crate) fn watch(&mut self, until: Instant) -> Result<()> {
        while Instant::now() < until {
            self.step()?;
        }
        Ok(())
    }

    /// Follows what is said until `condition` holds.
    pub(crate) fn until(&mut self, what: &str, condition: impl Fn(&Self) -> bool) -> Result<()> {
        let end = Instant::now() + PATIENCE;
        while !condition(self) {
            self.step()?;
            if Instant::now() > end {
                bail!("not in time: {what}");
            }
        }
        Ok(())
    }

    fn step(&mut self) -> Result<()> {
        match self.said.1.recv_timeout(Duration::from_millis(20)) {
            Ok(said) => self.heard(said),
            Err(RecvTimeoutError::Disconnected) => bail!("nothing is said any more"),
            Err(RecvTimeoutError::Timeout) => self.motion.look(Instant::now()),
        }
        for side in [MANAGER, VEHICLE] {
            let Side { child, tried, .. } = &self.sides[side];
            if child.is_none() && tried.is_none_or(|tried| tried.elapsed() > RESTART) {
                self.launch(side)?;
            }
        }
        Ok(())
    }

    fn heard(&mut self, said: Said) {
        let is_of_now = said.life.is_none_or(|life| life == self.sides[said.side].lives);
        let Some(line) = said.line else {
            if is_of_now && self.sides[said.side].child.is_some() {
                self.ended(said.side, said.at);
            }
            return;
        };
        let mut numbers =
            line.split(|byte: char| !byte.is_ascii_digit() && byte != '-').filter_map(|word| word.parse().ok());
        let mut next = || numbers.next().unwrap_or(-1);
        match line.split(' ').next().unwrap_or_default() {
            "ran" => self.calls.ran(next()),
            "answered" => {
                let (number, took, answer, unix) = (next(), next(), next(), next());
                let took = Duration::from_millis(took.unsigned_abs());
                self.calls.ended(number, Some(answer), took, self.grace);
                self.answered_in_turn += 1;
                self.answered = Some(said.at);
                self.compare_clock(unix);
            }
            "failed" => {
                let (number, took, unix) = (next(), next(), next());
                self.compare_clock(unix);
                self.calls.ended(number, None, Duration::from_millis(took.unsigned_abs()), self.grace);
                self.answered_in_turn = 0;
            }
            "drives" if is_of_now => self.motion.began(),
            "stands" if is_of_now => self.motion.stood(said.at),
            _ => {}
        }
    }

    fn compare_clock(&mut self, unix: i64) {
        let real = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        self.clock_ahead = unix - real.cast_signed();
    }

    /// Its process has ended by itself.
    fn ended(&mut self, side: usize, at: Instant) {
        if !self.allowed.is_some_and(|kind| kind.may_end(side)) {
            self.crashes += 1;
        }
        if let Some(mut child) = self.sides[side].child.take() {
            let status = child.wait();
            eprintln!("{} ended: {status:?}", ["manager", "vehicle"][side]);
        }
        self.gone(side, at);
    }

    fn gone(&mut self, side: usize, at: Instant) {
        match side {
            MANAGER => self.motion.must_stand(Why::Silence, at),
            _ => self.motion.ended(),
        }
    }

    pub(crate) fn allow(&mut self, kind: Kind) {
        self.allowed = Some(kind);
    }

    /// Ends it at once. It is not started before [`launch`](Self::launch), if that comes soon.
    pub(crate) fn kill(&mut self, side: usize) -> Result<()> {
        let Some(mut child) = self.sides[side].child.take() else { return Ok(()) };
        let at = Instant::now();
        child.kill()?;
        child.wait()?;
        self.sides[side].tried = Some(at);
        self.gone(side, at);
        Ok(())
    }

    pub(crate) fn freeze(&mut self, side: usize) -> Result<()> {
        let Some(child) = &self.sides[side].child else { return Ok(()) };
        let at = Instant::now();
        cara_processes::freeze(child)?;
        self.sides[side].frozen = Some(at);
        match side {
            MANAGER => self.motion.must_stand(Why::Silence, at),
            // It cannot now.
            _ => self.motion.may_move(),
        }
        Ok(())
    }

    pub(crate) fn thaw(&mut self, side: usize) -> Result<()> {
        let Some(frozen) = self.sides[side].frozen.take() else { return Ok(()) };
        let now = Instant::now();
        if side == MANAGER {
            self.grace = now - frozen;
            self.motion.may_move();
        } else if now - frozen > LEASE {
            self.motion.must_stand(Why::Thawed, now);
        }
        Ok(kill_process(Pid::from_raw(self.id(side)?.cast_signed()).context("a process")?, Signal::CONT)?)
    }

    pub(crate) fn id(&self, side: usize) -> Result<u32> {
        Ok(self.sides[side].child.as_ref().context("it has ended just now")?.id())
    }

    pub(crate) fn tell(&mut self, side: usize, line: &str) -> Result<()> {
        let input = self.sides[side].child.as_mut().and_then(|child| child.stdin.as_mut());
        Ok(writeln!(input.context("it has ended just now")?, "{line}")?)
    }

    /// A node that joins the manager, too.
    pub(crate) fn add_other(&mut self) -> Result<()> {
        let file = self.folder.path().join("other.toml");
        let text =
            "role = 's_unit'\ninterfaces = 'lo'\nmanager = { name = 'manager', id = 1 }\n[black_box]\nkeep = 0\n";
        std::fs::write(&file, format!("name = 'other'\nid = 8\nfleet = {}\n{text}", self.fleet))?;
        let mut command = self.command(Path::new(env!("CARGO_BIN_EXE_cara")), VEHICLE);
        let other = command.arg("node").arg(file).stdin(Stdio::null()).stderr(Stdio::null()).spawn()?;
        self.others.push(other);
        Ok(())
    }

    pub(crate) fn remove_others(&mut self) {
        for mut other in self.others.drain(..) {
            let _ = other.kill().and_then(|()| other.wait());
        }
    }

    /// The manager's control socket.
    pub(crate) fn socket(&self) -> PathBuf {
        self.folder.path().join(format!("manager-1-{}.sock", self.fleet))
    }

    /// How much of a processor each process that runs has used.
    pub(crate) fn processor_times(&self) -> [Option<(u32, f64)>; 2] {
        [MANAGER, VEHICLE].map(|side| {
            let id = self.id(side).ok()?;
            let line = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
            let mut fields = line.rsplit_once(") ")?.1.split(' ').skip(11).map_while(|field| field.parse::<f64>().ok());
            Some((id, (fields.next()? + fields.next()?) / TICKS))
        })
    }

    pub(crate) fn busy_since(&mut self, before: [Option<(u32, f64)>; 2], lasted: Duration) {
        for (before, after) in before.into_iter().zip(self.processor_times()) {
            if let (Some((id, before)), Some((same, after))) = (before, after)
                && id == same
            {
                self.busiest = self.busiest.max((after - before) / lasted.as_secs_f64());
            }
        }
    }

    /// Ends both, and says what became of calls, of the vehicle and of processes, and how busy one was with a fault.
    pub(crate) fn end(mut self) -> (Calls, Motion, usize, f64) {
        let ended = [MANAGER, VEHICLE].iter().all(|side| self.kill(*side).is_ok());
        assert!(ended, "a process that was started can be killed");
        // What they have said last.
        while let Ok(said) = self.said.1.recv_timeout(Duration::from_millis(200)) {
            if said.line.is_some() {
                self.heard(said);
            }
        }
        (std::mem::take(&mut self.calls), std::mem::take(&mut self.motion), self.crashes, self.busiest)
    }
}

impl Drop for Pair {
    fn drop(&mut self) {
        // What waits for a frozen disk cannot end.
        self.disk = None;
        self.remove_others();
        for side in &mut self.sides {
            if let Some(mut child) = side.child.take() {
                let _ = child.kill().and_then(|()| child.wait());
            }
        }
        if let Kind::Killed(side) = self.kind
            && let Ok(group) = Group::of(side)
        {
            group.remove();
        }
    }
}

/// Debian's `libfaketime`.
fn faketime() -> Result<PathBuf> {
    let folders = std::fs::read_dir("/usr/lib")?.filter_map(|entry| Some(entry.ok()?.path()));
    let mut places = folders.map(|folder| folder.join("faketime/libfaketimeMT.so.1"));
    places
        .find(|path| path.exists())
        .context("the time of day is changed by `libfaketime`: apt-get install libfaketime")
}
