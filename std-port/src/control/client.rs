//! The client: finds the socket of a running unit, asks, and reads the answers.

use std::fmt;
use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::net::SendFlags;

use super::lines::{Line, Lines};
use super::location::{self, LocationError, directories, own_uid, peer_pid, peer_uid};
use super::protocol::{Answer, BEAT, CONTROL_VERSION, Failure, Question};
use super::server::{FULL, full};
use crate::sys::epoll::wait_readable;

/// How long a unit may take to introduce itself.
const HELLO_TIMEOUT: Duration = Duration::from_secs(2);
/// A unit that has answered nothing for so long is looked at, and after growing pauses again.
const FIRST_LOOK: Duration = Duration::from_secs(2);
const LONGEST_LOOK: Duration = Duration::from_secs(30);
/// A unit that takes none of a question's bytes for so long hangs.
const ASKING: Duration = Duration::from_secs(5);
/// Between two looks at a queue of connections that is full.
const DIAL_PAUSE: Duration = Duration::from_millis(20);

/// A unit that has a control socket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunningUnit {
    /// Its `NAME/ID`; of one that does not say, as the name of its socket has it.
    pub unit: String,
    /// Its fleet.
    pub fleet: u32,
    /// Its socket.
    pub path: PathBuf,
    /// Whether it can be asked.
    pub state: UnitState,
}

/// Whether a unit with a control socket can be asked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum UnitState {
    /// It answers.
    Answers,
    /// It runs and has no free connection; its refusal.
    Full(String),
    /// It does not let this user in; why.
    Refuses(String),
    /// It holds its socket and does not answer: the process hangs or is stopped.
    Silent,
}

impl fmt::Display for RunningUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (fleet {})", self.unit, self.fleet)
    }
}

impl RunningUnit {
    /// Why it cannot be asked, if it cannot.
    pub fn refusal(&self) -> Option<ControlError> {
        let unit = self.unit.clone();
        match &self.state {
            UnitState::Answers => None,
            UnitState::Full(text) => Some(ControlError::Full { unit, text: text.clone() }),
            UnitState::Refuses(reason) => {
                Some(ControlError::NotAllowed { path: self.path.clone(), reason: reason.clone() })
            }
            UnitState::Silent => Some(ControlError::Silent { unit, path: self.path.clone() }),
        }
    }

    /// What can be told of a unit that does not introduce itself.
    fn unasked(path: &Path, state: UnitState) -> Self {
        let (unit, fleet) = location::reported_by_name(path);
        Self { unit, fleet, path: path.to_owned(), state }
    }

    /// Whether `wanted` is its `NAME/ID` or its `NAME`.
    pub fn is(&self, wanted: &str) -> bool {
        self.unit == wanted || self.unit.rsplit_once('/').is_some_and(|(name, _)| name == wanted)
    }
}

/// Why a question has no answer.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    /// No unit answers at the socket, or in the directories.
    #[error("no manager runs here (looked in {}): start one, or be the manager yourself with --as NAME/ID", paths(.0))]
    NoneRunning(Vec<PathBuf>),
    /// Units answer, and none of them is the one that is wanted.
    #[error("no manager '{wanted}' runs here; there are {}", list(running))]
    NotRunning {
        /// As it was asked for.
        wanted: String,
        /// Those that run.
        running: Vec<RunningUnit>,
    },
    /// Several units answer.
    #[error("several managers run here: name one of {}", list(.0))]
    Several(Vec<RunningUnit>),
    /// The socket is not this user's, who is none of its operators.
    #[error("{path}: {reason}")]
    NotAllowed {
        /// The socket or its directory.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The unit speaks another version of the control protocol.
    #[error(
        "the manager speaks version {theirs} of the control protocol and this command {CONTROL_VERSION}: update the older one"
    )]
    Version {
        /// The unit's version.
        theirs: u32,
    },
    /// The unit runs, and as many ask as may at a time.
    #[error("{unit} runs here, and its control socket has no connection free: {text}")]
    Full {
        /// Its `NAME/ID`.
        unit: String,
        /// What it says.
        text: String,
    },
    /// The unit holds its socket and does not answer.
    #[error(
        "the control socket of {unit} is open ({path}) and does not answer: the process hangs or is stopped; restart it, or ask its standby \
         once that commands"
    )]
    Silent {
        /// Its `NAME/ID`.
        unit: String,
        /// Its socket.
        path: PathBuf,
    },
    /// The unit could not answer.
    #[error("{0}")]
    Failed(Failure),
    /// The connection ended, or brought something else than answers.
    #[error("the connection to the manager broke: {0}")]
    Broken(#[from] io::Error),
}

