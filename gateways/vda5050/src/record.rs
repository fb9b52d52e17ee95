//! The record on disk: written before anything that follows from it is said to the vehicle or to the master.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::state::Record;

/// What keeps a record.
pub trait Keep {
    /// Returns once the record would outlive a cut of power.
    fn keep(&mut self, record: &Record) -> io::Result<()>;
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
    fn keep(&mut self, record: &Record) -> io::Result<()> {
        let Some(kept) = &self.file else { return Ok(()) };
        let next = kept.with_extension("next");
        let mut file = OpenOptions::new().write(true).create(true).truncate(true).open(&next)?;
        file.write_all(&serde_json::to_vec(record)?)?;
        file.sync_all()?;
        std::fs::rename(&next, kept)?;
        // The rename is in the folder.
        let folder = kept.parent().unwrap_or(Path::new("."));
        File::open(folder)?.sync_all()
    }
}
