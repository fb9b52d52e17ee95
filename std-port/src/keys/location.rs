//! Where a node's keys are looked for:
//!
//! 1. if `CARA_KEYS` is set: that file, or the node's file in that folder, and nowhere else;
//! 2. `cara/keys` in `$XDG_CONFIG_HOME`, or else in `~/.config`;
//! 3. `/etc/cara/keys`.
//!
//! A node's file is called after it and its fleet: [`file_name`].

use std::env;
use std::path::{Path, PathBuf};

use cara_core::distribution::identity::{Fleet, Identity, Role};

use super::named::{command, full_name};
use super::{KeyError, store};
use crate::file_name::escape;

/// Names a file with keys, or the folder that it is in.
pub const VARIABLE: &str = "CARA_KEYS";
/// The folder of keys that belongs to the host.
const OF_HOST: &str = "/etc/cara/keys";

/// The file name of a node's keys: `agv-17-17-s_unit-7.keys` of `agv-17/17` in fleet 7.
///
/// ```
/// use cara_std::keys::location::file_name;
/// use cara_std::{Fleet, Identity};
///
/// assert_eq!(file_name(&Identity::m_unit("Depot A", 1)?, Fleet(7)), "Depot%20A-1-m_unit-7.keys");
/// # Ok::<(), cara_std::Error>(())
/// ```
pub fn file_name(identity: &Identity, fleet: Fleet) -> String {
    let role = identity.role().as_str();
    format!("{}-{}-{role}-{}.keys", escape(identity.name()), identity.id(), fleet.0)
}

/// Where a node's keys are, by the rules of this module. The file may still be refused when it is read.
pub fn find(identity: &Identity, fleet: Fleet) -> Result<PathBuf, KeyError> {
    Environment::of_process().find(identity, None, fleet)
}

/// As [`find`], for an s_unit that joins `manager`: where there are no keys, the error's command makes those of both.
pub(crate) fn find_joining(identity: &Identity, manager: &Identity, fleet: Fleet) -> Result<PathBuf, KeyError> {
    Environment::of_process().find(identity, Some(manager), fleet)
}

/// The user's own folder of keys, in which `cara keys` works unless told: what `CARA_KEYS` names if that is no file, or
/// `cara/keys` in `$XDG_CONFIG_HOME` or `~/.config`. `None` where none of these is set.
pub fn own_folder() -> Option<PathBuf> {
    Environment::of_process().own_folder()
}

/// The folders in which keys are looked for.
pub(crate) fn folders() -> Vec<PathBuf> {
    let mut folders = Environment::of_process().folders();
    folders.retain(|folder| folder.is_dir());
    folders
}

/// The key files in those folders, of all owners, by name; or the one that `CARA_KEYS` names.
pub(crate) fn rings() -> Vec<PathBuf> {
    if let Some(file) = Environment::of_process().file() {
        return vec![file.to_owned()];
    }
    let entries = folders().into_iter().filter_map(|folder| folder.read_dir().ok()).flatten().flatten();
    let mut files: Vec<_> = entries.map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "keys"));
    files.sort();
    files
}

/// What the environment says about places.
struct Environment {
    named: Option<PathBuf>,
    configuration: Option<PathBuf>,
    home: Option<PathBuf>,
    host: PathBuf,
}

impl Environment {
    fn of_process() -> Self {
        let set = |name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        Self {
            named: set(VARIABLE),
            configuration: set("XDG_CONFIG_HOME"),
            home: set("HOME"),
            host: PathBuf::from(OF_HOST),
        }
    }

    fn of_user(&self) -> Option<PathBuf> {
        let configuration = self.configuration.clone();
        let configuration = configuration.or_else(|| self.home.as_ref().map(|home| home.join(".config")))?;
        Some(configuration.join("cara").join("keys"))
    }

    fn folders(&self) -> Vec<PathBuf> {
        match &self.named {
            Some(named) => vec![named.clone()],
            None => self.of_user().into_iter().chain([self.host.clone()]).collect(),
        }
    }

    /// The file that is named, and stands for all places.
    fn file(&self) -> Option<&Path> {
        self.named.as_deref().filter(|named| named.exists() && !named.is_dir())
    }

    fn own_folder(&self) -> Option<PathBuf> {
        self.named.clone().filter(|named| !named.is_file()).or_else(|| self.of_user())
    }

    fn find(&self, identity: &Identity, manager: Option<&Identity>, fleet: Fleet) -> Result<PathBuf, KeyError> {
        if let Some(file) = self.file() {
            return Ok(file.to_owned());
        }
        let searched: Vec<_> = self.folders().iter().map(|folder| folder.join(file_name(identity, fleet))).collect();
        // A folder that this user may not enter has nothing for it.
        if let Some(found) = searched.iter().find(|file| file.exists()) {
            return Ok(found.clone());
        }
        let (identity, command) = (identity.clone(), self.command(identity, manager, fleet));
        if self.folders().iter().any(|folder| store::is_revoked(folder, &identity, fleet)) {
            return Err(KeyError::Revoked { identity, fleet, command });
        }
        Err(KeyError::Missing { identity, fleet, searched, command })
    }

    /// The one command that makes a node's keys, typed where the node was started.
    fn command(&self, identity: &Identity, manager: Option<&Identity>, fleet: Fleet) -> String {
        let own = self.own_folder();
        let has_root = |folder: &&PathBuf| store::root_file(folder, fleet).exists();
        let folders = self.folders();
        let root = folders.iter().find(has_root);
        let folder = root.or(own.as_ref()).unwrap_or(&self.host);
        let mut words = vec!["cara".to_owned(), "keys".into()];
        words.push(if root.is_some() { "derive" } else { "new-fleet" }.into());
        words.extend(["--fleet".into(), fleet.0.to_string()]);
        if Some(folder) != own.as_ref() {
            words.extend(["--dir".into(), folder.to_string_lossy().into_owned()]);
        }
        words.extend(self.nodes(identity, manager, fleet, root));
        command(&words.iter().map(String::as_str).collect::<Vec<_>>())
    }

