//! The folder in which a fleet's keys are made: `fleet-7.root`, the list of nodes `fleet-7.nodes`, and beside them the file
//! of each node, to be brought to where it runs.

use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use cara_core::distribution::identity::{Fleet, Identity};
use cara_secure::keys::RootKey;
use rustix::fs::{FlockOperation, flock};
use zeroize::Zeroizing;

use super::file::Staged;
use super::members::Members;
use super::text::{Checksum, FORM, FormError, Lines, checksum, push_key, push_sum};
use super::{FleetKeys, KeyError, KeyRing, file, location};

/// Bytes of the root's file at most.
const ROOT_BYTES: usize = 512;

/// A fleet's keys in a folder, locked against changes by others while this exists.
#[derive(Debug)]
pub struct Store {
    folder: PathBuf,
    keys: FleetKeys,
    /// The folder, with a lock.
    _lock: File,
}

/// A node's file that was written or removed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Whose.
    pub identity: Identity,
    /// Where.
    pub path: PathBuf,
    /// What was done.
    pub change: Change,
}

/// What was done with a node's file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// There was none before.
    New,
    /// It replaced another one.
    Replaced,
    /// The node has no keys any more.
    Removed,
}

/// A node's file that is to be written or removed.
struct Planned {
    to_be: Written,
    /// Nothing where it is to be removed.
    text: Option<Zeroizing<String>>,
}

/// The same, on the disk beside its place.
struct Ready {
    to_be: Written,
    staged: Option<Staged>,
}

pub(super) fn root_file(folder: &Path, fleet: Fleet) -> PathBuf {
    folder.join(format!("fleet-{}.root", fleet.0))
}

fn nodes_file(folder: &Path, fleet: Fleet) -> PathBuf {
    folder.join(format!("fleet-{}.nodes", fleet.0))
}

/// Whether the list of a fleet's nodes in a folder says that one was revoked. A list that cannot be read says nothing.
pub(super) fn is_revoked(folder: &Path, identity: &Identity, fleet: Fleet) -> bool {
    listed(folder, fleet).is_some_and(|members| members.is_revoked(identity))
}

/// The list of a fleet's nodes in a folder, if it is there and can be read.
fn listed(folder: &Path, fleet: Fleet) -> Option<Members> {
    let (text, _) = file::read(&nodes_file(folder, fleet)).ok()?;
    Members::parse(&text).ok().filter(|members| members.fleet() == fleet)
}

impl Store {
    /// Keeps new keys, and the file of each node, in a folder, which is made for this user alone if it is not there.
    pub fn create(folder: &Path, keys: FleetKeys) -> Result<Self, KeyError> {
        Self::create_unless(folder, keys, &|| false).map(|(store, _)| store)
    }

    /// As [`create`](Self::create), with the files of nodes that were written: all of it, or nothing where a file cannot be
    /// written or `stop` says so before the first one is in its place ([`KeyError::Stopped`]).
    pub fn create_unless(
        folder: &Path,
        keys: FleetKeys,
        stop: &dyn Fn() -> bool,
    ) -> Result<(Self, Vec<Written>), KeyError> {
        file::make_folder(folder)?;
        let lock = lock(folder)?;
        let fleet = keys.members().fleet();
        let path = root_file(folder, fleet);
        if path.exists() {
            return Err(KeyError::Exists { path, fleet });
        }
        let store = Self { folder: folder.to_owned(), keys, _lock: lock };
        let (ready, list) = store.ready(stop)?;
        let root = Staged::write(&path, root_text(fleet, store.keys.root()).as_bytes())?;
        if stop() {
            return Err(KeyError::Stopped);
        }
        // The root is written before the keys derived from it: a process killed in between leaves no keys of a lost
        // root, and `cara keys derive` writes the rest. A list alone is no fleet, and does not block the next try.
        let mut made = vec![list.path().to_owned()];
        let written = list.put().and_then(|()| root.put_new()).and_then(|()| {
            made.push(path);
            put_all(ready, &mut made)
        });
        let written = written.inspect_err(|_| made.iter().for_each(|path| drop(file::remove(path))))?;
        file::keep_names(folder)?;
        Ok((store, written))
    }

