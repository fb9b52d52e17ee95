//! Whether a unit was stopped when it ended: a small file in its folder of state, so that it starts stopped again.
//!
//! A thread of its own writes it, behind a stop or a reset and never on their way: what hangs in the disk holds up neither.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::error::Error;
use cara_core::services::lease::Latch;

use crate::error::system_refused;
use crate::file_name::escape;
use crate::locks::lock;

/// The thread looks this often at least, and tries again what failed.
const LOOK: Duration = Duration::from_secs(1);

/// The file: there while something of the unit is latched, with who stopped it and why.
#[derive(Debug)]
struct LatchFile {
    path: PathBuf,
}

impl LatchFile {
    fn of(folder: &Path, identity: &Identity, fleet: Fleet) -> Self {
        let role = identity.role().as_str();
        Self { path: folder.join(format!("{}-{}-{role}-{}.stopped", escape(identity.name()), identity.id(), fleet.0)) }
    }

    /// What is kept. A file that cannot be read keeps a stop: the vehicle stands until it is reset.
    fn read(&self) -> Option<Latch> {
        let text = match fs::read_to_string(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
            text => text.unwrap_or_default(),
        };
        let mut words = text.split_whitespace();
        let by = words.next().and_then(|word| word.parse().ok()).unwrap_or(0);
        let reason = words.next().and_then(|word| word.parse().ok()).unwrap_or(0);
        Some(Latch { by, reason })
    }

    /// On the disk when this returns.
    fn keep(&self, latch: Option<Latch>) -> io::Result<()> {
        let folder = self.path.parent().unwrap_or(Path::new("."));
        match latch {
            Some(Latch { by, reason }) => {
                fs::create_dir_all(folder)?;
                let mut file = File::create(&self.path)?;
                writeln!(file, "{by} {reason}")?;
                file.sync_all()?;
            }
            None => match fs::remove_file(&self.path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            },
        }
        File::open(folder)?.sync_all()
    }
}

/// Keeps a unit's latch in its file.
#[derive(Debug)]
pub(crate) struct Keeper {
    file: Option<LatchFile>,
    news: Arc<News>,
    /// Times that the file could not be written.
    failed: Arc<AtomicU64>,
}

/// Wakes the thread that writes.
#[derive(Debug, Default)]
struct News {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum State {
    /// The thread has not been started.
    #[default]
    Unused,
    Resting,
    Changed,
    Over,
}

impl Keeper {
    pub(crate) fn new(folder: Option<&Path>, identity: &Identity, fleet: Fleet) -> Self {
        let file = folder.map(|folder| LatchFile::of(folder, identity, fleet));
        Self { file, news: Arc::default(), failed: Arc::default() }
    }

    /// What was latched when the unit ended.
    pub(crate) fn kept(&self) -> Option<Latch> {
        self.file.as_ref().and_then(LatchFile::read)
    }

    /// Starts the thread, once, which asks `latch` what is latched now: `None` when the unit is gone.
    pub(crate) fn start(&self, latch: impl Fn() -> Option<Option<Latch>> + Send + 'static) -> Result<(), Error> {
        let Some(LatchFile { path }) = &self.file else { return Ok(()) };
        let mut state = lock(&self.news.state);
        if *state != State::Unused {
            return Ok(());
        }
        let (file, news, failed) = (LatchFile { path: path.clone() }, self.news.clone(), self.failed.clone());
        let thread = std::thread::Builder::new().name("cara-latch".into());
        thread.spawn(move || work(&file, &news, &failed, latch)).map_err(system_refused)?;
        *state = State::Resting;
        Ok(())
    }

    /// Something may have been stopped or reset.
    pub(crate) fn notify(&self) {
        let mut state = lock(&self.news.state);
        if *state == State::Resting {
            *state = State::Changed;
            self.news.changed.notify_one();
        }
    }

    /// Times that it could not be kept.
    pub(crate) fn failed(&self) -> u64 {
        self.failed.load(Ordering::Relaxed)
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        *lock(&self.news.state) = State::Over;
        self.news.changed.notify_one();
    }
}

fn work(file: &LatchFile, news: &News, failed: &AtomicU64, latch: impl Fn() -> Option<Option<Latch>>) {
    // Written once at the beginning: the file may say what it cannot be read as.
    let mut kept = None;
    while let Some(latch) = latch() {
        if kept != Some(latch) {
            match file.keep(latch) {
                Ok(()) => kept = Some(latch),
                Err(error) => {
                    if failed.fetch_add(1, Ordering::Relaxed) == 0 {
                        let path = file.path.display();
                        tracing::error!(%path, %error, "whether this unit is stopped cannot be kept beyond its end");
                    }
                }
            }
        }
        let mut state = lock(&news.state);
        if *state == State::Resting {
            state = news.changed.wait_timeout(state, LOOK).unwrap_or_else(PoisonError::into_inner).0;
        }
        match *state {
            State::Over => return,
            _ => *state = State::Resting,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_latch_is_kept_and_what_cannot_be_read_is_a_stop() {
        let folder = tempfile::tempdir().unwrap();
        let file = LatchFile::of(&folder.path().join("state"), &Identity::s_unit("agv/1", 7).unwrap(), Fleet(3));
        assert_eq!(file.read(), None);
        let latch = Latch { by: 12, reason: 9 };
        file.keep(Some(latch)).unwrap();
        assert_eq!(file.read(), Some(latch));
        for text in ["", "x", "7 x", "99999999999 99999"] {
            fs::write(&file.path, text).unwrap();
            assert!(file.read().is_some(), "{text}");
        }
        file.keep(None).unwrap();
        file.keep(None).unwrap();
        assert_eq!(file.read(), None);
    }
}