    /// The nodes of that command: an s_unit needs a manager that is in the fleet.
    fn nodes(
        &self,
        identity: &Identity,
        manager: Option<&Identity>,
        fleet: Fleet,
        root: Option<&PathBuf>,
    ) -> Vec<String> {
        let own = full_name(identity);
        let Some(root) = root else {
            let example = (identity.role() == Role::SUnit).then(|| "depot/1@m_unit".to_owned());
            return manager.map(full_name).or(example).into_iter().chain([own]).collect();
        };
        let Some(manager) = manager else { return vec![own] };
        let unknown = (!root.join(file_name(manager, fleet)).exists()).then(|| full_name(manager));
        ["--manager".into(), manager.to_string()].into_iter().chain(unknown).chain([own]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn depot() -> Identity {
        Identity::m_unit("depot", 1).unwrap()
    }

    struct Host {
        folder: tempfile::TempDir,
        environment: Environment,
    }

    /// A host on which nothing is set but where home is.
    fn host() -> Host {
        let folder = tempfile::tempdir().unwrap();
        let home = Some(folder.path().join("home"));
        let host = folder.path().join("etc");
        Host { environment: Environment { named: None, configuration: None, home, host }, folder }
    }

    impl Host {
        fn write(&self, folder: &str) -> PathBuf {
            let folder = self.folder.path().join(folder);
            fs::create_dir_all(&folder).unwrap();
            let path = folder.join(file_name(&depot(), Fleet(7)));
            fs::write(&path, "").unwrap();
            path
        }

        fn find(&self) -> Result<PathBuf, KeyError> {
            self.environment.find(&depot(), None, Fleet(7))
        }

        fn missing(&self) -> String {
            self.find().unwrap_err().to_string()
        }
    }

    #[test]
    fn the_order_is_as_written() {
        let mut host = host();
        let of_host = host.write("etc");
        assert_eq!(host.find().unwrap(), of_host);
        let of_home = host.write("home/.config/cara/keys");
        assert_eq!(host.find().unwrap(), of_home);
        host.environment.configuration = Some(host.folder.path().join("config"));
        assert_eq!(host.find().unwrap(), of_host, "the configuration stands for ~/.config");
        let configured = host.write("config/cara/keys");
        assert_eq!(host.find().unwrap(), configured);
        host.environment.named = Some(host.folder.path().join("named"));
        assert!(host.find().is_err(), "what is named is the only place");
        let named = host.write("named");
        assert_eq!(host.find().unwrap(), named);
        host.environment.named = Some(of_home.clone());
        assert_eq!(host.find().unwrap(), of_home);
    }

    #[test]
    fn what_is_missing_is_told_with_one_command() {
        let mut host = host();
        let text = host.missing();
        let places = ["home/.config/cara/keys/depot-1-m_unit-7.keys", "etc/depot-1-m_unit-7.keys"];
        places.iter().for_each(|location| assert!(text.contains(location), "{text}"));
        assert!(text.contains("`cara keys new-fleet --fleet 7 depot/1@m_unit`"), "{text}");
        let root = host.folder.path().join("home/.config/cara/keys");
        fs::create_dir_all(&root).unwrap();
        fs::write(store::root_file(&root, Fleet(7)), "").unwrap();
        assert!(host.missing().contains("`cara keys derive --fleet 7 depot/1@m_unit`"), "{}", host.missing());
        let agv = Identity::s_unit("agv 1", 1).unwrap();
        let of_agv = |host: &Host, manager: Option<&Identity>| {
            host.environment
                .find(&agv, manager, Fleet(7))
                .unwrap_err()
                .to_string()
                .split('`')
                .nth(1)
                .unwrap()
                .to_owned()
        };
        assert_eq!(of_agv(&host, None), "cara keys derive --fleet 7 'agv 1/1'");
        let derive = "cara keys derive --fleet 7 --manager depot/1";
        assert_eq!(of_agv(&host, Some(&depot())), format!("{derive} depot/1@m_unit 'agv 1/1'"));
        host.write("home/.config/cara/keys");
        assert_eq!(of_agv(&host, Some(&depot())), format!("{derive} 'agv 1/1'"));
        host.environment.home = None;
        let folder = host.environment.host.display().to_string();
        let made = format!("cara keys new-fleet --fleet 7 --dir {folder} depot/1@m_unit 'agv 1/1'");
        assert_eq!(of_agv(&host, None), made, "where no folder is the user's own");
        host.environment.named = Some(host.folder.path().join("named"));
        let yard = Identity::m_unit("yard", 2).unwrap();
        assert_eq!(of_agv(&host, Some(&yard)), "cara keys new-fleet --fleet 7 yard/2@m_unit 'agv 1/1'");
    }

    #[test]
    fn no_two_nodes_share_a_file() {
        let names = [
            file_name(&depot(), Fleet(7)),
            file_name(&Identity::s_unit("depot", 1).unwrap(), Fleet(7)),
            file_name(&Identity::m_unit("depot-1", 1).unwrap(), Fleet(7)),
            file_name(&Identity::m_unit("depot", 11).unwrap(), Fleet(7)),
            file_name(&depot(), Fleet(17)),
            file_name(&Identity::m_unit("../depot", 1).unwrap(), Fleet(7)),
        ];
        assert_eq!(names.iter().collect::<std::collections::BTreeSet<_>>().len(), names.len());
        assert!(names.iter().all(|name| !name.contains('/') && !name.starts_with('.')));
    }
}