    /// The keys of a fleet in a folder.
    pub fn open(folder: &Path, fleet: Fleet) -> Result<Self, KeyError> {
        let path = root_file(folder, fleet);
        if !path.exists() {
            let list = listed(folder, fleet).map(|members| members.nodes().to_vec()).unwrap_or_default();
            let nodes = list.into_iter().map(|node| node.identity).collect();
            return Err(KeyError::NoRoot { folder: folder.to_owned(), fleet, nodes });
        }
        let lock = lock(folder)?;
        Ok(Self { folder: folder.to_owned(), keys: Self::peek(folder, fleet)?, _lock: lock })
    }

    /// The keys of a fleet in a folder, as they are while others may change them: to look at.
    pub fn peek(folder: &Path, fleet: Fleet) -> Result<FleetKeys, KeyError> {
        let path = root_file(folder, fleet);
        let (text, _) = file::read(&path)?;
        file::advise(&path, &text);
        let root = parse_root(&text, fleet).map_err(|error| file::form(&path, error))?;
        let path = nodes_file(folder, fleet);
        let (text, _) = file::read(&path).map_err(|error| without_nodes(error, fleet))?;
        file::advise(&path, &text);
        let members = Members::parse(&text).and_then(|members| is_of(members, fleet));
        let members = members.map_err(|error| file::form(&path, error))?;
        Ok(FleetKeys::new(root, members))
    }

    /// The fleets whose roots are in a folder; none if the folder is not there.
    pub fn fleets(folder: &Path) -> Vec<Fleet> {
        let names = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name());
        let number = |name: &str| name.strip_prefix("fleet-")?.strip_suffix(".root")?.parse().ok();
        let mut fleets: Vec<_> = names.filter_map(|name| number(name.to_str()?).map(Fleet)).collect();
        fleets.sort();
        fleets
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The root's file.
    pub fn root_file(&self) -> PathBuf {
        root_file(&self.folder, self.keys.members().fleet())
    }

    /// The file of a node.
    pub fn file_of(&self, identity: &Identity) -> PathBuf {
        self.folder.join(location::file_name(identity, self.keys.members().fleet()))
    }

    /// The keys.
    pub fn keys(&self) -> &FleetKeys {
        &self.keys
    }

    /// The keys, to be changed; [`save`](Self::save) keeps what was.
    pub fn keys_mut(&mut self) -> &mut FleetKeys {
        &mut self.keys
    }

    /// Writes the list of nodes and every node's file that is not as it should be; those are told. Where one of them is
    /// refused, or cannot be written, nothing is changed. Where the host goes down between the first file that is put in
    /// its place and the last, the next call completes it.
    pub fn save(&self) -> Result<Vec<Written>, KeyError> {
        self.save_unless(&|| false)
    }

    /// As [`save`](Self::save); nothing is changed where `stop` says so before the first file is in its place
    /// ([`KeyError::Stopped`]).
    pub fn save_unless(&self, stop: &dyn Fn() -> bool) -> Result<Vec<Written>, KeyError> {
        let fleet = self.keys.members().fleet();
        let ((ready, list), root) = (self.ready(stop)?, self.root_with_checksum()?);
        if stop() {
            return Err(KeyError::Stopped);
        }
        root.map_or(Ok(()), Staged::put)?;
        list.put()?;
        let written = put_all(ready, &mut Vec::new()).and_then(|written| {
            file::keep_names(&self.folder)?;
            Ok(written)
        });
        written.map_err(|error| KeyError::HalfWay { fleet, error: Box::new(error) })
    }

