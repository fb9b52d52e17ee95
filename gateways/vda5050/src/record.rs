//! The record on disk: written before anything that follows from it is said to the vehicle or to the master.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};

use crate::state::Record;
use crate::vehicle::BEAT;

/// What keeps a record.
pub trait Keep {
    /// Returns once the record would outlive a cut of power. Calls `beat` while it waits: a disk must not hold up a renewal.
    fn keep(&mut self, record: &Record, beat: &mut dyn FnMut()) -> io::Result<()>;
}

/// A file, which is replaced as a whole.
#[derive(Debug)]
pub struct Store {
    /// Without one nothing is kept.
    file: Option<PathBuf>,
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
        Ok((Self { file: Some(file) }, record))
    }

    /// For a vehicle that is out of service, and has no record.
    pub const fn nowhere() -> Self {
        Self { file: None }
    }
}

impl Keep for Store {
    fn keep(&mut self, record: &Record, beat: &mut dyn FnMut()) -> io::Result<()> {
        let Some(kept) = &self.file else { return Ok(()) };
        let text = serde_json::to_vec(record)?;
        apart(|| replace(kept, &text), beat)
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

/// Writes on a thread of its own, and beats until that is done.
fn apart(write: impl FnOnce() -> io::Result<()> + Send, beat: &mut dyn FnMut()) -> io::Result<()> {
    let (done, result) = sync_channel(1);
    std::thread::scope(|scope| {
        std::thread::Builder::new().name("record".into()).spawn_scoped(scope, move || done.send(write()))?;
        loop {
            match result.recv_timeout(BEAT) {
                Ok(result) => return result,
                Err(RecvTimeoutError::Timeout) => beat(),
                Err(RecvTimeoutError::Disconnected) => return Err(io::Error::other("the write panicked")),
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::time::Duration;

    use super::{apart, io};

    /// The write ends once the loop has beaten five times.
    #[test]
    fn the_loop_beats_while_the_disk_is_slow() {
        let (beat, beats) = channel();
        let write = move || {
            let heard = (0..5).try_for_each(|_| beats.recv_timeout(Duration::from_secs(10)));
            heard.map_err(io::Error::other)
        };
        apart(write, &mut || beat.send(()).unwrap_or_default()).unwrap();
        let failed = apart(|| Err(io::ErrorKind::StorageFull.into()), &mut || ()).unwrap_err();
        assert_eq!(failed.kind(), io::ErrorKind::StorageFull);
    }
}