fn list(units: &[RunningUnit]) -> String {
    let names: Vec<String> = units.iter().map(RunningUnit::to_string).collect();
    names.join(", ")
}

fn paths(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

impl From<LocationError> for ControlError {
    fn from(error: LocationError) -> Self {
        match error {
            LocationError::Foreign { ref path, .. } | LocationError::Open { ref path, .. } => {
                Self::NotAllowed { path: path.clone(), reason: error.to_string() }
            }
            LocationError::System { path, error } if error.kind() == io::ErrorKind::PermissionDenied => {
                Self::NotAllowed { path, reason: error.to_string() }
            }
            error => Self::Broken(io::Error::other(error.to_string())),
        }
    }
}

/// The units with a socket in the first of the [directories] of control sockets that has any; see [`running_in`].
pub fn running() -> Result<Vec<RunningUnit>, ControlError> {
    first_of(&directories(), running_in)
}

/// What the first directory has that has anything. An error of one, such as that others can enter it, counts where no
/// other one has anything.
pub fn first_of(
    directories: &[PathBuf],
    look: impl Fn(&Path) -> Result<Vec<RunningUnit>, ControlError>,
) -> Result<Vec<RunningUnit>, ControlError> {
    let mut nothing = Ok(Vec::new());
    for directory in directories {
        match look(directory) {
            Ok(found) if found.is_empty() => {}
            Ok(found) => return Ok(found),
            error => nothing = nothing.and(error),
        }
    }
    nothing
}

/// The units with a socket in a directory: those that answer, and those that run and cannot be asked now.
pub fn running_in(directory: &Path) -> Result<Vec<RunningUnit>, ControlError> {
    Ok(look_at(&location::sockets(directory)?))
}

/// As [`running_in`], of the units of this `NAME/ID` or `NAME` alone: one that hangs does not delay a question to
/// another one.
pub fn running_called(directory: &Path, wanted: &str) -> Result<Vec<RunningUnit>, ControlError> {
    let sockets = location::sockets(directory)?;
    let may_be =
        |path: &&PathBuf| !location::reports_name(path) || RunningUnit::unasked(path, UnitState::Silent).is(wanted);
    let found = look_at(&sockets.iter().filter(may_be).cloned().collect::<Vec<_>>());
    Ok(found.into_iter().filter(|unit| unit.is(wanted)).collect())
}

/// In parallel: each one that hangs takes the whole time-out.
fn look_at(sockets: &[PathBuf]) -> Vec<RunningUnit> {
    std::thread::scope(|scope| {
        let looking: Vec<_> = sockets.iter().map(|path| scope.spawn(|| look(path))).collect();
        looking.into_iter().filter_map(|looked| looked.join().ok().flatten()).collect()
    })
}

/// The unit behind a socket; `None` for one that is being stopped or speaks another protocol.
fn look(path: &Path) -> Option<RunningUnit> {
    match Client::connect(path) {
        Ok(client) => Some(client.unit),
        Err(ControlError::Full { text, .. }) => Some(RunningUnit::unasked(path, UnitState::Full(text))),
        Err(ControlError::NotAllowed { reason, .. }) => Some(RunningUnit::unasked(path, UnitState::Refuses(reason))),
        Err(ControlError::Silent { .. }) => Some(RunningUnit::unasked(path, UnitState::Silent)),
        Err(_) => None,
    }
}

/// A connection to a running unit.
///
/// ```no_run
/// use cara_std::control::Client;
/// use cara_std::control::protocol::{Answer, Question};
///
/// let mut client = Client::find(None)?;
/// for answer in client.ask(&Question::Nodes { offering: None })? {
///     if let Answer::Node(node) = answer? {
///         println!("{}/{}", node.name, node.id);
///     }
/// }
/// # Ok::<(), cara_std::control::ControlError>(())
/// ```
pub struct Client {
    lines: Lines<Connection>,
    unit: RunningUnit,
    /// Answers to the last question may still come.
    open: bool,
    /// Heartbeats are those of [`Closer::beat`] alone.
    leaves_beats: bool,
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client").field("unit", &self.unit).finish_non_exhaustive()
    }
}

