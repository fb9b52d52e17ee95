//! The files of a recording: FILE is written, FILE.1 is the one before it, and so on.

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, BufWriter, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use mcap::records::MessageHeader;
use mcap::write::{Metadata, NoSeek};
use mcap::{McapError, McapResult, WriteOptions};

use super::layout::{self, Message};
use super::recorder::State;

/// Before the disk is tried again.
const RETRY: Duration = Duration::from_millis(100);
/// Channels of a file: what comes beyond is lost.
const MOST_CHANNELS: usize = 10_000;
/// Most bytes after which a chunk ends although its second has not passed.
pub(super) const CHUNK: u64 = 1 << 20;
/// A chunk is this part of a file's greatest size, as what waits in it comes on top; a file that has less is short.
const PART: u64 = 16;

/// Why a recording does not begin.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// What is there is no recording, or is being written.
    #[error("{} {why}: name another file", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        why: &'static str,
    },
    /// The system refuses something.
    #[error("{}: {error}", path.display())]
    Failed {
        /// The file.
        path: PathBuf,
        /// Its reason.
        error: io::Error,
    },
    /// The file is there, and its first bytes could not be written: a disk that is full from the start.
    #[error("{}: nothing can be written there ({error}): make room, or record to another disk", path.display())]
    TakesNothing {
        /// The file.
        path: PathBuf,
        /// What the disk says.
        error: io::Error,
    },
}

/// How much is kept.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Bytes after which the next file begins.
    pub size: u64,
    /// Files besides the one that is written, at least one.
    pub keep: usize,
}

/// The file that is written, and those before it.
pub(super) struct Files {
    path: PathBuf,
    limits: Limits,
    about: Metadata,
    state: Arc<State>,
    open: Option<Open<Patient>>,
}

/// A file with its channels.
pub(super) struct Open<W: Write> {
    mcap: mcap::Writer<NoSeek<BufWriter<W>>>,
    /// Each with its number and that of its last message, by topic and form.
    channels: HashMap<(String, String), (u16, u32)>,
}

impl Files {
    /// Puts a recording that is there aside. Anything else that is there is refused.
    pub(super) fn open(
        path: &Path,
        limits: Limits,
        about: BTreeMap<String, String>,
        state: Arc<State>,
    ) -> Result<Self, StartError> {
        let about = Metadata { name: "cara".to_owned(), metadata: about };
        let mut files = Self { path: path.to_owned(), limits, about, state, open: None };
        let failed = |error| StartError::Failed { path: path.to_owned(), error };
        // The longest name that it will have.
        if let Err(error) = fs::symlink_metadata(numbered(path, limits.keep.max(1)))
            && error.kind() == io::ErrorKind::InvalidFilename
        {
            let why = "has too long a name for the files that are kept, FILE.1 and so on";
            return Err(StartError::Refused { path: path.to_owned(), why });
        }
        if files.is_there()? {
            shift(path, limits).map_err(failed)?;
        }
        let file = create(path).map_err(failed)?;
        if let Err(error) = files.begin(file) {
            // Not left empty: the next try would put it aside as a recording.
            let _ = fs::remove_file(path);
            let error = if let McapError::Io(error) = error { error } else { io::Error::other(error) };
            return Err(StartError::TakesNothing { path: path.to_owned(), error });
        }
        files.state.has_begun();
        Ok(files)
    }

    fn is_there(&self) -> Result<bool, StartError> {
        let path = &self.path;
        let refused = |why| StartError::Refused { path: path.clone(), why };
        let failed = |error| StartError::Failed { path: path.clone(), error };
        let found = match fs::metadata(path) {
            Ok(found) => found,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
            Err(error) => return Err(failed(error)),
        };
        if !found.is_file() {
            return Err(refused("is no file"));
        }
        let mut file = File::open(path).map_err(failed)?;
        if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
            return Err(refused("is being recorded into by another process"));
        }
        let mut magic = [0; mcap::MAGIC.len()];
        if found.len() > 0 && (file.read_exact(&mut magic).is_err() || magic != mcap::MAGIC) {
            return Err(refused("is there, and is no recording"));
        }
        Ok(true)
    }

    fn begin(&mut self, file: File) -> McapResult<()> {
        self.state.begins();
        let to = Patient { file, state: self.state.clone() };
        self.open = Some(Open::begin(to, &self.about, chunk(self.limits.size))?);
        Ok(())
    }

    /// Writes a message that came at that time into the chunk.
    pub(super) fn write(&mut self, message: &Message, came: u64) -> McapResult<()> {
        if self.open.is_none() || self.state.bytes() >= self.limits.size {
            self.next()?;
        }
        let Some(open) = &mut self.open else { return Err(McapError::AttemptedWriteAfterFailure) };
        open.write(message, came)
    }

    /// Ends the chunk: what was written until now can be read whatever happens.
    pub(super) fn flush(&mut self) -> McapResult<()> {
        self.open.as_mut().map_or(Ok(()), |open| open.mcap.flush())
    }

    /// Writes what a reader needs to find its way, which makes the file a whole one.
    pub(super) fn finish(&mut self) -> McapResult<()> {
        self.open.take().map_or(Ok(()), |open| open.finish().map(drop))
    }

    fn next(&mut self) -> McapResult<()> {
        self.finish()?;
        if self.state.is_given_up() {
            return Err(McapError::AttemptedWriteAfterFailure);
        }
        loop {
            match shift(&self.path, self.limits).and_then(|()| create(&self.path)) {
                Ok(file) => return self.begin(file),
                Err(error) => self.state.is_held_up(error, RETRY)?,
            }
        }
    }
}

