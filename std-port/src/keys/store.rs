//! The folder in which a fleet's keys are made: `fleet-7.root`, the list of nodes `fleet-7.nodes`, and beside them the file
//! of each node, to be brought to where it runs.

use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use cara_core::distribution::identity::{Fleet, Identity};
use cara_secure::keys::RootKey;
use rustix::fs::{FlockOperation, flock};
use zeroize::Zeroizing;

use super::members::Members;
use super::text::{FormError, Lines, push_key};
use super::{FleetKeys, KeyError, KeyRing, file, place};

/// Which form this is.
const FORM: u32 = 1;
const ROOT_BYTES: usize = 512;

/// A fleet's keys in a folder, which nobody else changes while this is there.
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

pub(super) fn root_file(folder: &Path, fleet: Fleet) -> PathBuf {
    folder.join(format!("fleet-{}.root", fleet.0))
}

fn nodes_file(folder: &Path, fleet: Fleet) -> PathBuf {
    folder.join(format!("fleet-{}.nodes", fleet.0))
}

impl Store {
    /// Keeps new keys in a folder, which is made for this user alone if it is not there.
    pub fn create(folder: &Path, keys: FleetKeys) -> Result<Self, KeyError> {
        file::make_folder(folder)?;
        let lock = lock(folder)?;
        let fleet = keys.members().fleet();
        let path = root_file(folder, fleet);
        if path.exists() {
            return Err(KeyError::Exists { path, fleet });
        }
        let store = Self { folder: folder.to_owned(), keys, _lock: lock };
        // What could not be saved is told while there is no root that would be in the way of the next try.
        store.planned()?;
        // A list of nodes without its root is of keys that nobody has any more.
        file::write_private(&nodes_file(folder, fleet), store.keys.members().text().as_bytes())?;
        file::create(&path, &root_text(fleet, store.keys.root()))?;
        Ok(store)
    }

    /// The keys of a fleet in a folder.
    pub fn open(folder: &Path, fleet: Fleet) -> Result<Self, KeyError> {
        let path = root_file(folder, fleet);
        if !path.exists() {
            return Err(KeyError::NoRoot { folder: folder.to_owned(), fleet });
        }
        let lock = lock(folder)?;
        Ok(Self { folder: folder.to_owned(), keys: Self::peek(folder, fleet)?, _lock: lock })
    }

    /// The keys of a fleet in a folder, as they are while others may change them: to look at.
    pub fn peek(folder: &Path, fleet: Fleet) -> Result<FleetKeys, KeyError> {
        let path = root_file(folder, fleet);
        let (text, _) = file::read(&path)?;
        let root = parse_root(&text, fleet).map_err(|error| file::form(&path, error))?;
        let path = nodes_file(folder, fleet);
        let (text, _) = file::read(&path).map_err(|error| without_nodes(error, fleet))?;
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
        self.folder.join(place::file_name(identity, self.keys.members().fleet()))
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
    /// refused, nothing is written. Where writing fails or is interrupted, the next one completes it.
    pub fn save(&self) -> Result<Vec<Written>, KeyError> {
        let (members, planned) = (self.keys.members(), self.planned()?);
        file::write_private(&nodes_file(&self.folder, members.fleet()), members.text().as_bytes())?;
        let written = planned.into_iter().map(Planned::carry_out).collect::<Result<_, _>>();
        written.map_err(|error| KeyError::HalfWay { fleet: members.fleet(), error: Box::new(error) })
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
        // Who can read it does not matter any more.
        Ok(file::is_there(&to_be.path)?.then_some(Planned { to_be, text: None }))
    }

    fn planned_ring(&self, identity: &Identity) -> Result<Option<Planned>, KeyError> {
        // Whoever is a member has a ring.
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

impl Planned {
    fn carry_out(self) -> Result<Written, KeyError> {
        match &self.text {
            Some(text) => file::write_private(&self.to_be.path, text.as_bytes())?,
            None => drop(file::remove(&self.to_be.path)?),
        }
        Ok(self.to_be)
    }
}

/// The text of a node's file, if there is one; an empty one where it is not even text, and only to be written again.
fn own_text(path: &Path) -> Result<Option<Zeroizing<String>>, KeyError> {
    match file::read(path) {
        Ok((text, _)) => Ok(Some(text)),
        Err(KeyError::Form { .. }) => Ok(Some(Zeroizing::default())),
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
        "# The root of all keys of fleet {fleet}. Whoever reads it can speak as every node. It stays here; keep a copy.\n\
         cara-root {FORM}\nfleet {fleet}\nroot "
    ));
    push_key(&mut text, root.expose());
    text.push('\n');
    debug_assert!(text.len() <= ROOT_BYTES, "a text that grows leaves keys behind");
    text
}

fn parse_root(text: &str, fleet: Fleet) -> Result<RootKey, FormError> {
    let mut lines = Lines::of(text);
    let head = lines.expect("cara-root", "here `cara-root 1` is expected: this is no fleet's root")?;
    if head.number()? != FORM {
        return Err(head.wrong("this root is written in a form that this version does not know"));
    }
    let line = lines.expect("fleet", "here `fleet` is expected")?;
    if line.number()? != fleet.0 {
        return Err(line.wrong("this is the root of another fleet than its file's name says"));
    }
    let (key, _) = lines.expect("root", "here `root` is expected")?.key()?;
    Ok(RootKey::new(*key))
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
            Store::create(&path, keys)
        };
        assert!(matches!(anew(), Err(KeyError::Open { .. })) && !root.exists());
        fs::set_permissions(&ring, fs::Permissions::from_mode(0o600)).unwrap();
        assert_eq!(changes(&anew().unwrap().save().unwrap()), [("depot/1".into(), Change::Replaced)]);
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