impl Client {
    /// Connects to the socket at a path.
    pub fn connect(path: &Path) -> Result<Self, ControlError> {
        match Self::connect_to_stop(path)? {
            Self { unit: RunningUnit { unit, state: UnitState::Full(text), .. }, .. } => {
                Err(ControlError::Full { unit, text })
            }
            client => Ok(client),
        }
    }

    /// As [`connect`](Self::connect), also where all connections are in use: a few are kept for [`Question::Stop`], and the
    /// [state](RunningUnit::state) of such a one is [`UnitState::Full`].
    pub fn connect_to_stop(path: &Path) -> Result<Self, ControlError> {
        let stream = dial(path)?;
        let owner = peer_uid(&stream)?;
        if ![owner, own_uid()].contains(&0) && owner != own_uid() && !location::is_shared_by(path, owner) {
            let reason = format!("user {owner} answers there, and this is user {}", own_uid());
            return Err(ControlError::NotAllowed { path: path.to_owned(), reason });
        }
        stream.set_read_timeout(Some(HELLO_TIMEOUT))?;
        stream.set_write_timeout(Some(ASKING))?;
        let mut lines = Lines::new(Connection { stream, path: path.to_owned(), is_asked: false, beaten: None });
        let (unit, fleet, state) = hello(&mut lines).map_err(|error| refused(path, error))?;
        lines.source().stream.set_read_timeout(None)?;
        let unit = RunningUnit { unit, fleet, path: path.to_owned(), state };
        Ok(Self { lines, unit, open: false, leaves_beats: false })
    }

    /// Connects to the only unit that runs, or to the one that is meant by `NAME/ID` or `NAME`.
    pub fn find(unit: Option<&str>) -> Result<Self, ControlError> {
        Self::find_among(&directories(), unit)
    }

    /// As [`find`](Self::find), with the sockets of a directory.
    pub fn find_in(directory: &Path, unit: Option<&str>) -> Result<Self, ControlError> {
        Self::find_among(&[directory.to_owned()], unit)
    }

    fn find_among(directories: &[PathBuf], unit: Option<&str>) -> Result<Self, ControlError> {
        let running = first_of(directories, |directory| match unit {
            Some(wanted) => running_called(directory, wanted),
            None => running_in(directory),
        })?;
        let (refusing, others): (Vec<_>, Vec<_>) =
            running.into_iter().partition(|unit| matches!(unit.state, UnitState::Refuses(_)));
        let running = if others.is_empty() { refusing } else { others };
        match &running[..] {
            [] => Err(none(first_of(directories, running_in)?, directories, unit)),
            [only] => only.refusal().map_or_else(|| Self::connect(&only.path), Err),
            _ => Err(ControlError::Several(running)),
        }
    }

    /// The unit at the other end.
    pub fn unit(&self) -> &RunningUnit {
        &self.unit
    }

    /// A handle with which another thread closes the connection while answers are waited for. What was held is released.
    pub fn closer(&self) -> io::Result<Closer> {
        self.lines.source().stream.try_clone().map(Closer)
    }

    /// Sends no heartbeat by itself from here on: the program passes on those of the client it asks for, with
    /// [`Closer::beat`]. One that made them up would hold for a client that is gone.
    pub fn leave_beats(&mut self) {
        self.leaves_beats = true;
    }

