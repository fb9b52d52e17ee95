//! The record on disk: written before anything that follows from it is said to the vehicle or to the master.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};

use crate::state::Record;
use crate::vehicle::BEAT;

/// What keeps a record. It is written while the vehicle's loop goes on: a disk must hold up neither a renewal nor a stop.
pub trait Keep {
    /// Starts to write. The write before has ended.
    fn start(&mut self, record: &Record) -> io::Result<()>;
    /// How the write ended, once it would outlive a cut of power: waits up to 20 ms, and `None` if it goes on.
    fn ended(&mut self) -> Option<io::Result<()>>;
}

/// A file, which is replaced as a whole.
#[derive(Debug)]
pub struct Store {
    /// Without one nothing is kept.
    file: Option<PathBuf>,
    /// From the first write on.
    writer: Option<Writer>,
    /// Where gateways share it.
    lock: Option<RecordLock>,
}

/// A thread that writes one text at a time.
#[derive(Debug)]
struct Writer {
    texts: SyncSender<Vec<u8>>,
    results: Receiver<io::Result<()>>,
}

impl Store {
    /// The record of a vehicle in a folder, and an empty one if there is none. A damaged file is an error: it is not overwritten.
    pub fn open(folder: &Path, serial_number: &str) -> io::Result<(Self, Record)> {
        std::fs::create_dir_all(folder)?;
        let file = folder.join(format!("{serial_number}.json"));
        let record = match std::fs::read(&file) {
            Ok(text) => serde_json::from_slice(&text).map_err(|error| {
                io::Error::new(io::ErrorKind::InvalidData, format!("{} is damaged: {error}", file.display()))
            })?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => Record::default(),
            Err(error) => return Err(error),
        };
        Ok((Self { file: Some(file), writer: None, lock: None }, record))
    }

    /// For a vehicle that is out of service, and has no record.
    pub const fn nowhere() -> Self {
        Self { file: None, writer: None, lock: None }
    }

    /// Holds this as long as anything may be written.
    pub fn locked(self, lock: Option<RecordLock>) -> Self {
        Self { lock, ..self }
    }
}

/// The right to speak for a vehicle whose record several gateways share. The system takes it back from a process that ends, once no
/// thread of that one can write any more.
#[derive(Clone, Debug)]
pub struct RecordLock(#[expect(dead_code, reason = "the lock ends with its file")] Arc<File>);

impl RecordLock {
    /// `None` while another gateway has it.
    pub fn take(folder: &Path, serial_number: &str) -> io::Result<Option<Self>> {
        std::fs::create_dir_all(folder)?;
        // The record itself is replaced at each write, so that a lock on it would not last.
        let file = folder.join(format!("{serial_number}.lock"));
        let file = OpenOptions::new().write(true).create(true).truncate(false).open(file)?;
        match file.try_lock() {
            Ok(()) => Ok(Some(Self(Arc::new(file)))),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }
}

impl Keep for Store {
    fn start(&mut self, record: &Record) -> io::Result<()> {
        let Some(file) = &self.file else { return Ok(()) };
        let text = serde_json::to_vec(record)?;
        let writer = match &mut self.writer {
            Some(writer) => writer,
            none => none.insert(Writer::start(file.clone(), self.lock.clone())?),
        };
        writer.texts.send(text).map_err(|_| io::Error::other("the record's thread has ended"))
    }

    fn ended(&mut self) -> Option<io::Result<()>> {
        let Some(writer) = &self.writer else { return Some(Ok(())) };
        match writer.results.recv_timeout(BEAT) {
            Ok(result) => Some(result),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                self.writer = None;
                Some(Err(io::Error::other("the write panicked")))
            }
        }
    }
}

impl Writer {
    fn start(file: PathBuf, lock: Option<RecordLock>) -> io::Result<Self> {
        let (texts, to_write) = sync_channel::<Vec<u8>>(1);
        let (done, results) = sync_channel(1);
        let run = move || {
            // A write that hangs ends some time.
            let _lock = lock;
            let mut written = to_write.iter().map(|text| replace(&file, &text));
            while written.next().is_some_and(|result| done.send(result).is_ok()) {}
        };
        std::thread::Builder::new().name("record".into()).spawn(run)?;
        Ok(Self { texts, results })
    }
}

fn replace(kept: &Path, text: &[u8]) -> io::Result<()> {
    let next = kept.with_extension("next");
    let mut file = OpenOptions::new().write(true).create(true).truncate(true).open(&next)?;
    file.write_all(text)?;
    file.sync_all()?;
    std::fs::rename(&next, kept)?;
    // The rename is in the folder.
    let folder = kept.parent().unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}
