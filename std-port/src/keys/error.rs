//! What can be wrong with key files and with what is asked of a fleet's keys, and what to do about it.

use std::fmt;
use std::io;
use std::path::PathBuf;

use cara_core::distribution::identity::{Fleet, Identity};

use super::named::{command, full_name};

/// Why there are no keys.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyError {
    /// No ring in any of the places.
    #[error(
        "{} of fleet {} has no keys here. Looked for {}. Make them with `{}`, or copy its file from where the fleet's \
         keys are made", full_name(identity), fleet.0, list(searched), command
    )]
    Missing {
        /// Whose keys.
        identity: Identity,
        /// Its fleet.
        fleet: Fleet,
        /// The files that were looked for.
        searched: Vec<PathBuf>,
        /// The one command that makes them, as it is typed on this host.
        command: String,
    },
    /// Others than the owner can read or write the file.
    #[error(
        "others can read {} (mode {mode:o}), so its keys may be known to them: `{}`, and if they may have been read, \
         revoke the node", path.display(), command(&["chmod", "600", &path.to_string_lossy()])
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Its permissions.
        mode: u32,
    },
    /// The file belongs to another user.
    #[error(
        "{} belongs to user {owner}, and this is user {own}: `{}`", path.display(),
        command(&["sudo", "chown", &own.to_string(), &path.to_string_lossy()])
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Whose it is.
        owner: u32,
        /// Who asks.
        own: u32,
    },
    /// A folder, a pipe or a device.
    #[error("{} is no file: name the file with the keys, or the folder that it is in", .0.display())]
    NoFile(PathBuf),
    /// Not what `cara keys` writes.
    #[error(
        "{}:{line}: {what}. `cara keys derive` writes a node's file again; take a root or a list of nodes from your copy",
        path.display()
    )]
    Form {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is expected there.
        what: &'static str,
    },
    /// The keys of another node, or of another fleet.
    #[error("{} has the keys of {}, and this is {}: give it its own file", path.display(), owners.0, owners.1)]
    OtherNode {
        /// The file.
        path: PathBuf,
        /// Whose keys they are, and whose are wanted.
        owners: Box<(Owner, Owner)>,
    },
    /// There are keys of this fleet already.
    #[error(
        "{} is there already: fleet {} has its keys. Add nodes with `cara keys derive`; if its root is lost to others, \
         move the file away and make all keys anew", path.display(), fleet.0
    )]
    Exists {
        /// The root's file.
        path: PathBuf,
        /// The fleet.
        fleet: Fleet,
    },
    /// No root of this fleet in the folder.
    #[error(
        "{} has no root of fleet {}: `{}`", folder.display(), fleet.0,
        command(&["cara", "keys", "new-fleet", "--fleet", &fleet.0.to_string()])
    )]
    NoRoot {
        /// Where it was looked for.
        folder: PathBuf,
        /// The fleet.
        fleet: Fleet,
    },
    /// Another command changes the same folder.
    #[error("another `cara keys` works in {}: wait until it has ended", .0.display())]
    InUse(PathBuf),
    /// The kernel gives no random numbers.
    #[error("the system gives no random numbers: {0}")]
    NoRandomness(String),
    /// The system refuses.
    #[error("{}: {error}", path.display())]
    System {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// Whom keys belong to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Owner {
    /// The node.
    pub identity: Identity,
    /// Its fleet.
    pub fleet: Fleet,
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} in fleet {}", full_name(&self.identity), self.fleet.0)
    }
}

/// Why a fleet's keys do not change as asked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FleetError {
    /// A node that the fleet does not have.
    #[error("{} is not in the fleet: `{}` adds it", full_name(.0), command(&["cara", "keys", "derive", &full_name(.0)]))]
    Unknown(Identity),
    /// An s_unit, and no m_unit that it could belong to.
    #[error(
        "{} has no m_unit to belong to: name one with it, as in `{}`", full_name(.0),
        command(&["cara", "keys", "derive", "depot/1@m_unit", &full_name(.0)])
    )]
    NoManager(Identity),
    /// An s_unit, and several m_units that it could belong to.
    #[error("which m_unit does {node} belong to? Say {}", either(managers))]
    WhichManager {
        /// The s_unit.
        node: Identity,
        /// The fleet's m_units.
        managers: Vec<Identity>,
    },
    /// What is named as a manager is no m_unit of the fleet.
    #[error("{0} is no m_unit of the fleet, so nothing can belong to it")]
    NotAManager(Identity),
    /// An m_unit belongs to nobody.
    #[error("{0} is an m_unit, and those belong to nobody: leave --manager away")]
    MUnit(Identity),
    /// A change of keys has begun and is not finished.
    #[error(
        "a change to generation {0} is under way: `cara keys rotate --switch` and `cara keys rotate --finish` complete it"
    )]
    UnderWay(u32),
    /// No change of keys has begun.
    #[error("only generation {0} is there: `cara keys rotate` begins another")]
    NotBegun(u32),
    /// The new generation is not used yet.
    #[error("generation {0} is not used yet: when all nodes have their files, `cara keys rotate --switch`")]
    NotSwitched(u32),
    /// The new generation is used already.
    #[error("generation {0} is used already: when all nodes have their files, `cara keys rotate --finish`")]
    Switched(u32),
    /// Generations have an end.
    #[error("there are no more generations: make the fleet's keys anew with `cara keys new-fleet`")]
    Exhausted,
}

fn list(paths: &[PathBuf]) -> String {
    if paths.is_empty() {
        return "nothing, since neither CARA_KEYS nor HOME is set".into();
    }
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

fn either(identities: &[Identity]) -> String {
    let words = identities.iter().map(|identity| format!("`{}`", command(&["--manager", &identity.to_string()])));
    words.collect::<Vec<_>>().join(" or ")
}