    /// Asks. Unread answers to the previous question are skipped, which for [`Question::Watch`] never ends: drop the
    /// client instead.
    ///
    /// [`Question::Hold`] needs heartbeats, which the iterator sends while it waits for the next
    /// answer: a program that stops reading loses its lease.
    pub fn ask(&mut self, question: &Question) -> Result<Answers<'_>, ControlError> {
        while self.open {
            match self.next_answer() {
                Ok(_) | Err(ControlError::Failed(_)) => {}
                Err(error) => return Err(error),
            }
        }
        let mut line = serde_json::to_vec(question).map_err(io::Error::from)?;
        line.push(b'\n');
        let beaten = (question.needs_beats() && !self.leaves_beats).then(Instant::now);
        let connection = self.lines.source_mut();
        (connection.is_asked, connection.beaten) = (true, beaten);
        if let Err(error) = connection.stream.write_all(&line) {
            // Part of the question may be there: nothing can follow it.
            let _ = connection.stream.shutdown(Shutdown::Both);
            return Err(self.broken(error.into()));
        }
        self.open = true;
        Ok(Answers { client: self })
    }

    fn next_answer(&mut self) -> Result<Option<Answer>, ControlError> {
        let answer = read(&mut self.lines);
        self.open = matches!(answer, Ok(ref answer) if !matches!(answer, Answer::Done | Answer::Failed(_)));
        match answer.map_err(|error| self.broken(error))? {
            Answer::Done => Ok(None),
            Answer::Failed(failure) => Err(ControlError::Failed(failure)),
            answer => Ok(Some(answer)),
        }
    }

    /// What it means that the unit took or gave no more bytes.
    fn broken(&self, error: ControlError) -> ControlError {
        match error {
            ControlError::Broken(error) if is_silence(&error) => {
                let RunningUnit { unit, path, .. } = self.unit.clone();
                ControlError::Silent { unit, path }
            }
            error => error,
        }
    }
}

/// The stream to a unit. Once that has been asked, each read waits for bytes for as long as the unit lives: it may hang within
/// a line of its answer.
struct Connection {
    stream: UnixStream,
    path: PathBuf,
    is_asked: bool,
    /// When the last sign of life was sent, for a question that needs them.
    beaten: Option<Instant>,
}

impl Read for Connection {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if self.is_asked {
            self.await_bytes()?;
        }
        self.stream.read(bytes)
    }
}

impl Connection {
    /// Sends heartbeats, if they are due, until bytes arrive. [`io::ErrorKind::TimedOut`] if the unit hangs.
    fn await_bytes(&mut self) -> io::Result<()> {
        let mut look = Look::new();
        loop {
            let mut left = look.due.saturating_duration_since(Instant::now());
            if let Some(beaten) = self.beaten {
                left = left.min(BEAT.saturating_sub(beaten.elapsed()));
            }
            // The read reports what is wrong with the connection.
            if wait_readable(self.stream.as_fd(), left.into()).unwrap_or(true) {
                return Ok(());
            }
            if self.beaten.is_some_and(|beaten| beaten.elapsed() >= BEAT) {
                beat(&self.stream);
                self.beaten = Some(Instant::now());
            }
            if look.due <= Instant::now() && look.finds_silence(&self.stream, &self.path) {
                return Err(io::ErrorKind::TimedOut.into());
            }
        }
    }
}

