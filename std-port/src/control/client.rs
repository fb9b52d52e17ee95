//! The other end: finds the socket of a running unit, asks, and reads the answers.

use std::io::{self, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::lines::{Line, Lines};
use super::place::{self, PlaceError, directory, own_uid, peer_uid};
use super::protocol::{Answer, CONTROL_VERSION, Failure, Question};

/// How long a unit may take to introduce itself.
const HELLO_TIMEOUT: Duration = Duration::from_secs(2);

/// A unit that answers on a control socket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunningUnit {
    /// Its `NAME/ID`.
    pub unit: String,
    /// Its fleet.
    pub fleet: u32,
    /// Its socket.
    pub path: PathBuf,
}

impl std::fmt::Display for RunningUnit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} (fleet {})", self.unit, self.fleet)
    }
}

impl RunningUnit {
    /// Whether `wanted` is its `NAME/ID` or its `NAME`.
    fn is(&self, wanted: &str) -> bool {
        self.unit == wanted || self.unit.rsplit_once('/').is_some_and(|(name, _)| name == wanted)
    }
}

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    /// No unit answers in the directory.
    #[error("no manager runs here (looked in {0}): start one, or be the manager yourself with --as NAME/ID")]
    NoneRunning(PathBuf),
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
    /// The socket is not this user's.
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

impl From<PlaceError> for ControlError {
    fn from(error: PlaceError) -> Self {
        match error {
            PlaceError::Foreign { ref path, .. } | PlaceError::Open { ref path, .. } => {
                Self::NotAllowed { path: path.clone(), reason: error.to_string() }
            }
            PlaceError::System { path, error } if error.kind() == io::ErrorKind::PermissionDenied => {
                Self::NotAllowed { path, reason: error.to_string() }
            }
            error => Self::Broken(io::Error::other(error.to_string())),
        }
    }
}

/// The units that answer in the [directory] of control sockets.
pub fn running() -> Result<Vec<RunningUnit>, ControlError> {
    running_in(&directory())
}

/// The units that answer in a directory.
pub fn running_in(directory: &Path) -> Result<Vec<RunningUnit>, ControlError> {
    let sockets = place::sockets(directory)?;
    // One that is being stopped, or stands still, is none that answers.
    Ok(sockets.iter().filter_map(|path| Client::connect(path).ok()).map(|client| client.unit).collect())
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
    lines: Lines<UnixStream>,
    unit: RunningUnit,
    /// Answers to the last question may still come.
    open: bool,
}

impl Client {
    /// Connects to the socket at a path.
    pub fn connect(path: &Path) -> Result<Self, ControlError> {
        let stream = place::dial(path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused => ControlError::NoneRunning(path.to_owned()),
            io::ErrorKind::PermissionDenied => {
                ControlError::NotAllowed { path: path.to_owned(), reason: error.to_string() }
            }
            _ => ControlError::Broken(error),
        })?;
        let owner = peer_uid(&stream)?;
        if ![owner, own_uid()].contains(&0) && owner != own_uid() {
            let reason = format!("user {owner} answers there, and this is user {}", own_uid());
            return Err(ControlError::NotAllowed { path: path.to_owned(), reason });
        }
        stream.set_read_timeout(Some(HELLO_TIMEOUT))?;
        let mut lines = Lines::new(stream);
        let (unit, fleet) = hello(&mut lines)?;
        lines.source().set_read_timeout(None)?;
        Ok(Self { lines, unit: RunningUnit { unit, fleet, path: path.to_owned() }, open: false })
    }

    /// Connects to the only unit that runs, or to the one that is meant by `NAME/ID` or `NAME`.
    pub fn find(unit: Option<&str>) -> Result<Self, ControlError> {
        Self::find_in(&directory(), unit)
    }

    /// As [`find`](Self::find), with the sockets of a directory.
    pub fn find_in(directory: &Path, unit: Option<&str>) -> Result<Self, ControlError> {
        let mut running = running_in(directory)?;
        if running.is_empty() {
            return Err(ControlError::NoneRunning(directory.to_owned()));
        }
        if let Some(wanted) = unit {
            let (meant, others): (Vec<_>, Vec<_>) = running.into_iter().partition(|unit| unit.is(wanted));
            if meant.is_empty() {
                return Err(ControlError::NotRunning { wanted: wanted.to_owned(), running: others });
            }
            running = meant;
        }
        match &running[..] {
            [only] => Self::connect(&only.path),
            _ => Err(ControlError::Several(running)),
        }
    }

    /// The unit at the other end.
    pub fn unit(&self) -> &RunningUnit {
        &self.unit
    }

    /// Asks. What has not been read of the answers to the question before is passed over, which for
    /// [`Question::Watch`] never ends: drop the client instead.
    pub fn ask(&mut self, question: &Question) -> Result<Answers<'_>, ControlError> {
        while self.open {
            match self.next_answer() {
                Ok(_) | Err(ControlError::Failed(_)) => {}
                Err(error) => return Err(error),
            }
        }
        let mut line = serde_json::to_vec(question).map_err(io::Error::from)?;
        line.push(b'\n');
        self.lines.source().write_all(&line)?;
        self.open = true;
        Ok(Answers { client: self })
    }

    fn next_answer(&mut self) -> Result<Option<Answer>, ControlError> {
        let answer = read(&mut self.lines);
        self.open = matches!(answer, Ok(ref answer) if !matches!(answer, Answer::Done | Answer::Failed(_)));
        match answer? {
            Answer::Done => Ok(None),
            Answer::Failed(failure) => Err(ControlError::Failed(failure)),
            answer => Ok(Some(answer)),
        }
    }
}

/// The unit's `NAME/ID` and fleet.
fn hello(lines: &mut Lines<UnixStream>) -> Result<(String, u32), ControlError> {
    match read(lines)? {
        Answer::Hello { control_version: CONTROL_VERSION, unit, fleet } => Ok((unit, fleet)),
        Answer::Hello { control_version: theirs, .. } => Err(ControlError::Version { theirs }),
        Answer::Failed(failure) => Err(ControlError::Failed(failure)),
        _ => Err(io::Error::new(io::ErrorKind::InvalidData, "it did not introduce itself").into()),
    }
}

fn read(lines: &mut Lines<UnixStream>) -> Result<Answer, ControlError> {
    match lines.next()? {
        Some(Line::Text(text)) => Ok(serde_json::from_slice(text).map_err(io::Error::from)?),
        Some(Line::TooLong) => Err(io::Error::new(io::ErrorKind::InvalidData, "an answer was too long").into()),
        None => Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
    }
}

/// The answers to one question, up to its end.
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
