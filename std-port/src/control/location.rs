//! Control sockets: a directory that only its owner can enter, and one socket in it for each running unit.

use std::collections::HashSet;
use std::fs::{DirBuilder, Permissions, set_permissions};
use std::io;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use cara_core::distribution::identity::{Fleet, Identity};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, fstat, open};
use rustix::io::Errno;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with, sockopt,
};
use rustix::process::geteuid;

use crate::file_name::escape;

/// Ends the name of a control socket.
const SUFFIX: &str = ".sock";
/// Bytes of a unit's name in the name of its socket; of a longer one a piece and a hash.
const NAME_BYTES: usize = 40;
const PIECE_BYTES: usize = 23;
/// Connections that wait to be accepted.
const BACKLOG: i32 = 16;
/// How long another process may hold the directory's lock.
const PATIENCE: Duration = Duration::from_secs(1);

/// Why there is no control socket.
#[derive(Debug, thiserror::Error)]
pub(super) enum LocationError {
    #[error("{0} has no directory above it: give the socket's whole path")]
    NoDirectory(PathBuf),
    #[error("{path} belongs to user {owner}: remove it, or set CARA_CONTROL_DIR to a directory of your own")]
    Foreign { path: PathBuf, owner: u32 },
    #[error(
        "others can enter {path} (mode {mode:o}): set CARA_CONTROL_DIR to a directory of your own, or, if nothing but control sockets is in this one, `chmod 700` it"
    )]
    Open { path: PathBuf, mode: u32 },
    #[error("another process answers on {0}: does a unit of the same name, id and fleet run already?")]
    InUse(PathBuf),
    #[error("{0} is there and no socket: move it away")]
    NotASocket(PathBuf),
    #[error("{path}: {error}")]
    System { path: PathBuf, error: io::Error },
}

impl LocationError {
    fn system(path: &Path, error: impl Into<io::Error>) -> Self {
        Self::System { path: path.to_owned(), error: error.into() }
    }
}

/// The directory of control sockets: `$CARA_CONTROL_DIR`, else `$XDG_RUNTIME_DIR/cara`, else one of the user's in the
/// directory for temporary files.
pub fn directory() -> PathBuf {
    defaults().swap_remove(0)
}

/// Where a command looks for control sockets, in this order: `$CARA_CONTROL_DIR` alone if it is set; else each directory that a
/// unit of this user may have chosen in another environment, such as that of a service or before a logout.
pub fn directories() -> Vec<PathBuf> {
    let mut all = defaults();
    if !is_directory_set() {
        let seen = super::elsewhere::listening_in();
        all.extend(seen.into_iter().filter(|directory| is_default(directory)));
    }
    let mut known = HashSet::new();
    all.retain(|directory| known.insert(directory.clone()));
    all
}

/// Whether this command's environment says where.
pub(super) fn is_directory_set() -> bool {
    set("CARA_CONTROL_DIR").is_some()
}