/// Waits for nothing: a unit that does not read loses the heartbeat.
fn beat(stream: &UnixStream) {
    let _ = rustix::net::send(stream, b"\n", SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
}

/// Looks now and then, on a connection of its own, whether a unit that has not answered for a while still introduces itself.
struct Look {
    due: Instant,
    /// Until the next one.
    pause: Duration,
    /// Since when it is waited for, once that has begun.
    since: Option<Instant>,
    stream: Option<UnixStream>,
    was_silent: bool,
}

impl Look {
    fn new() -> Self {
        let (due, pause) = (Instant::now() + FIRST_LOOK, FIRST_LOOK);
        Self { due, pause, since: None, stream: None, was_silent: false }
    }

    /// Whether the unit was silent twice, or another process has its socket by now. Waits for nothing.
    fn finds_silence(&mut self, asked: &UnixStream, path: &Path) -> bool {
        let since = *self.since.get_or_insert_with(Instant::now);
        let (mut lives, mut replaced) = (false, false);
        if self.stream.is_none() {
            match location::dial(path) {
                Ok(stream) => self.stream = Some(stream),
                Err(error) => lives = error.kind() != io::ErrorKind::WouldBlock,
            }
        }
        if let Some(stream) = &self.stream {
            replaced = peer_pid(stream).ok() != peer_pid(asked).ok();
            lives = !replaced && wait_readable(stream.as_fd(), Duration::ZERO.into()).unwrap_or(true);
        }
        if !lives && !replaced && since.elapsed() < HELLO_TIMEOUT {
            self.due = Instant::now() + BEAT;
            return false;
        }
        // Once may be a busy host.
        let twice = !lives && self.was_silent;
        self.was_silent = !lives;
        self.pause = if lives { (self.pause * 2).min(LONGEST_LOOK) } else { BEAT };
        self.due = Instant::now() + self.pause;
        (self.since, self.stream) = (None, None);
        twice
    }
}

/// Closes the connection of a [`Client`].
#[derive(Debug)]
pub struct Closer(UnixStream);

impl Closer {
    /// Closes it: answers that are waited for end with [`ControlError::Broken`].
    pub fn close(&self) {
        // One that has ended cannot be closed, which is what is wanted.
        let _ = self.0.shutdown(Shutdown::Both);
    }

    /// Sends the heartbeat of a client whose call this connection holds. It waits for nothing: a unit that does not read loses
    /// it, as the connection's end.
    pub fn beat(&self) {
        beat(&self.0);
    }
}

/// None of the units that run is meant.
fn none(running: Vec<RunningUnit>, directories: &[PathBuf], wanted: Option<&str>) -> ControlError {
    match wanted.filter(|_| !running.is_empty()) {
        Some(wanted) => ControlError::NotRunning { wanted: wanted.to_owned(), running },
        None => ControlError::NoneRunning(directories.to_owned()),
    }
}

/// Connects; a queue of connections that stays full means that the unit accepts none of them.
fn dial(path: &Path) -> Result<UnixStream, ControlError> {
    let start = Instant::now();
    loop {
        let error = match location::dial(path) {
            Ok(stream) => return Ok(stream),
            Err(error) => error,
        };
        return Err(match error.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused => {
                ControlError::NoneRunning(vec![path.to_owned()])
            }
            io::ErrorKind::PermissionDenied => {
                ControlError::NotAllowed { path: path.to_owned(), reason: error.to_string() }
            }
            io::ErrorKind::WouldBlock if start.elapsed() < HELLO_TIMEOUT => {
                std::thread::sleep(DIAL_PAUSE);
                continue;
            }
            _ => refused(path, ControlError::Broken(error)),
        });
    }
}

/// What it means that a unit did not introduce itself.
fn refused(path: &Path, error: ControlError) -> ControlError {
    let unit = location::reported_by_name(path).0;
    match error {
        ControlError::Failed(failure) if failure.error == FULL => ControlError::Full { unit, text: failure.text },
        ControlError::Failed(failure) if failure.error == "NotAllowed" => {
            ControlError::NotAllowed { path: path.to_owned(), reason: failure.text }
        }
        ControlError::Broken(error) if is_silence(&error) => ControlError::Silent { unit, path: path.to_owned() },
        error => error,
    }
}

fn is_silence(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut)
}

/// The unit's `NAME/ID` and fleet, and whether it can be asked.
fn hello(lines: &mut Lines<Connection>) -> Result<(String, u32, UnitState), ControlError> {
    match read(lines)? {
        Answer::Hello { control_version: CONTROL_VERSION, unit, fleet, full: is_full } => {
            Ok((unit, fleet, if is_full { UnitState::Full(full().text) } else { UnitState::Answers }))
        }
        Answer::Hello { control_version: theirs, .. } => Err(ControlError::Version { theirs }),
        Answer::Failed(failure) => Err(ControlError::Failed(failure)),
        _ => Err(io::Error::new(io::ErrorKind::InvalidData, "it did not introduce itself").into()),
    }
}

fn read(lines: &mut Lines<Connection>) -> Result<Answer, ControlError> {
    match lines.next()? {
        Some(Line::Text(text)) => Ok(serde_json::from_slice(text).map_err(io::Error::from)?),
        Some(Line::TooLong) => Err(io::Error::new(io::ErrorKind::InvalidData, "an answer was too long").into()),
        None => Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
    }
}

/// The answers to one question, up to its end.
#[derive(Debug)]
pub struct Answers<'c> {
    client: &'c mut Client,
}

impl Iterator for Answers<'_> {
    type Item = Result<Answer, ControlError>;

    fn next(&mut self) -> Option<Self::Item> {
        if !self.client.open {
            return None;
        }
        self.client.next_answer().transpose()
    }
}
