//! A ring that a running node holds, and that follows its file.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use cara_core::distribution::identity::{Fleet, Identity};

use super::file::Mark;
use super::{KeyError, KeyRing, location};

/// The ring of a running node. When its file is another one than before, [`refresh`](Self::refresh) takes that: a vehicle
/// that is added or revoked, or a new generation, restarts nothing.
#[derive(Debug)]
pub struct LiveRing {
    /// None where the ring was made in this process.
    path: Option<PathBuf>,
    held: Mutex<Held>,
    /// Held by the thread that looks at the file: the ring itself is there meanwhile.
    looking: Mutex<()>,
}

#[derive(Debug)]
struct Held {
    ring: Arc<KeyRing>,
    /// The file that it was read from. None where there is none.
    mark: Option<Mark>,
    /// The state in which the file was refused and the error was reported; an inner `None` if the file was missing.
    refused: Option<Option<Mark>>,
}

impl LiveRing {
    /// The ring of a node, from where [`location`] says; of an s_unit with the manager that it joins.
    pub fn find(identity: &Identity, manager: Option<&Identity>, fleet: Fleet) -> Result<Self, KeyError> {
        let path = match manager {
            None => location::find(identity, fleet)?,
            Some(manager) => location::find_joining(identity, manager, fleet)?,
        };
        Self::open(&path, identity, fleet)
    }

    /// The ring of a node, from this file.
    pub fn open(path: &Path, identity: &Identity, fleet: Fleet) -> Result<Self, KeyError> {
        let (ring, mark) = KeyRing::load_marked(path)?;
        let ring = ring.belonging_to(path, identity, fleet)?;
        let held = Mutex::new(Held { ring: Arc::new(ring), mark: Some(mark), refused: None });
        Ok(Self { path: Some(path.to_owned()), held, looking: Mutex::new(()) })
    }

    /// A ring that was made in this process, and that follows no file.
    pub fn fixed(ring: KeyRing) -> Self {
        let held = Mutex::new(Held { ring: Arc::new(ring), mark: None, refused: None });
        Self { path: None, held, looking: Mutex::new(()) }
    }

    /// Its file.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// The ring as it is now.
    pub fn ring(&self) -> Arc<KeyRing> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner).ring.clone()
    }

    fn mark(&self) -> Option<Mark> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner).mark
    }

    /// Looks at the file, which costs one system call, and reads it if it has changed. Whether there is another ring now.
    /// A file that is refused, or gone, leaves the ring as it was; it is an error once. It is tried again at each look:
    /// what was in the way may have been a full table of files, and a revocation must not be lost by that.
    pub fn refresh(&self) -> Result<bool, KeyError> {
        self.refresh_by(read)
    }

    fn refresh_by(
        &self,
        read: impl FnOnce(&Path, &KeyRing) -> Result<(KeyRing, Mark), KeyError>,
    ) -> Result<bool, KeyError> {
        let Some(path) = &self.path else { return Ok(false) };
        let _looking = self.looking.lock().unwrap_or_else(PoisonError::into_inner);
        let mark = Mark::of(path).ok();
        let ring = self.ring();
        // A thread that needs the ring does not wait for the file.
        let found = (mark != self.mark()).then(|| read(path, &ring));
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(found) = found else {
            held.refused = None;
            return Ok(false);
        };
        match found {
            Ok((ring, mark)) => {
                *held = Held { ring: Arc::new(ring), mark: Some(mark), refused: None };
                Ok(true)
            }
            Err(_) if held.refused == Some(mark) => Ok(false),
            Err(error) => {
                held.refused = Some(mark);
                Err(error)
            }
        }
    }
}

/// The ring of the same node that is in its file now.
fn read(path: &Path, held: &KeyRing) -> Result<(KeyRing, Mark), KeyError> {
    let (ring, mark) = KeyRing::load_marked(path)?;
    Ok((ring.belonging_to(path, held.identity(), held.fleet())?, mark))
}

#[cfg(test)]
mod tests {
    use super::super::{FleetKeys, Store};
    use super::*;
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    fn depot() -> Identity {
        Identity::m_unit("depot", 1).unwrap()
    }

    #[test]
    fn a_vehicle_that_is_added_is_known_without_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let agv = |id| Identity::s_unit("agv", id).unwrap();
        let mut store = Store::create(folder.path(), FleetKeys::draw(Fleet(7)).unwrap()).unwrap();
        store.keys_mut().add(&depot(), &[]).unwrap();
        store.save().unwrap();
        let path = folder.path().join(location::file_name(&depot(), Fleet(7)));
        let live = LiveRing::open(&path, &depot(), Fleet(7)).unwrap();
        assert!(!live.refresh().unwrap() && live.ring().pair(&agv(1)).is_none());
        let before = live.ring();

        store.keys_mut().add(&agv(1), &[]).unwrap();
        store.save().unwrap();
        assert!(live.refresh().unwrap() && live.ring().pair(&agv(1)).is_some());
        assert!(before.pair(&agv(1)).is_none(), "who holds the old one keeps it");

        for wrong in ["", "cara-ring 1\n"] {
            let kept = fs::read(&path).unwrap();
            fs::write(&path, wrong).unwrap();
            assert!(live.refresh().is_err() && live.ring().pair(&agv(1)).is_some(), "{wrong:?}");
            assert!(!live.refresh().unwrap(), "a mistake is told once");
            fs::write(&path, kept).unwrap();
            assert!(live.refresh().unwrap());
        }
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(live.refresh(), Err(KeyError::Open { .. })));
        fs::remove_file(&path).unwrap();
        assert!(live.refresh().is_err() && !live.refresh().unwrap());
        fs::rename(folder.path().join(location::file_name(&agv(1), Fleet(7))), &path).unwrap();
        assert!(matches!(live.refresh(), Err(KeyError::OtherNode { .. })));
        assert!(live.ring().pair(&agv(1)).is_some());
    }

    #[test]
    fn what_could_not_be_read_for_another_reason_is_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        let agv = Identity::s_unit("agv", 1).unwrap();
        let mut store = Store::create(folder.path(), FleetKeys::draw(Fleet(7)).unwrap()).unwrap();
        [depot(), agv.clone()].iter().for_each(|node| store.keys_mut().add(node, &[]).unwrap());
        store.save().unwrap();
        let live = LiveRing::open(&store.file_of(&depot()), &depot(), Fleet(7)).unwrap();
        store.keys_mut().revoke(std::slice::from_ref(&agv)).unwrap();
        store.save().unwrap();
        let full = |path: &Path, _: &KeyRing| {
            let (path, error) = (path.to_owned(), std::io::Error::other("too many open files"));
            Err(KeyError::System { path, error })
        };
        assert!(live.refresh_by(full).is_err() && !live.refresh_by(full).unwrap(), "told once");
        assert!(live.ring().pair(&agv).is_some());
        assert!(live.refresh().unwrap() && live.ring().pair(&agv).is_none(), "the file is the same as before");
    }

    #[test]
    fn a_ring_without_a_file_stays() {
        let mut keys = FleetKeys::draw(Fleet(7)).unwrap();
        keys.add(&depot(), &[]).unwrap();
        let live = LiveRing::fixed(keys.ring(&depot()).unwrap());
        assert!(!live.refresh().unwrap() && live.path().is_none());
    }
}
