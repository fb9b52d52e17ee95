//! What can be wrong with key files and with what is asked of a fleet's keys, and what to do about it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use cara_core::distribution::identity::{Fleet, Identity, Role};

use super::named::{command, full_name};

/// Why there are no keys.
#[derive(thiserror::Error)]
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
    /// The list of nodes on this host says that it was revoked.
    #[error(
        "{} of fleet {} was revoked, so that it has no keys, and what still has its old ones stays out. Leave it so, unless \
         you know what runs here: `{}` admits it on purpose, with keys that it never had", full_name(identity), fleet.0,
        command
    )]
    Revoked {
        /// Whose keys.
        identity: Identity,
        /// Its fleet.
        fleet: Fleet,
        /// The one command that admits it, as it is typed on this host.
        command: String,
    },
    /// Others than the owner can read or write the file.
    #[error(
        "others can read or write {} (mode {mode:o}), as a copy or an editor leaves it: `{}`. {}", path.display(),
        command(&["chmod", "600", &path.to_string_lossy()]), Kind::of(path).if_read()
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
        /// Its owner.
        owner: u32,
        /// The user of this process.
        own: u32,
    },
    /// A file of something else, whose owner and permissions are right as they are.
    #[error("{} is no file of `cara keys`: name the file with a node's keys, as `cara keys show` lists it", .0.display())]
    NotOurs(PathBuf),
    /// A folder, a pipe or a device.
    #[error(
        "{} is no file: name the file with the keys, or the folder that it is in; where this is in the place of one, move \
         it away", .0.display()
    )]
    NoFile(PathBuf),
    /// A folder, a pipe or a device is where a file is to be written.
    #[error("{} is no file, and nothing is written in its place: name a file, or a path where nothing is yet", .0.display())]
    InTheWay(PathBuf),
    /// The folder for the keys cannot be made.
    #[error("the folder {} cannot be made: {error}. Name another one, or make it first", path.display())]
    NoFolder {
        /// The folder.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// Not what `cara keys` writes.
    #[error("{}:{line}: {what}. {}", path.display(), Kind::of(path).if_damaged())]
    Form {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is expected there.
        what: &'static str,
    },
    /// Not as it was written: its checksum does not fit.
    #[error("{} is damaged: its checksum does not fit. {}", .0.display(), Kind::of(.0).if_damaged())]
    Damaged(PathBuf),
    /// Stopped before anything was changed.
    #[error("stopped: no file was changed")]
    Stopped,
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
        "{} is there already: fleet {} has its keys. Add nodes with `{} NODE...`; if its root is lost to others, move the \
         file away and make all keys anew", path.display(), fleet.0, keys(*fleet, &["derive"])
    )]
    Exists {
        /// The root's file.
        path: PathBuf,
        /// The fleet.
        fleet: Fleet,
    },
    /// No root of this fleet in the folder.
    #[error(
        "{} has no root of fleet {}: `{}`", folder.display(), fleet.0, new_fleet(*fleet, nodes)
    )]
    NoRoot {
        /// Where it was looked for.
        folder: PathBuf,
        /// The fleet.
        fleet: Fleet,
        /// Those of the list that is there without it, as where the root was moved away.
        nodes: Vec<Identity>,
    },
    /// The root is there, and the list of nodes is not.
    #[error(
        "{} is missing, the list of fleet {}'s nodes that belongs beside its root: take it from your copy. {}",
        path.display(), fleet.0, anew("Without one", *fleet)
    )]
    NoNodes {
        /// The list's file.
        path: PathBuf,
        /// The fleet.
        fleet: Fleet,
    },
    /// The list of nodes is written, and a node's file could not be.
    #[error(
        "{error}. The change itself is kept, and not all files are written: when that is mended, `{}` writes the rest",
        keys(*fleet, &["derive"])
    )]
    HalfWay {
        /// The fleet.
        fleet: Fleet,
        /// Why.
        error: Box<KeyError>,
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

/// The node that keys belong to.
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
#[derive(Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FleetError {
    /// A node that the fleet does not have.
    #[error("{} is not in the fleet: `{}` tells which nodes are, and which were revoked", full_name(.1), keys(*.0, &["show"]))]
    Unknown(Fleet, Identity),
    /// A node that was taken out.
    #[error(
        "{} was revoked: leave it so, unless you know what it is now; `{}` admits it on purpose, with keys that it never had",
        full_name(.1), keys(*.0, &["derive", &full_name(.1)])
    )]
    Revoked(Fleet, Identity),
    /// An s_unit, and no m_unit that it could belong to.
    #[error(
        "{} has no m_unit to belong to: name one with it, as in `{}`", full_name(.1),
        keys(*.0, &["derive", "depot/1@m_unit", &full_name(.1)])
    )]
    NoManager(Fleet, Identity),
    /// As [`NoManager`](Self::NoManager), of a fleet that is not kept anywhere yet.
    #[error(
        "{} has no m_unit to belong to: name one with it, as in `{}`", full_name(.1),
        keys(*.0, &["new-fleet", "depot/1@m_unit", &full_name(.1)])
    )]
    NoFirstManager(Fleet, Identity),
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
    /// A manager was named for an m_unit, which has none.
    #[error("{0} is an m_unit, which has no manager: leave out --manager")]
    MUnit(Identity),
    /// A change of keys has begun and is not finished.
    #[error(
        "a change to generation {} is under way: `{}` and `{}` complete it", .1, keys(*.0, &["rotate", "--switch"]),
        keys(*.0, &["rotate", "--finish"])
    )]
    UnderWay(Fleet, u32),
    /// No change of keys has begun.
    #[error("only generation {} is there: `{}` begins another", .1, keys(*.0, &["rotate"]))]
    NotStarted(Fleet, u32),
    /// The new generation is not used yet.
    #[error("generation {} is not used yet: when all nodes have their files, `{}`", .1, keys(*.0, &["rotate", "--switch"]))]
    NotSwitched(Fleet, u32),
    /// The new generation is used already.
    #[error("generation {} is used already: when all nodes have their files, `{}`", .1, keys(*.0, &["rotate", "--finish"]))]
    Switched(Fleet, u32),
    /// A step was interrupted, and another one is asked for.
    #[error(
        "not all files are of the step that was made last, and two steps at once lock nodes out: `{}` writes the rest. Bring \
         them to their nodes before the next step", keys(*.0, &["derive"])
    )]
    Behind(Fleet),
    /// Generations have an end.
    #[error("there are no more generations: make new keys for the fleet with `{} NODE...`", keys(*.0, &["new-fleet"]))]
    Exhausted(Fleet),
}

