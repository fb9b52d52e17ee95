//! Files that only their owner reads: read so, or not at all; written whole, or not at all.

use std::fs::{DirBuilder, File, Metadata, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;
use rustix::process::geteuid;
use tempfile::TempPath;
use zeroize::{Zeroize, Zeroizing};

use super::KeyError;
use super::error::renewal;
use super::text::{Checksum, FormError, checksum};

/// Longest file that is read: the ring of ten thousand nodes in all its generations.
const BYTES: u64 = 8 << 20;
/// Files that are not in their places yet begin so.
const TEMPORARY: &str = ".keys-";
/// Permissions of others than the owner.
const OTHERS: u32 = 0o077;

/// What tells one state of a file from another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Mark([i64; 2], [u64; 3]);

impl Mark {
    /// Of the file at a path.
    pub(crate) fn of(path: &Path) -> io::Result<Self> {
        path.metadata().map(|found| Self::from(&found))
    }
}

impl From<&Metadata> for Mark {
    fn from(found: &Metadata) -> Self {
        Self([found.ctime(), found.ctime_nsec()], [found.dev(), found.ino(), found.len()])
    }
}

pub(super) fn system(path: &Path, error: impl Into<io::Error>) -> KeyError {
    KeyError::System { path: path.to_owned(), error: error.into() }
}

pub(super) fn form(path: &Path, FormError { line, what }: FormError) -> KeyError {
    KeyError::Form { path: path.to_owned(), line, what }
}

/// The text of a file that belongs to this user, that no other user can read, and that is as it was written.
pub(super) fn read(path: &Path) -> Result<(Zeroizing<String>, Mark), KeyError> {
    let mut file = open(path)?;
    let found = file.metadata().map_err(|error| system(path, error))?;
    check(path, &found).map_err(|error| if is_ours(path, Some(&file)) { error } else { error.of_another_file() })?;
    // All of it at once: a buffer that grows leaves pieces behind.
    let mut bytes = Zeroizing::new(vec![0; found.len() as usize]);
    file.read_exact(&mut bytes).map_err(|error| system(path, error))?;
    Ok((text_of(path, std::mem::take(&mut *bytes))?, Mark::from(&found)))
}

/// What is in a file, if it is as it was written.
pub(super) fn text_of(path: &Path, bytes: Vec<u8>) -> Result<Zeroizing<String>, KeyError> {
    match String::from_utf8(bytes).map(Zeroizing::new) {
        Ok(text) if text.contains("\r\n") || text.starts_with('\u{feff}') => {
            let what = "the lines end with CR LF, or a byte order mark stands before them, as a copy in text mode, git or an editor \
                        on Windows leave them: copy the file as it was, or mend it with \
                        `sed -i '1s/^\\xEF\\xBB\\xBF//;s/\\r$//' FILE`";
            Err(form(path, FormError { line: 1, what }))
        }
        Ok(text) if checksum(&text) == Checksum::Wrong => Err(KeyError::Damaged(path.to_owned())),
        Ok(text) => Ok(text),
        Err(error) => {
            error.into_bytes().zeroize();
            Err(form(path, FormError { line: 1, what: "this is no text" }))
        }
    }
}

/// Tells in the log how a file without a checksum gets one.
pub(super) fn advise(path: &Path, text: &str) {
    if checksum(text) == Checksum::Absent {
        tracing::warn!(path = %path.display(), "a key file without a checksum: {}", renewal(path));
    }
}

fn open(path: &Path) -> Result<File, KeyError> {
    // Opening a pipe would block until its other end writes.
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
    let opened = OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path);
    opened.map_err(|error| match (error.kind(), path.metadata()) {
        (io::ErrorKind::PermissionDenied, Ok(found)) if found.uid() != own() => match is_ours(path, None) {
            true => foreign(path, found.uid()),
            false => foreign(path, found.uid()).of_another_file(),
        },
        _ => system(path, error),
    })
}

fn check(path: &Path, found: &Metadata) -> Result<(), KeyError> {
    if !found.is_file() {
        return Err(KeyError::NoFile(path.to_owned()));
    }
    if found.uid() != own() {
        return Err(foreign(path, found.uid()));
    }
    if found.mode() & OTHERS != 0 {
        return Err(KeyError::Open { path: path.to_owned(), mode: found.mode() & 0o777 });
    }
    if found.len() > BYTES {
        return Err(form(path, FormError { line: 1, what: "the file is longer than any with keys" }));
    }
    Ok(())
}

/// Whether `cara keys` made the file, by its name or by what it begins with.
fn is_ours(path: &Path, file: Option<&File>) -> bool {
    let is_named = path.extension().is_some_and(|end| ["keys", "root", "nodes"].iter().any(|known| end == *known));
    let mut head = Zeroizing::new([0; 512]);
    let length = file.and_then(|file| file.read_at(&mut *head, 0).ok()).unwrap_or(0);
    is_named
        || String::from_utf8_lossy(&head[..length])
            .lines()
            .any(|line| line.trim_start_matches('\u{feff}').starts_with("cara-"))
}