impl<W: Write> Open<W> {
    /// Chunks end after so many bytes.
    pub(super) fn begin(to: W, about: &Metadata, chunk: u64) -> McapResult<Self> {
        let options = WriteOptions::new().compression(None).chunk_size(Some(chunk)).disable_seeking(true);
        let mut mcap = options.profile("cara").library(super::LIBRARY).create(NoSeek::new(BufWriter::new(to)))?;
        mcap.write_metadata(about)?;
        mcap.flush()?;
        Ok(Self { mcap, channels: HashMap::new() })
    }

    /// Writes what a reader needs to find its way.
    pub(super) fn finish(mut self) -> McapResult<W> {
        self.mcap.finish()?;
        let written = self.mcap.into_inner().into_inner();
        written.into_inner().map_err(|error| error.into_error().into())
    }

    pub(super) fn write(&mut self, message: &Message, came: u64) -> McapResult<()> {
        let key = (message.topic.to_string(), message.form.clone());
        if !self.channels.contains_key(&key) {
            if self.channels.len() >= MOST_CHANNELS {
                return Err(McapError::TooManyChannels);
            }
            let (name, schema) = layout::schema(message);
            let schema = self.mcap.add_schema(&name, "jsonschema", schema.to_string().as_bytes())?;
            let channel = self.mcap.add_channel(schema, &message.topic, "json", &BTreeMap::new())?;
            self.channels.insert(key.clone(), (channel, 0));
        }
        let Some((channel_id, sequence)) = self.channels.get_mut(&key) else { return Ok(()) };
        *sequence = sequence.wrapping_add(1);
        let header = MessageHeader {
            channel_id: *channel_id,
            sequence: *sequence,
            log_time: came,
            publish_time: message.published,
        };
        self.mcap.write_to_known_channel(&header, message.body.to_string().as_bytes())
    }
}

/// Bytes of a chunk in files of so many.
fn chunk(size: u64) -> u64 {
    (size / PART).min(CHUNK)
}

/// A new file that only its owner can read, and that this process alone records into.
pub(super) fn create(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    // A file system without locks has none of another process either.
    let _ = file.try_lock();
    Ok(file)
}

/// FILE, or FILE.`number`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    match number {
        0 => path.to_owned(),
        number => path.with_added_extension(number.to_string()),
    }
}

/// FILE becomes FILE.1, which becomes FILE.2, up to FILE.`keep`. If all are there, the oldest short one is removed, so that a program
/// that crashes in a loop pushes out one long one at most; without a short one the oldest is.
fn shift(path: &Path, Limits { size, keep }: Limits) -> io::Result<()> {
    let numbered = |number| numbered(path, number);
    let keep = keep.max(1);
    let is_short = |number: &usize| {
        fs::metadata(numbered(*number)).is_ok_and(|found| found.is_file() && found.len() < chunk(size))
    };
    let missing = (0..=keep).find(|number| !numbered(*number).exists());
    // Not FILE itself: it may be what a program that has crashed for the first time had just begun.
    let free = missing.or_else(|| (1..=keep).rev().find(is_short)).unwrap_or(keep);
    (0..free).rev().try_for_each(|number| fs::rename(numbered(number), numbered(number + 1)))
}

/// A file on a disk that may be full: once the recording has begun, a write waits until it takes the bytes, or the recording is given
/// up.
struct Patient {
    file: File,
    state: Arc<State>,
}

impl Write for Patient {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        loop {
            match self.file.write(bytes) {
                Ok(count) => {
                    self.state.wrote(count);
                    return Ok(count);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => self.state.is_held_up(error, RETRY)?,
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
