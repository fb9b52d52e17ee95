//! Units of this host whose control sockets are in other directories, such as another user's.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::location;

/// The system's list of local sockets, which every user may read.
const SOCKETS: &str = "/proc/net/unix";
/// In its column of flags: the socket takes connections.
const LISTENS: u32 = 1 << 16;

/// A unit that runs on this host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Elsewhere {
    /// `NAME/ID`, as the name of its socket has it.
    pub unit: String,
    /// Its fleet.
    pub fleet: u32,
    /// Its control socket.
    pub path: PathBuf,
    /// The user whose directory that is, where it can be seen.
    pub owner: Option<u32>,
}

/// The units of this host in directories where this command does not [look](super::directories), as far as the names of their
/// control sockets tell. Where `CARA_CONTROL_DIR` is set, those of this user are meant to be apart, and left out.
pub fn elsewhere() -> Vec<Elsewhere> {
    let own = super::directories();
    let listed = std::fs::read_to_string(SOCKETS).unwrap_or_default();
    let is_own = |path: &Path| own.iter().any(|own| path.parent() == Some(own));
    let paths = listening(&listed).filter(|path| !is_own(path) && location::reports_name(path));
    let this_user = rustix::process::getuid().as_raw();
    let all_users = !location::is_directory_set();
    paths.map(unit).filter(|unit| all_users || unit.owner != Some(this_user)).collect()
}

/// The directories of what listens and is named as a control socket.
pub(super) fn listening_in() -> Vec<PathBuf> {
    let listed = std::fs::read_to_string(SOCKETS).unwrap_or_default();
    let paths = listening(&listed).filter(|path| location::reports_name(path));
    paths.filter_map(Path::parent).map(Path::to_owned).collect()
}

fn listening(listed: &str) -> impl Iterator<Item = &Path> {
    listed.lines().skip(1).filter_map(|line| {
        let mut words = line.split_whitespace();
        let flags = u32::from_str_radix(words.nth(3)?, 16).ok()?;
        // A path may have blanks.
        let path = line.find(" /").and_then(|at| line.get(at + 1..))?;
        (flags & LISTENS != 0).then_some(Path::new(path))
    })
}

fn unit(path: &Path) -> Elsewhere {
    let (unit, fleet) = location::reported_by_name(path);
    // The first that this user can see, from the socket upwards: a directory of the user's stands above it.
    let owner = path.ancestors().find_map(|above| std::fs::symlink_metadata(above).ok()).map(|seen| seen.uid());
    Elsewhere { unit, fleet, path: path.to_owned(), owner }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sockets_that_take_connections_are_found_with_their_paths() {
        let listed = "Num       RefCount Protocol Flags    Type St Inode Path\n\
                      000: 00000002 00000000 00010000 0001 01 21 /run/user/1000/cara/depot-1-7.sock\n\
                      000: 00000003 00000000 00000000 0001 03 22 /run/user/1000/cara/depot-1-7.sock\n\
                      000: 00000003 00000000 00000000 0001 03 23\n\
                      000: 00000002 00000000 00010000 0001 01 24 /srv/with blank/x.sock\n";
        let found: Vec<_> = listening(listed).map(|path| path.to_str().unwrap()).collect();
        assert_eq!(found, ["/run/user/1000/cara/depot-1-7.sock", "/srv/with blank/x.sock"]);
        let reported = unit(Path::new(found[0]));
        assert_eq!((reported.unit.as_str(), reported.fleet), ("depot/1", 7));
    }
}