fn own() -> u32 {
    geteuid().as_raw()
}

fn foreign(path: &Path, owner: u32) -> KeyError {
    KeyError::Foreign { path: path.to_owned(), owner, own: own() }
}

/// Makes a folder that only this user enters, unless there is one.
pub(crate) fn make_folder(path: &Path) -> Result<(), KeyError> {
    let made = DirBuilder::new().recursive(true).mode(0o700).create(path);
    made.map_err(|error| KeyError::NoFolder { path: path.to_owned(), error })
}

/// Writes a file for this user alone in the place of the one at `path`, if there is one: whole, or not at all.
pub fn write_private(path: &Path, bytes: &[u8]) -> Result<(), KeyError> {
    Staged::write(path, bytes)?.put()?;
    keep_names(&folder_of(path))
}

/// A file for this user alone that is on the disk and not in its place yet. It is gone when this is dropped.
#[derive(Debug)]
pub(super) struct Staged {
    temporary: TempPath,
    path: PathBuf,
}

impl Staged {
    /// Writes it beside its place, opened with `O_EXCL`.
    pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<Self, KeyError> {
        check_replaceable(path)?;
        let file = tempfile::Builder::new().prefix(TEMPORARY).tempfile_in(folder_of(path));
        let mut file = file.map_err(|error| system(path, error))?;
        let result = file.write_all(bytes).and_then(|()| file.as_file().sync_all());
        result.map_err(|error| system(path, error))?;
        // Without its descriptor: there are as many of these as a fleet has nodes.
        Ok(Self { temporary: file.into_temp_path(), path: path.to_owned() })
    }

    /// Where it will be.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Puts it in its place, where there may be another one.
    pub(super) fn put(self) -> Result<(), KeyError> {
        let Self { temporary, path } = self;
        temporary.persist(&path).map_err(|error| system(&path, error.error))
    }

    /// Puts it in its place, where there must be none.
    pub(super) fn put_new(self) -> Result<(), KeyError> {
        let Self { temporary, path } = self;
        temporary.persist_noclobber(&path).map_err(|error| system(&path, error.error))
    }
}

/// Takes away what a command left that was killed before its files were in their places.
pub(super) fn remove_staged(folder: &Path) -> Result<(), KeyError> {
    for entry in std::fs::read_dir(folder).map_err(|error| system(folder, error))?.flatten() {
        if entry.file_name().to_string_lossy().starts_with(TEMPORARY) {
            remove(&entry.path())?;
        }
    }
    Ok(())
}

/// Refuses a path where a folder, a pipe or a device is: a rename would put a file in the place of those last two.
pub fn check_replaceable(path: &Path) -> Result<(), KeyError> {
    match path.metadata() {
        Ok(found) if !found.is_file() => Err(KeyError::InTheWay(path.to_owned())),
        // What else is wrong shows when it is written.
        _ => Ok(()),
    }
}

/// Whether there is a file, or a link, that can be taken away.
pub(super) fn is_there(path: &Path) -> Result<bool, KeyError> {
    match path.symlink_metadata() {
        Ok(found) if !found.is_file() && !found.is_symlink() => Err(KeyError::NoFile(path.to_owned())),
        Ok(_) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(system(path, error)),
    }
}

/// Takes a file away, if there is one.
pub(super) fn remove(path: &Path) -> Result<bool, KeyError> {
    match std::fs::remove_file(path) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(system(path, error)),
    }
}

/// The names of files are on the disk when their folder is.
pub(super) fn keep_names(folder: &Path) -> Result<(), KeyError> {
    File::open(folder).and_then(|folder| folder.sync_all()).map_err(|error| system(folder, error))
}

fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{Permissions, set_permissions};
    use std::os::unix::fs::PermissionsExt;

    const SECRET: &str = "cara-ring 1\n";

    fn create(path: &Path, text: &str) -> Result<(), KeyError> {
        Staged::write(path, text.as_bytes())?.put_new()
    }

    fn pipe(folder: &Path) -> PathBuf {
        let pipe = folder.join("pipe");
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, rustix::fs::Mode::RWXU, 0).unwrap();
        pipe
    }

    #[test]
    fn a_file_that_went_through_windows_is_told_with_what_mends_it() {
        let mut text = "form 2\nname agv\n".to_owned();
        super::super::text::push_sum(&mut text);
        let path = Path::new("agv.keys");
        assert!(text_of(path, text.clone().into_bytes()).is_ok());
        for wrong in [text.replace('\n', "\r\n"), format!("\u{feff}{text}")] {
            let error = text_of(path, wrong.into_bytes()).unwrap_err().to_string();
            assert!(error.contains("CR LF, or a byte order mark") && error.contains("`sed -i '1s/^"), "{error}");
        }
    }

    #[test]
    fn what_is_written_is_for_its_owner_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        create(&path, "one").unwrap();
        assert_eq!(path.metadata().unwrap().mode() & 0o777, 0o600);
        assert!(matches!(create(&path, "two"), Err(KeyError::System { .. })));
        assert_eq!(*read(&path).unwrap().0, "one");
        let before = Mark::of(&path).unwrap();
        write_private(&path, b"two").unwrap();
        assert_eq!((path.metadata().unwrap().mode() & 0o777, &**read(&path).unwrap().0), (0o600, "two"));
        assert_ne!(Mark::of(&path).unwrap(), before);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside it");
        assert!(is_there(&path).unwrap() && remove(&path).unwrap());
        assert!(!is_there(&path).unwrap() && !remove(&path).unwrap());
        assert!(matches!(is_there(folder.path()), Err(KeyError::NoFile(_))));
        assert!(matches!(make_folder(&folder.path().join("b")), Ok(())));
        create(&path, "one").unwrap();
        assert!(matches!(make_folder(&path), Err(KeyError::NoFolder { .. })));
    }

    #[test]
    fn what_is_not_put_in_its_place_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let names = || std::fs::read_dir(folder.path()).unwrap().count();
        let staged = Staged::write(&folder.path().join("a"), b"one").unwrap();
        assert_eq!(names(), 1);
        drop(staged);
        assert_eq!(names(), 0);
        // As a command leaves it that is killed.
        std::mem::forget(Staged::write(&folder.path().join("a"), b"one").unwrap());
        write_private(&folder.path().join("b"), b"two").unwrap();
        remove_staged(folder.path()).unwrap();
        assert_eq!((names(), folder.path().join("b").exists()), (1, true));
    }

    #[test]
    fn what_is_no_file_is_neither_replaced_nor_removed() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = pipe(folder.path());
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&pipe, &link).unwrap();
        for path in [pipe.as_path(), &link, folder.path()] {
            assert!(matches!(write_private(path, b"one"), Err(KeyError::InTheWay(_))), "{}", path.display());
        }
        assert!(matches!(is_there(&pipe), Err(KeyError::NoFile(_))));
        assert!(!pipe.metadata().unwrap().is_file() && link.symlink_metadata().unwrap().is_symlink());
    }

    #[test]
    fn every_permission_of_others_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("it's keys");
        let others = folder.path().join("passwd");
        std::fs::write(&others, "root:x:0:0").unwrap();
        set_permissions(&others, Permissions::from_mode(0o644)).unwrap();
        let text = read(&others).unwrap_err().to_string();
        assert!(text.contains("is no file of `cara keys`") && !text.contains("chmod"), "{text}");
        create(&path, SECRET).unwrap();
        for bit in 0..6 {
            set_permissions(&path, Permissions::from_mode(0o600 | 1 << bit)).unwrap();
            let error = read(&path).unwrap_err();
            assert!(matches!(error, KeyError::Open { .. }), "{error}");
            let text = error.to_string();
            assert!(text.contains("chmod 600 \"") || text.contains("chmod 600 '"), "{text}");
        }
        for mode in [0o600, 0o400, 0o700] {
            set_permissions(&path, Permissions::from_mode(mode)).unwrap();
            assert_eq!(*read(&path).unwrap().0, SECRET);
        }
    }

    #[test]
    fn what_is_no_file_of_ours_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(read(folder.path()), Err(KeyError::NoFile(_))));
        assert!(matches!(read(Path::new("/dev/zero")), Err(KeyError::NoFile(_))));
        assert!(matches!(read(&folder.path().join("absent")), Err(KeyError::System { .. })));
        let pipe = pipe(folder.path());
        assert!(matches!(read(&pipe), Err(KeyError::NoFile(_))));
        let bytes = folder.path().join("bytes");
        create(&bytes, "").unwrap();
        std::fs::write(&bytes, [0xFF, 0xFE]).unwrap();
        assert!(matches!(read(&bytes), Err(KeyError::Form { .. })));
        if own() == 0 {
            std::os::unix::fs::chown(&bytes, Some(1), None).unwrap();
            let text = read(&bytes).unwrap_err().to_string();
            assert!(text.contains("is no file of `cara keys`") && !text.contains("chown"), "{text}");
            let named = folder.path().join("a.keys");
            std::fs::rename(&bytes, &named).unwrap();
            let text = read(&named).unwrap_err().to_string();
            assert!(text.contains("belongs to user 1") && text.contains("sudo chown 0 "), "{text}");
        }
    }
}
