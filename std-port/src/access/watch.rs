//! Looks whether a table's file has changed.

use std::path::PathBuf;

use super::{AccessError, AccessTable};
use crate::keys::Mark;

/// A file, and the state in which it was read last.
#[derive(Debug)]
pub(crate) struct FileWatch {
    path: PathBuf,
    /// `None`: it was not there.
    read: Option<Mark>,
    /// As it was at the last look.
    seen: Option<Mark>,
    /// The state in which it could not be read and the error was reported.
    refused: Option<Option<Mark>>,
}

impl FileWatch {
    /// Reads the file, and remembers in which state it was.
    pub(crate) fn open(path: PathBuf) -> Result<(Self, AccessTable), AccessError> {
        // Before it is read: what is written meanwhile is a change.
        let mark = Mark::of(&path).ok();
        let table = AccessTable::read(&path)?;
        Ok((Self { path, read: mark, seen: mark, refused: None }, table))
    }

    /// The file's contents if they have changed, and are unchanged since the last look, so that a writer in place has
    /// time to finish. An error is reported once and reading is tried again at each look, since the cause may be
    /// outside the file.
    pub(crate) fn look(&mut self) -> Option<Result<AccessTable, AccessError>> {
        let now = Mark::of(&self.path).ok();
        let settled = now == self.seen;
        self.seen = now;
        if now == self.read || !settled {
            return None;
        }
        let table = AccessTable::read(&self.path);
        match &table {
            Ok(_) => (self.read, self.refused) = (now, None),
            Err(_) if self.refused == Some(now) => return None,
            Err(_) => self.refused = Some(now),
        }
        Some(table)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const NOBODY: &str = "allow = []\n";
    const ANYBODY: &str = "[[allow]]\nwho = \"*\"\nfunctions = \"*\"\nverbs = \"call\"\n";

    #[test]
    fn a_change_is_seen_once_it_has_come_to_rest() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("access.toml");
        fs::write(&path, NOBODY).unwrap();
        let (mut watch, table) = FileWatch::open(path.clone()).unwrap();
        assert!(table.rules().is_empty() && watch.look().is_none());
        fs::write(&path, ANYBODY).unwrap();
        assert!(watch.look().is_none(), "it may still be written");
        assert_eq!(watch.look().unwrap().unwrap().rules().len(), 1);
        assert!(watch.look().is_none(), "once");
        let other = directory.path().join("new");
        fs::write(&other, NOBODY).unwrap();
        fs::rename(&other, &path).unwrap();
        assert!(watch.look().is_none());
        assert!(watch.look().unwrap().unwrap().rules().is_empty());
        fs::remove_file(&path).unwrap();
        assert!(watch.look().is_none());
        assert!(watch.look().unwrap().is_err() && watch.look().is_none());
    }
}