impl KeyError {
    /// The same of a file that is none of `cara keys`: nothing about it is to be changed.
    pub(super) fn of_another_file(self) -> Self {
        match self {
            Self::Open { path, .. } | Self::Foreign { path, .. } => Self::NotOurs(path),
            other => other,
        }
    }
}

impl FleetError {
    /// The same of a fleet that is only being made, to which no command can add yet.
    #[must_use]
    pub fn of_new_fleet(self) -> Self {
        match self {
            Self::NoManager(fleet, node) => Self::NoFirstManager(fleet, node),
            other => other,
        }
    }
}

/// What a file is for, as its name tells.
enum Kind {
    Root(Fleet),
    Nodes(Fleet),
    /// Of a node, and perhaps renamed.
    Ring(Option<Fleet>),
}

impl Kind {
    fn of(path: &Path) -> Self {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let fleet = |number: &str| number.parse().ok().map(Fleet);
        let numbered = |end| name.strip_prefix("fleet-")?.strip_suffix(end).and_then(fleet);
        match (numbered(".root"), numbered(".nodes")) {
            (Some(fleet), _) => Self::Root(fleet),
            (_, Some(fleet)) => Self::Nodes(fleet),
            _ => Self::Ring(name.strip_suffix(".keys").and_then(|name| fleet(name.rsplit_once('-')?.1))),
        }
    }

    /// What to do where others may have read it.
    fn if_read(&self) -> String {
        match self {
            Self::Root(fleet) => {
                let anew = anew("If it may have been read", *fleet);
                format!("Anyone who has read this root can speak as every node, and no revocation ends that. {anew}")
            }
            Self::Nodes(_) => "There is no key in it; if it may have been changed, take it from your copy".into(),
            Self::Ring(fleet) => {
                format!("If its keys may have been read, revoke the node: `{} NODE`", keys_of(*fleet, &["revoke"]))
            }
        }
    }

    /// What to do where it is not what `cara keys` wrote.
    fn if_damaged(&self) -> String {
        match self {
            Self::Root(fleet) | Self::Nodes(fleet) => {
                format!("Take this file from your copy. {}", anew("Without one", *fleet))
            }
            Self::Ring(fleet) => format!(
                "If this is a node's file, `{}` where the fleet's root is writes it again",
                keys_of(*fleet, &["derive"])
            ),
        }
    }
}