    /// All that is to be put in its place, on the disk: of nodes, and their list.
    fn ready(&self, stop: &dyn Fn() -> bool) -> Result<(Vec<Ready>, Staged), KeyError> {
        let (members, planned) = (self.keys.members(), self.planned()?);
        file::remove_staged(&self.folder)?;
        let mut ready = Vec::with_capacity(planned.len());
        for Planned { to_be, text } in planned {
            if stop() {
                return Err(KeyError::Stopped);
            }
            let staged = text.map(|text| Staged::write(&to_be.path, text.as_bytes())).transpose()?;
            ready.push(Ready { to_be, staged });
        }
        let list = Staged::write(&nodes_file(&self.folder, members.fleet()), members.text().as_bytes())?;
        Ok((ready, list))
    }

    /// The root's file as it is written today, where the one that is there has no checksum.
    fn root_with_checksum(&self) -> Result<Option<Staged>, KeyError> {
        let path = self.root_file();
        let (text, _) = file::read(&path)?;
        if checksum(&text) != Checksum::Absent {
            return Ok(None);
        }
        Staged::write(&path, root_text(self.keys.members().fleet(), self.keys.root()).as_bytes()).map(Some)
    }

    /// Whether a node's file is of other generations than the list of nodes: a change of keys was interrupted, and
    /// [`save`](Self::save) completes it. A step on top of it would be two for some nodes, which locks them out.
    pub fn is_behind(&self) -> Result<bool, KeyError> {
        for node in self.keys.members().nodes() {
            let text = own_text(&self.file_of(&node.identity))?;
            let ring = text.and_then(|text| KeyRing::parse(&text).ok());
            if ring.is_some_and(|ring| !ring.generations().eq(self.keys.members().generations())) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// What is to be done for every node's file to be as it should be, after a look at all of them.
    fn planned(&self) -> Result<Vec<Planned>, KeyError> {
        let members = self.keys.members();
        let removals = members.revoked().iter().map(|revoked| self.planned_removal(&revoked.identity));
        let rings = members.nodes().iter().map(|node| self.planned_ring(&node.identity));
        removals.chain(rings).filter_map(Result::transpose).collect()
    }

    fn planned_removal(&self, identity: &Identity) -> Result<Option<Planned>, KeyError> {
        let to_be = self.to_be(identity, Change::Removed);
        // Its permissions no longer matter.
        Ok(file::is_there(&to_be.path)?.then_some(Planned { to_be, text: None }))
    }

    fn planned_ring(&self, identity: &Identity) -> Result<Option<Planned>, KeyError> {
        // Every member has a ring.
        let Ok(ring) = self.keys.ring(identity) else { return Ok(None) };
        let text = ring.text();
        // One that others can read is told, and not silently mended.
        let change = match own_text(&self.file_of(identity))? {
            Some(found) if *found == *text => return Ok(None),
            Some(_) => Change::Replaced,
            None => Change::New,
        };
        Ok(Some(Planned { to_be: self.to_be(identity, change), text: Some(text) }))
    }

    fn to_be(&self, identity: &Identity, change: Change) -> Written {
        Written { identity: identity.clone(), path: self.file_of(identity), change }
    }
}

/// Puts files in their places; `made` gets those of places that were empty.
fn put_all(ready: Vec<Ready>, made: &mut Vec<PathBuf>) -> Result<Vec<Written>, KeyError> {
    let put = |Ready { to_be, staged }| {
        match staged {
            Some(staged) => staged.put()?,
            None => drop(file::remove(&to_be.path)?),
        }
        if to_be.change == Change::New {
            made.push(to_be.path.clone());
        }
        Ok(to_be)
    };
    ready.into_iter().map(put).collect()
}

/// The text of a node's file, if there is one; an empty one where it is damaged, and only to be written again.
fn own_text(path: &Path) -> Result<Option<Zeroizing<String>>, KeyError> {
    match file::read(path) {
        Ok((text, _)) => Ok(Some(text)),
        Err(KeyError::Form { .. } | KeyError::Damaged(_)) => Ok(Some(Zeroizing::default())),
        Err(KeyError::System { error, .. }) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

fn without_nodes(error: KeyError, fleet: Fleet) -> KeyError {
    match error {
        KeyError::System { path, error } if error.kind() == ErrorKind::NotFound => KeyError::NoNodes { path, fleet },
        other => other,
    }
}

fn lock(folder: &Path) -> Result<File, KeyError> {
    let opened = File::open(folder).map_err(|error| file::system(folder, error))?;
    match flock(&opened, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(opened),
        Err(rustix::io::Errno::WOULDBLOCK) => Err(KeyError::InUse(folder.to_owned())),
        Err(errno) => Err(file::system(folder, errno)),
    }
}

fn root_text(fleet: Fleet, root: &RootKey) -> Zeroizing<String> {
    let fleet = fleet.0;
    let mut text = Zeroizing::new(String::with_capacity(ROOT_BYTES));
    text.push_str(&format!(
        "# The root of all keys of fleet {fleet}. A holder of this file can speak as every node. It stays here; keep a copy.\n\
         cara-root {FORM}\nfleet {fleet}\nroot "
    ));
    push_key(&mut text, root.expose());
    text.push('\n');
    push_sum(&mut text);
    debug_assert!(text.len() <= ROOT_BYTES, "a text that grows leaves keys behind");
    text
}

fn parse_root(text: &str, fleet: Fleet) -> Result<RootKey, FormError> {
    let mut lines = Lines::of(text);
    lines.head("cara-root", "here `cara-root 2` is expected: this is no fleet's root")?;
    let line = lines.expect("fleet", "here `fleet` is expected")?;
    if line.number()? != fleet.0 {
        return Err(line.wrong("this is the root of another fleet than its file's name says"));
    }
    let (key, _) = lines.expect("root", "here `root` is expected")?.key()?;
    match lines.next() {
        Some(line) => Err(line.wrong("here the file should end")),
        None => Ok(RootKey::new(*key)),
    }
}

fn is_of(members: Members, fleet: Fleet) -> Result<Members, FormError> {
    let what = "these are the nodes of another fleet than the file's name says";
    if members.fleet() == fleet { Ok(members) } else { Err(FormError { line: 1, what }) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    fn depot() -> Identity {
        Identity::m_unit("depot", 1).unwrap()
    }

    fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    /// A folder with a fleet that has a manager and two AGVs.
    fn store() -> (tempfile::TempDir, Store) {
        let folder = tempfile::tempdir().unwrap();
        let mut store = Store::create(&folder.path().join("keys"), FleetKeys::draw(Fleet(7)).unwrap()).unwrap();
        [depot(), agv(1), agv(2)].iter().for_each(|node| store.keys_mut().add(node, &[]).unwrap());
        store.save().unwrap();
        (folder, store)
    }

    fn changes(written: &[Written]) -> Vec<(String, Change)> {
        written.iter().map(|written| (written.identity.to_string(), written.change)).collect()
    }

    #[test]
    fn what_is_kept_is_opened() {
        let (_folder, store) = store();
        let (path, fingerprint) = (store.folder().to_owned(), store.keys().fingerprint());
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o700);
        assert!(matches!(Store::open(&path, Fleet(7)), Err(KeyError::InUse(_))));
        drop(store);
        let store = Store::open(&path, Fleet(7)).unwrap();
        assert_eq!((store.keys().fingerprint(), store.save().unwrap()), (fingerprint, vec![]));
        assert_eq!(Store::fleets(&path), [Fleet(7)]);
        let ring = KeyRing::load_of(&store.file_of(&agv(1)), &agv(1), Fleet(7)).unwrap();
        assert_eq!(
            ring.pair(&depot()).unwrap().expose(),
            store.keys().ring(&depot()).unwrap().pair(&agv(1)).unwrap().expose()
        );
        drop(store);
        assert!(matches!(Store::create(&path, FleetKeys::draw(Fleet(7)).unwrap()), Err(KeyError::Exists { .. })));
        let text = Store::open(&path, Fleet(8)).unwrap_err().to_string();
        assert!(text.ends_with("`cara keys new-fleet --fleet 8`"), "{text}");
        assert_eq!(Store::fleets(Path::new("/absent")), []);
    }

    #[test]
    fn only_what_changes_is_written() {
        let (_folder, mut store) = store();
        store.keys_mut().add(&agv(3), &[]).unwrap();
        let expected = [("depot/1".into(), Change::Replaced), ("agv/3".into(), Change::New)];
        assert_eq!(changes(&store.save().unwrap()), expected);
        store.keys_mut().revoke(&[agv(1)]).unwrap();
        let written = changes(&store.save().unwrap());
        assert_eq!(written.first(), Some(&("agv/1".into(), Change::Removed)));
        assert_eq!(written.len(), 4);
        assert_eq!(changes(&store.save().unwrap()), []);
        fs::remove_file(store.file_of(&agv(2))).unwrap();
        assert_eq!(changes(&store.save().unwrap()), [("agv/2".into(), Change::New)]);
    }

    #[test]
    fn what_others_could_read_is_refused() {
        let (_folder, store) = store();
        let (path, ring) = (store.folder().to_owned(), store.file_of(&agv(1)));
        fs::set_permissions(&ring, fs::Permissions::from_mode(0o644)).unwrap();
        assert!(matches!(store.save(), Err(KeyError::Open { .. })));
        assert!(matches!(store.is_behind(), Err(KeyError::Open { .. })));
        let root = store.root_file();
        drop(store);
        fs::set_permissions(&root, fs::Permissions::from_mode(0o604)).unwrap();
        assert!(matches!(Store::open(&path, Fleet(7)), Err(KeyError::Open { .. })));
    }

    #[test]
    fn where_one_file_is_refused_nothing_is_written() {
        let (_folder, mut store) = store();
        let (list, ring) = (nodes_file(store.folder(), Fleet(7)), store.file_of(&agv(2)));
        let (manager, taken) = (store.file_of(&depot()), store.file_of(&agv(1)));
        let read = || [&list, &manager].map(|path| fs::read(path).unwrap());
        let before = read();
        fs::set_permissions(&ring, fs::Permissions::from_mode(0o640)).unwrap();
        store.keys_mut().revoke(&[agv(1)]).unwrap();
        assert!(matches!(store.save(), Err(KeyError::Open { path, .. }) if path == ring));
        assert!(read() == before && taken.exists());
        fs::set_permissions(&ring, fs::Permissions::from_mode(0o600)).unwrap();
        assert_eq!(store.save().unwrap().len(), 3);
    }

    #[test]
    fn a_root_is_not_made_where_a_file_is_refused() {
        let (_folder, store) = store();
        let (path, root, ring) = (store.folder().to_owned(), store.root_file(), store.file_of(&depot()));
        drop(store);
        fs::remove_file(&root).unwrap();
        fs::set_permissions(&ring, fs::Permissions::from_mode(0o640)).unwrap();
        let anew = || {
            let mut keys = FleetKeys::draw(Fleet(7)).unwrap();
            keys.add(&depot(), &[]).unwrap();
            Store::create_unless(&path, keys, &|| false)
        };
        assert!(matches!(anew(), Err(KeyError::Open { .. })) && !root.exists());
        fs::set_permissions(&ring, fs::Permissions::from_mode(0o600)).unwrap();
        let (store, written) = anew().unwrap();
        assert_eq!(changes(&written), [("depot/1".into(), Change::Replaced)]);
        assert_eq!(store.save().unwrap(), []);
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).into_iter().flatten();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    /// Stopped before its first file, and before each further one.
    #[test]
    fn a_new_fleet_that_is_stopped_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        for looks in 0.. {
            let mut keys = FleetKeys::draw(Fleet(7)).unwrap();
            keys.add_all(&[depot(), agv(1), agv(2)], &[]).unwrap();
            let left = std::cell::Cell::new(looks);
            let stop = || left.replace(left.get() - 1) == 0;
            match Store::create_unless(folder.path(), keys, &stop) {
                Err(KeyError::Stopped) => assert_eq!(names(folder.path()), [""; 0], "stopped at look {looks}"),
                made => {
                    assert_eq!((made.unwrap().1.len(), looks), (3, 4));
                    break;
                }
            }
        }
        assert_eq!(names(folder.path()).len(), 5, "root, list and three nodes");
    }

    #[test]
    fn a_change_that_is_stopped_changes_nothing() {
        let (_folder, mut store) = store();
        let all = |store: &Store| {
            names(store.folder()).iter().map(|name| fs::read(store.folder().join(name)).unwrap()).collect::<Vec<_>>()
        };
        let before = all(&store);
        store.keys_mut().rotate().unwrap();
        for looks in 0..4 {
            let left = std::cell::Cell::new(looks);
            assert!(matches!(store.save_unless(&|| left.replace(left.get() - 1) == 0), Err(KeyError::Stopped)));
            assert!(all(&store) == before, "stopped at look {looks}");
        }
        assert_eq!(store.save().unwrap().len(), 3);
    }

    /// Where a file cannot be put in its place, what was made before it goes again.
    #[test]
    fn a_new_fleet_whose_root_cannot_be_put_there_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut keys = FleetKeys::draw(Fleet(7)).unwrap();
        keys.add_all(&[depot(), agv(1)], &[]).unwrap();
        let root = root_file(folder.path(), Fleet(7));
        // Another one comes in between, past the lock.
        let come = || {
            fs::write(&root, "").unwrap();
            false
        };
        assert!(matches!(Store::create_unless(folder.path(), keys, &come), Err(KeyError::System { .. })));
        assert_eq!(names(folder.path()), ["fleet-7.root"]);
    }

    /// The root, the list and a ring: each bit, each digit that becomes another one, each length that is too short.
    #[test]
    fn every_flipped_bit_or_digit_is_refused_with_advice() {
        type Parse = fn(&str) -> Result<(), FormError>;
        let (_folder, store) = store();
        let (folder, copy) = (store.folder().to_owned(), "Take this file from your copy");
        let kinds: [(PathBuf, Parse, &str); 3] = [
            (root_file(&folder, Fleet(7)), |text| parse_root(text, Fleet(7)).map(drop), copy),
            (nodes_file(&folder, Fleet(7)), |text| Members::parse(text).map(drop), copy),
            (store.file_of(&depot()), |text| KeyRing::parse(text).map(drop), "`cara keys derive --fleet 7` where the"),
        ];
        let digits = b"0123456789abcdef";
        for (path, parse, advice) in kinds {
            let right = fs::read(&path).unwrap();
            let read = |bytes: &[u8]| {
                let text = file::text_of(&path, bytes.to_vec())?;
                parse(&text).map_err(|error| file::form(&path, error))
            };
            assert!(read(&right).is_ok());
            let refused = |bytes: &[u8]| {
                let Err(error) = read(bytes) else { panic!("taken: {:?}", String::from_utf8_lossy(bytes)) };
                assert!(matches!(error, KeyError::Damaged(_) | KeyError::Form { .. }), "{error:?}");
                assert!(error.to_string().contains(advice), "{error}");
            };
            for (at, &byte) in right.iter().enumerate() {
                let bits = (0..8).map(|bit| byte ^ 1 << bit);
                let others = digits.iter().copied().filter(|digit| digits.contains(&byte) && *digit != byte);
                for other in bits.chain(others) {
                    let mut wrong = right.clone();
                    wrong[at] = other;
                    refused(&wrong);
                }
                refused(&right[..at]);
            }
            // The file itself, once.
            fs::write(&path, right.to_ascii_uppercase()).unwrap();
        }
        assert!(matches!(Store::peek(&folder, Fleet(7)), Err(KeyError::Damaged(_) | KeyError::Form { .. })));
        assert!(matches!(KeyRing::load(&store.file_of(&depot())), Err(KeyError::Form { .. })));
    }

    #[test]
    fn files_without_a_checksum_are_read_and_get_one() {
        let (_folder, store) = store();
        let (folder, ring) = (store.folder().to_owned(), store.file_of(&agv(1)));
        let paths = [root_file(&folder, Fleet(7)), nodes_file(&folder, Fleet(7)), ring.clone()];
        let right = paths.each_ref().map(|path| fs::read(path).unwrap());
        for path in &paths {
            let text = fs::read_to_string(path).unwrap();
            let (before, _) = text.split_at(text.find("sum ").unwrap());
            let old = ["cara-root", "cara-fleet", "cara-ring"]
                .iter()
                .fold(before.to_owned(), |text, word| text.replace(&format!("{word} 2"), &format!("{word} 1")));
            fs::write(path, old).unwrap();
        }
        assert!(KeyRing::load(&ring).is_ok());
        drop(store);
        let store = Store::open(&folder, Fleet(7)).unwrap();
        assert_eq!(changes(&store.save().unwrap()), [("agv/1".into(), Change::Replaced)]);
        assert!(paths.each_ref().map(|path| fs::read(path).unwrap()) == right);
    }

    #[test]
    fn a_file_that_is_no_text_is_written_again() {
        let (_folder, store) = store();
        let ring = store.file_of(&agv(1));
        for garbage in [&[0xFF, 0xFE][..], b"", b"cara-keys 1", &vec![b'#'; 9 << 20]] {
            fs::write(&ring, garbage).unwrap();
            assert!(!store.is_behind().unwrap());
            assert_eq!(changes(&store.save().unwrap()), [("agv/1".into(), Change::Replaced)]);
        }
        assert_eq!(store.save().unwrap(), []);
    }

    #[test]
    fn files_of_the_step_before_are_behind() {
        let (_folder, mut store) = store();
        let before = fs::read(store.file_of(&agv(2))).unwrap();
        assert!(!store.is_behind().unwrap());
        store.keys_mut().rotate().unwrap();
        assert!(store.is_behind().unwrap());
        store.save().unwrap();
        assert!(!store.is_behind().unwrap());
        fs::write(store.file_of(&agv(2)), before).unwrap();
        assert!(store.is_behind().unwrap());
        store.save().unwrap();
        store.keys_mut().switch().unwrap();
        assert!(store.is_behind().unwrap(), "the order of generations counts");
        fs::remove_file(store.file_of(&depot())).unwrap();
        store.save().unwrap();
        fs::remove_file(store.file_of(&depot())).unwrap();
        assert!(!store.is_behind().unwrap(), "what was brought away may be gone here");
    }

    #[test]
    fn a_list_of_nodes_that_is_missing_is_told() {
        let (_folder, store) = store();
        let path = store.folder().to_owned();
        drop(store);
        fs::remove_file(nodes_file(&path, Fleet(7))).unwrap();
        let error = Store::open(&path, Fleet(7)).unwrap_err();
        assert!(matches!(error, KeyError::NoNodes { .. }), "{error}");
        assert!(error.to_string().contains("fleet-7.nodes is missing"), "{error}");
    }

    #[test]
    fn a_root_that_is_none_is_told() {
        let (_folder, store) = store();
        let (path, root) = (store.folder().to_owned(), store.root_file());
        drop(store);
        let text = fs::read_to_string(&root).unwrap();
        for (wrong, line) in
            [(text.replace("fleet 7\n", "fleet 8\n"), 3), (text.replace("root ", "root x"), 2), (String::new(), 1)]
        {
            let mut wrong = wrong.split("sum ").next().unwrap().to_owned();
            push_sum(&mut wrong);
            fs::write(&root, wrong).unwrap();
            match Store::open(&path, Fleet(7)) {
                Err(KeyError::Form { line: found, .. }) => assert_eq!(found, line),
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn a_vehicle_more_changes_two_files() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = Store::create(folder.path(), FleetKeys::draw(Fleet(7)).unwrap()).unwrap();
        store.keys_mut().add(&depot(), &[]).unwrap();
        (1..=300).for_each(|id| store.keys_mut().add(&agv(id), &[]).unwrap());
        store.keys_mut().rotate().unwrap();
        assert_eq!(store.save().unwrap().len(), 301);
        assert_eq!(KeyRing::load(&store.file_of(&depot())).unwrap().peers().len(), 300);
        store.keys_mut().add(&agv(301), &[]).unwrap();
        assert_eq!(store.save().unwrap().len(), 2);
    }
}