fn set(name: &str) -> Option<PathBuf> {
    std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

/// In which directories a unit opens its socket; the first one unless that is gone.
pub(super) fn defaults() -> Vec<PathBuf> {
    if let Some(only) = set("CARA_CONTROL_DIR") {
        return vec![only];
    }
    let of_user = format!("cara-{}", own_uid());
    let [temporary, tmp] = [std::env::temp_dir(), PathBuf::from("/tmp")].map(|folder| folder.join(&of_user));
    let of_system = PathBuf::from(format!("/run/user/{}/cara", own_uid()));
    match set("XDG_RUNTIME_DIR") {
        Some(runtime) => vec![runtime.join("cara"), of_system, temporary, tmp],
        // The first is where such a unit has always been.
        None => vec![temporary, of_system, tmp],
    }
}

/// Whether a directory is named as in [`defaults`] and is this user's, so that no unit was put apart there.
fn is_default(directory: &Path) -> bool {
    let name = directory.file_name().unwrap_or_default();
    (name == "cara" || *name == *format!("cara-{}", own_uid())) && enter(directory, EnteredBy::Owner).is_ok()
}

pub(super) fn own_uid() -> u32 {
    geteuid().as_raw()
}

/// The name of a unit's socket.
pub(super) fn file_name(identity: &Identity, fleet: Fleet) -> String {
    let mut name = escape(identity.name());
    if name.len() > NAME_BYTES {
        let hash = fnv(identity.name().as_bytes());
        let end =
            (0..=PIECE_BYTES).rev().find(|&end| !name[..end].ends_with('%') && !name[..end.max(1) - 1].ends_with('%'));
        name.truncate(end.unwrap_or(0));
        name = format!("{name}~{hash:016x}");
    }
    format!("{name}-{}-{}{SUFFIX}", identity.id(), fleet.0)
}

/// The `NAME/ID` and the fleet in the name of a unit's socket; for any other name, that name and fleet 0.
pub(super) fn reported_by_name(path: &Path) -> (String, u32) {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    reported(&name).unwrap_or_else(|| (path.display().to_string(), 0))
}

/// Whether the name of a socket tells the whole name of its unit.
pub(super) fn reports_name(path: &Path) -> bool {
    reported(&path.file_name().unwrap_or_default().to_string_lossy()).is_some_and(|(unit, _)| !unit.contains('~'))
}

fn reported(file: &str) -> Option<(String, u32)> {
    let (rest, fleet) = file.strip_suffix(SUFFIX)?.rsplit_once('-')?;
    let (name, id) = rest.rsplit_once('-')?;
    let id: u32 = id.parse().ok()?;
    Some((format!("{}/{id}", unescape(name)), fleet.parse().ok()?))
}

/// What [`escape`] was given, as far as it can be told.
fn unescape(name: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = name.as_bytes();
    while let Some((&first, behind)) = rest.split_first() {
        let digits = behind.get(..2).and_then(|digits| std::str::from_utf8(digits).ok());
        match digits.and_then(|digits| u8::from_str_radix(digits, 16).ok()).filter(|_| first == b'%') {
            Some(byte) => {
                bytes.push(byte);
                rest = behind.get(2..).unwrap_or_default();
            }
            None => {
                bytes.push(first);
                rest = behind;
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

/// The sockets in a directory, live or stale; none in a directory that other users can write to.
pub(super) fn sockets(directory: &Path) -> Result<Vec<PathBuf>, LocationError> {
    let is_named = set("CARA_CONTROL_DIR").is_some_and(|named| named == directory);
    let entries = enter(directory, if is_named { EnteredBy::Anybody } else { EnteredBy::Owner })
        .and_then(|_| std::fs::read_dir(directory).map_err(|error| LocationError::system(directory, error)));
    // One that was only seen in use may go at any time, and a file take its place or that of one above it.
    let is_gone = |kind| match kind {
        io::ErrorKind::NotFound => true,
        io::ErrorKind::NotADirectory => !is_named && !directory.is_symlink(),
        _ => false,
    };
    let entries = match entries {
        Err(LocationError::System { error, .. }) if is_gone(error.kind()) => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut sockets: Vec<PathBuf> = entries
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| path.to_string_lossy().ends_with(SUFFIX))
        .collect();
    sockets.sort();
    Ok(sockets)
}

/// A listening socket and its file.
#[derive(Clone, Debug)]
pub(super) struct Location {
    path: PathBuf,
    entered_by: EnteredBy,
    /// Identifies the file, so that a later one at the same path is not removed.
    file: Mark,
}

/// Who may be able to enter a directory of control sockets. No other user may ever write there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum EnteredBy {
    /// This user, whose directory it is.
    Owner,
    /// Also its group: the directory of a socket that is shared.
    Group,
    /// Whoever: a client was told to look there, and believes whose directory it is.
    Anybody,
}

/// Device and number of a file, which may be used again, and the time of its last change.
pub(super) type Mark = (u64, u64, i64, i64);

pub(super) fn mark(path: &Path) -> io::Result<Mark> {
    let file = path.symlink_metadata()?;
    Ok((file.dev(), file.ino(), file.ctime(), file.ctime_nsec()))
}

impl Location {
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Opens the socket at `path`, replacing a stale one. Who can enter the directory of one that is shared can connect.
    pub(super) fn open(path: &Path, is_shared: bool) -> Result<(Self, UnixListener), LocationError> {
        let (entered_by, mode) = if is_shared { (EnteredBy::Group, 0o666) } else { (EnteredBy::Owner, 0o600) };
        let directory = parent(path)?;
        let made = DirBuilder::new().recursive(true).mode(0o700).create(directory);
        made.map_err(|error| LocationError::system(directory, error))?;
        let directory = enter(directory, entered_by)?;
        let _lock = lock(&directory).map_err(|error| LocationError::system(path, error))?;
        make_room(path)?;
        let listener = listen_at(path, &directory).map_err(|error| LocationError::system(path, error))?;
        // Users who must not connect cannot enter the directory, so the socket was not reachable with wider permissions in between.
        set_permissions(path, Permissions::from_mode(mode)).map_err(|error| LocationError::system(path, error))?;
        let file = mark(path).map_err(|error| LocationError::system(path, error))?;
        Ok((Self { path: path.to_owned(), entered_by, file }, listener))
    }

    /// Whether the file is still there, with whatever permissions.
    pub(super) fn is_there(&self) -> bool {
        mark(&self.path).is_ok_and(|file| (file.0, file.1) == (self.file.0, self.file.1))
    }

    /// Removes the file, unless it is another one by now.
    pub(super) fn remove(&self) {
        let Some(directory) = self.path.parent().and_then(|directory| enter(directory, self.entered_by).ok()) else {
            return;
        };
        let Ok(_lock) = lock(&directory) else { return };
        if mark(&self.path).is_ok_and(|file| file == self.file) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

fn parent(path: &Path) -> Result<&Path, LocationError> {
    let directory = path.parent().filter(|directory| !directory.as_os_str().is_empty());
    directory.ok_or_else(|| LocationError::NoDirectory(path.to_owned()))
}

/// Opens a directory that belongs to this user and that no other user can enter, unless `entered_by` says otherwise.
fn enter(path: &Path, entered_by: EnteredBy) -> Result<OwnedFd, LocationError> {
    let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::RDONLY | OFlags::CLOEXEC;
    let directory = open(path, flags, Mode::empty()).map_err(|errno| LocationError::system(path, errno))?;
    let found = fstat(&directory).map_err(|errno| LocationError::system(path, errno))?;
    let mode = found.st_mode & 0o777;
    let closed_to_others = match entered_by {
        EnteredBy::Owner => 0o077,
        EnteredBy::Group => 0o027,
        EnteredBy::Anybody => 0o022,
    };
    if found.st_uid != own_uid() && entered_by != EnteredBy::Anybody {
        return Err(LocationError::Foreign { path: path.to_owned(), owner: found.st_uid });
    }
    if mode & closed_to_others != 0 {
        return Err(LocationError::Open { path: path.to_owned(), mode });
    }
    Ok(directory)
}

/// Locks a directory while a socket in it is opened or removed; the returned descriptor holds the lock.
fn lock(directory: &OwnedFd) -> io::Result<OwnedFd> {
    let own = rustix::fs::openat(directory, ".", OFlags::DIRECTORY | OFlags::RDONLY | OFlags::CLOEXEC, Mode::empty())?;
    let end = Instant::now() + PATIENCE;
    loop {
        match flock(&own, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(own),
            Err(Errno::WOULDBLOCK) if Instant::now() < end => std::thread::sleep(Duration::from_millis(2)),
            Err(errno) => return Err(errno.into()),
        }
    }
}

/// Removes a stale socket.
fn make_room(path: &Path) -> Result<(), LocationError> {
    let Ok(found) = path.symlink_metadata() else { return Ok(()) };
    if !found.file_type().is_socket() {
        return Err(LocationError::NotASocket(path.to_owned()));
    }
    match dial(path) {
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {
            std::fs::remove_file(path).map_err(|error| LocationError::system(path, error))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        // A full queue of connections is a sign of life, too.
        _ => Err(LocationError::InUse(path.to_owned())),
    }
}

/// Whether a process has the socket, including one that hangs: the system accepts connections for it.
pub(super) fn is_held(path: &Path) -> bool {
    let is_own = parent(path).and_then(|directory| enter(directory, EnteredBy::Group)).is_ok();
    is_own && dial(path).map_or_else(|error| error.kind() == io::ErrorKind::WouldBlock, |_| true)
}

/// Removes a socket whose process hangs, unless another one is there by now.
pub(super) fn free(path: &Path, file: Mark) -> bool {
    let Ok(directory) = parent(path).and_then(|directory| enter(directory, EnteredBy::Group)) else { return false };
    let Ok(_lock) = lock(&directory) else { return false };
    mark(path).is_ok_and(|found| found == file) && std::fs::remove_file(path).is_ok()
}

fn listen_at(path: &Path, directory: &OwnedFd) -> io::Result<UnixListener> {
    let socket = unix_socket()?;
    bind(&socket, &address(path, directory)?)?;
    listen(&socket, BACKLOG)?;
    Ok(UnixListener::from(socket))
}

/// Connects without waiting; what comes back waits when it reads and writes.
pub(super) fn dial(path: &Path) -> io::Result<UnixStream> {
    let flags = OFlags::DIRECTORY | OFlags::PATH | OFlags::CLOEXEC;
    let above = path.parent().filter(|above| !above.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let directory = open(above, flags, Mode::empty())?;
    let socket = unix_socket()?;
    connect(&socket, &address(path, &directory)?)?;
    let stream = UnixStream::from(socket);
    stream.set_nonblocking(false)?;
    Ok(stream)
}

fn unix_socket() -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    Ok(socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?)
}

/// A path that is too long for a socket's address is taken from its directory on.
fn address(path: &Path, directory: &OwnedFd) -> io::Result<SocketAddrUnix> {
    match SocketAddrUnix::new(path) {
        Err(Errno::NAMETOOLONG) => {
            let name = path.file_name().unwrap_or_default();
            let short = Path::new("/proc/self/fd").join(directory.as_raw_fd().to_string()).join(name);
            Ok(SocketAddrUnix::new(short)?)
        }
        address => Ok(address?),
    }
}

/// Whether a socket is in a directory of that user in which nobody else can have put it.
pub(super) fn is_shared_by(path: &Path, owner: u32) -> bool {
    let directory = parent(path).and_then(|directory| enter(directory, EnteredBy::Anybody));
    directory.is_ok_and(|directory| fstat(&directory).is_ok_and(|found| found.st_uid == owner))
}

/// The user at the other end of a connection.
pub(super) fn peer_uid(stream: &UnixStream) -> io::Result<u32> {
    Ok(sockopt::socket_peercred(stream.as_fd())?.uid.as_raw())
}

/// The process at the other end of a connection.
pub(super) fn peer_pid(stream: &UnixStream) -> io::Result<rustix::process::Pid> {
    Ok(sockopt::socket_peercred(stream.as_fd())?.pid)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directory() -> tempfile::TempDir {
        let directory = tempfile::tempdir().unwrap();
        set_permissions(directory.path(), Permissions::from_mode(0o700)).unwrap();
        directory
    }

    fn mode(path: &Path) -> u32 {
        path.symlink_metadata().unwrap().mode() & 0o777
    }

    fn name_of(name: &str) -> String {
        file_name(&Identity::m_unit(name, 7).unwrap(), Fleet(3))
    }

    #[test]
    fn a_socket_is_named_after_its_unit() {
        assert_eq!(name_of("AGV_manager"), "AGV_manager-7-3.sock");
        assert_eq!(name_of("../../etc"), "%2E.%2F..%2Fetc-7-3.sock");
        assert_eq!(name_of("."), "%2E-7-3.sock");
        assert_eq!(name_of("Fähre 1"), "F%C3%A4hre%201-7-3.sock");
    }

    #[test]
    fn the_name_of_a_socket_tells_its_unit() {
        for name in ["AGV_manager", "a-b", "../../etc", "Fähre 1"] {
            assert_eq!(reported_by_name(&Path::new("/x").join(name_of(name))), (format!("{name}/7"), 3));
        }
        for odd in ["unit.sock", "a-b.sock", "a-1-x.sock", "a-1-2"] {
            assert_eq!(reported_by_name(&Path::new("/x").join(odd)), (format!("/x/{odd}"), 0));
        }
        assert_eq!(unescape("%"), "%");
        assert_eq!(unescape("%4"), "%4");
    }

    #[test]
    fn long_names_are_cut_and_stay_apart() {
        let (one, other) = (name_of(&"ä".repeat(16)), name_of(&format!("{}b", "ä".repeat(15))));
        assert_ne!(one, other);
        for name in [&one, &other] {
            assert!(name.len() <= NAME_BYTES + "-4294967295-4294967295.sock".len(), "{name}");
            let piece = name.split_once('~').unwrap().0;
            assert_eq!(piece.len() % 3, 0, "an escape is not cut: {name}");
        }
    }

    #[test]
    fn the_directory_is_made_for_its_owner_alone_and_so_is_the_socket() {
        let above = directory();
        let path = above.path().join("deep").join("unit.sock");
        let (location, _listener) = Location::open(&path, false).unwrap();
        assert_eq!((mode(path.parent().unwrap()), mode(&path)), (0o700, 0o600));
        assert!(dial(&path).is_ok());
        location.remove();
        assert!(!path.exists());
    }

    #[test]
    fn a_directory_that_others_can_enter_is_refused() {
        let above = directory();
        let open = above.path().join("open");
        std::fs::create_dir(&open).unwrap();
        set_permissions(&open, Permissions::from_mode(0o750)).unwrap();
        assert!(matches!(Location::open(&open.join("unit.sock"), false), Err(LocationError::Open { mode: 0o750, .. })));
        assert!(matches!(sockets(&open), Err(LocationError::Open { .. })));
    }

    #[test]
    fn a_link_in_the_place_of_the_directory_is_not_followed() {
        let above = directory();
        let link = above.path().join("link");
        std::os::unix::fs::symlink(above.path(), &link).unwrap();
        assert!(matches!(Location::open(&link.join("unit.sock"), false), Err(LocationError::System { .. })));
    }

    #[test]
    fn a_file_in_the_place_of_a_directory_has_no_sockets() {
        let above = directory();
        let file = above.path().join("run");
        std::fs::write(&file, "in the way").unwrap();
        assert!(sockets(&file.join("cara")).unwrap().is_empty() && sockets(&file).unwrap().is_empty());
        let link = above.path().join("link");
        std::os::unix::fs::symlink(above.path(), &link).unwrap();
        assert!(sockets(&link).is_err());
    }

    /// Some directory of another user; there is none that root does not own in every container, so root looks on.
    #[test]
    fn a_directory_of_somebody_else_is_refused() {
        let foreign = Path::new("/proc/1");
        let owner = foreign.metadata().unwrap().uid();
        if owner == own_uid() {
            println!("skipped: the process of number 1 belongs to this user");
            return;
        }
        assert!(
            matches!(enter(foreign, EnteredBy::Owner), Err(LocationError::Foreign { owner: found, .. }) if found == owner)
        );
    }

    #[test]
    fn a_socket_without_a_process_is_replaced_and_a_live_one_is_not() {
        let above = directory();
        let path = above.path().join("unit.sock");
        let (stale, listener) = Location::open(&path, false).unwrap();
        assert!(matches!(Location::open(&path, false), Err(LocationError::InUse(_))));
        drop(listener);
        let (location, _listener) = Location::open(&path, false).unwrap();
        stale.remove();
        assert!(path.exists(), "it is another's by now");
        location.remove();
        assert!(!path.exists());
    }

    #[test]
    fn what_is_no_socket_is_left_alone() {
        let above = directory();
        let path = above.path().join("unit.sock");
        std::fs::write(&path, "precious").unwrap();
        assert!(matches!(Location::open(&path, false), Err(LocationError::NotASocket(_))));
        assert_eq!(std::fs::read(&path).unwrap(), b"precious");
        assert!(matches!(Location::open(Path::new("unit.sock"), false), Err(LocationError::NoDirectory(_))));
    }

    #[test]
    fn a_path_longer_than_a_sockets_address_serves() {
        let above = directory();
        let path = above.path().join("d".repeat(120)).join("unit.sock");
        let (location, _listener) = Location::open(&path, false).unwrap();
        assert!(dial(&path).is_ok());
        assert_eq!(sockets(path.parent().unwrap()).unwrap(), std::slice::from_ref(&path));
        location.remove();
        assert!(!path.exists());
    }
}