/// How a file without a checksum gets one.
pub(super) fn renewal(path: &Path) -> String {
    let (fleet, behind) = match Kind::of(path) {
        Kind::Root(fleet) | Kind::Nodes(fleet) => (Some(fleet), ""),
        Kind::Ring(fleet) => (fleet, " where the fleet's root is; bring it to its node then"),
    };
    format!("no damage to it would be found: `{}` writes it with a checksum{behind}", keys_of(fleet, &["derive"]))
}

/// When and how a fleet gets another root.
fn anew(when: &str, fleet: Fleet) -> String {
    format!(
        "{when}, the fleet needs a new root: move fleet-{}.root away, run `{} NODE...` with all nodes, and bring each its file",
        fleet.0,
        keys(fleet, &["new-fleet"])
    )
}

/// The command that makes a fleet of these nodes, m_units first.
fn new_fleet(fleet: Fleet, nodes: &[Identity]) -> String {
    let mut names: Vec<_> = nodes.iter().map(|node| (node.role() != Role::MUnit, full_name(node))).collect();
    names.sort();
    let names = names.iter().map(|(_, name)| name.as_str());
    keys(fleet, &["new-fleet"].into_iter().chain(names).collect::<Vec<_>>())
}

/// A command for a fleet's keys.
fn keys(fleet: Fleet, words: &[&str]) -> String {
    keys_of(Some(fleet), words)
}

fn keys_of(fleet: Option<Fleet>, words: &[&str]) -> String {
    let number = fleet.map(|fleet| fleet.0.to_string());
    let (action, values) = words.split_at(words.len().min(1));
    let option = number.iter().flat_map(|number| ["--fleet", number]);
    let all: Vec<_> = ["cara", "keys"].into_iter().chain(action.iter().copied()).chain(option).collect();
    command(&[&all, values].concat())
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

#[cfg(test)]
mod tests {
    use super::*;

    fn open(path: &str) -> String {
        KeyError::Open { path: path.into(), mode: 0o644 }.to_string()
    }

    fn form(path: &str) -> String {
        KeyError::Form { path: path.into(), line: 1, what: "this is no text" }.to_string()
    }

    #[test]
    fn advice_is_for_the_file_that_it_is_about() {
        let all = [open, form]
            .map(|error| ["k/fleet-7.root", "k/fleet-7.nodes", "k/agv-1-s_unit-8.keys", "k/renamed"].map(error));
        let [[root, nodes, ring, renamed], [no_root, no_nodes, no_ring, no_renamed]] = all;
        for text in [&root, &no_root, &no_nodes] {
            assert!(text.contains("`cara keys new-fleet --fleet 7 NODE...`") && !text.contains("revoke the"), "{text}");
        }
        assert!(nodes.contains("no key in it"), "{nodes}");
        assert!(ring.contains("`cara keys revoke --fleet 8 NODE`"), "{ring}");
        assert!(renamed.contains("`cara keys revoke NODE`"), "{renamed}");
        assert!(no_ring.contains("`cara keys derive --fleet 8`"), "{no_ring}");
        assert!(no_renamed.contains("`cara keys derive`"), "{no_renamed}");
    }

    #[test]
    fn every_command_names_the_fleet() {
        let (fleet, node) = (Fleet(7), Identity::s_unit("agv 1", 1).unwrap());
        let errors = [
            FleetError::Unknown(fleet, node.clone()),
            FleetError::Revoked(fleet, node.clone()),
            FleetError::NoManager(fleet, node.clone()),
            FleetError::NoManager(fleet, node).of_new_fleet(),
            FleetError::UnderWay(fleet, 2),
            FleetError::NotStarted(fleet, 1),
            FleetError::NotSwitched(fleet, 2),
            FleetError::Switched(fleet, 2),
            FleetError::Behind(fleet),
            FleetError::Exhausted(fleet),
        ];
        for text in errors.map(|error| error.to_string()) {
            let commands: Vec<_> = text.split("`cara keys ").skip(1).collect();
            assert!(!commands.is_empty() && commands.iter().all(|one| one.contains("--fleet 7")), "{text}");
        }
    }

    #[test]
    fn a_file_without_a_checksum_is_told_how_to_get_one() {
        let of = |path: &str| renewal(Path::new(path));
        assert!(
            of("k/agv-1-s_unit-8.keys").contains("`cara keys derive --fleet 8` writes it with a checksum where the")
        );
        assert!(of("k/fleet-7.root").ends_with("`cara keys derive --fleet 7` writes it with a checksum"));
    }
}
