//! The keys of a fleet of boards, drawn for each run, and the settings of boards with them: made with the commands that
//! a user types.

use std::ffi::OsStr;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::rc::Rc;

use anyhow::{Context, Result, ensure};
use cara_processes::Process;
use cara_std::keys::location;
use cara_std::{Builder, Fleet, Identity, MUnit};
use tempfile::TempDir;

use crate::board::{FLEET, Who};
use crate::signals::remove_at_end;

/// The manager of all boards by default.
pub(crate) const MANAGER: &str = "depot/1";

/// The one that a board can be handed over to, where it has keys with two.
pub(crate) const OTHER: &str = "yard/2";

/// Keys of a manager and its boards.
pub(crate) struct Keys {
    cara: PathBuf,
    /// The keys, and what boards have been told. It goes when this does.
    folder: TempDir,
    kind: Kind,
    /// Boards have keys with [`OTHER`] as well.
    has_other: bool,
}

/// Bytes of a vehicle's name by which files are told apart: the image has room for 128 bytes of a path.
const SHOWN: usize = 16;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Drawn,
    /// All units opt in to plain mode.
    Insecure,
    /// Boards get settings and no keys.
    Missing,
}

impl Keys {
    /// Draws keys for a manager and its vehicles, each as NAME/ID. They match no others.
    pub(crate) fn draw(cara: Option<&Path>, fleet: u32, manager: &str, vehicles: &[&str]) -> Result<Rc<Self>> {
        Self::new(cara, Kind::Drawn)?.drawn(fleet, &[manager], vehicles)
    }

    /// The same of a board that can be handed over to [`OTHER`].
    pub(crate) fn of_two_managers(cara: Option<&Path>) -> Result<Rc<Self>> {
        let keys = Self { has_other: true, ..Self::new(cara, Kind::Drawn)? };
        keys.drawn(FLEET, &[MANAGER, OTHER], &["agv-17/17"])
    }

    fn drawn(self, fleet: u32, managers: &[&str], vehicles: &[&str]) -> Result<Rc<Self>> {
        let (fleet, managers) = (
            fleet.to_string(),
            managers.iter().flat_map(|manager| [format!("{manager}@m_unit"), format!("--manager={manager}")]),
        );
        let words = ["keys", "new-fleet", "--fleet", &fleet].map(str::to_owned).into_iter().chain(managers);
        self.run(words.chain(vehicles.iter().map(|vehicle| (*vehicle).to_owned())))?;
        Ok(Rc::new(self))
    }

    /// Keys of the boards that are tested.
    pub(crate) fn of_boards(cara: Option<&Path>) -> Result<Rc<Self>> {
        Self::draw(cara, FLEET, MANAGER, &["agv-17/17", "agv-18/18"])
    }

    /// No keys, but plain mode, asked for in words.
    pub(crate) fn insecure(cara: Option<&Path>) -> Result<Rc<Self>> {
        Self::new(cara, Kind::Insecure).map(Rc::new)
    }

    /// Other keys of the same boards.
    pub(crate) fn others(&self) -> Result<Rc<Self>> {
        Self::of_boards(Some(&self.cara))
    }

    /// Boards with settings and without keys.
    pub(crate) fn none(&self) -> Result<Rc<Self>> {
        Self::new(Some(&self.cara), Kind::Missing).map(Rc::new)
    }

    /// Boards in plain mode beside these.
    pub(crate) fn plain(&self) -> Result<Rc<Self>> {
        Self::insecure(Some(&self.cara))
    }

    fn new(cara: Option<&Path>, kind: Kind) -> Result<Self> {
        let beside = || Ok::<_, anyhow::Error>(std::env::current_exe()?.with_file_name("cara"));
        let cara = cara.map_or_else(beside, |cara| Ok(cara.to_owned()))?;
        ensure!(cara.is_file(), "{} is not there: cargo build --package cara-cli", cara.display());
        // Control sockets are not made where others could enter, and keys should not be.
        let owner_only = Permissions::from_mode(0o700);
        let folder = tempfile::Builder::new().prefix("boards").permissions(owner_only).tempdir();
        let folder = folder.context("cannot make a folder for keys")?;
        remove_at_end(folder.path());
        Ok(Self { cara, folder, kind, has_other: false })
    }

    /// The command, which finds these keys, and control sockets of this run only.
    pub(crate) fn command(&self) -> Command {
        let mut command = Command::new(&self.cara);
        command.env("CARA_KEYS", self.folder.path()).env("CARA_CONTROL_DIR", self.folder.path());
        command.stdin(Stdio::null());
        command
    }

    /// The command as a process that goes on.
    pub(crate) fn process(&self, name: &str, words: &[&str]) -> Result<Process> {
        let folder = self.folder.path().display();
        let settings = ["CARA_KEYS", "CARA_CONTROL_DIR"].map(|variable| format!("{variable}={folder}"));
        let command = settings.into_iter().chain([self.cara.display().to_string()]);
        Process::start(name, Path::new("env"), command.chain(words.iter().map(|word| (*word).to_owned())))
    }

    /// Words without which the command would look for keys.
    pub(crate) fn words(&self) -> &'static [&'static str] {
        if self.kind == Kind::Insecure { &["--insecure"] } else { &[] }
    }

    /// The manager's keys; none in plain mode.
    pub(crate) fn manager_file(&self) -> Option<PathBuf> {
        let (name, id) = MANAGER.split_once('/')?;
        let manager = Identity::m_unit(name, id.parse().ok()?).ok()?;
        (self.kind == Kind::Drawn).then(|| self.file_of(&manager, FLEET))
    }

    /// The keys of [`OTHER`].
    pub(crate) fn other_file(&self) -> Result<PathBuf> {
        let (name, id) = OTHER.split_once('/').context("NAME/ID")?;
        Ok(self.file_of(&Identity::m_unit(name, id.parse()?)?, FLEET))
    }

    /// Where they are.
    pub(crate) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Gives a manager its keys.
    pub(crate) fn give(&self, builder: Builder<(), MUnit>) -> Result<Builder<(), MUnit>> {
        match (self.kind, self.manager_file()) {
            (Kind::Insecure, _) => Ok(builder.insecure()),
            (_, file) => Ok(builder.key_file(file.context("there are no keys for a manager")?)),
        }
    }

    fn file_of(&self, identity: &Identity, fleet: u32) -> PathBuf {
        self.folder.path().join(location::file_name(identity, Fleet(fleet)))
    }

    /// The file with what a board is told, and the one in which it counts its lives or, of a chip with flash, all of that. A board
    /// that has been told before is not told again.
    pub(crate) fn reported(&self, board: &str, who: &Who, address: &str) -> Result<(PathBuf, PathBuf)> {
        let Who { name, id, manager, fleet, manager_address, .. } = who;
        // The image and QEMU split what they are told at blanks and commas, which a name may have.
        let plain: String = name.bytes().map(|byte| format!("{byte:02x}")).take(SHOWN).collect();
        let mut stem = format!("{plain}-{id}-{}", address.replace(['.', '/'], "-"));
        stem.extend(manager_address.iter().map(|_| "-directly"));
        let [reported, boots] = ["told", "boots"].map(|end| self.folder.path().join(format!("{stem}.{end}")));
        if reported.exists() {
            return Ok((reported, boots));
        }
        let keys = self.file_of(&Identity::s_unit(name, *id)?, *fleet);
        let (id, fleet) = (id.to_string(), fleet.to_string());
        let mut words: Vec<&OsStr> = ["provision", board, "--name", name, "--id", &id, "--manager", manager]
            .into_iter()
            .chain(self.has_other.then_some(["--manager", OTHER]).into_iter().flatten())
            .chain(["--fleet", &fleet, "--address", address])
            .chain(manager_address.iter().flat_map(|address| ["--manager-address", address]))
            .chain(self.words().iter().copied())
            .map(OsStr::new)
            .collect();
        words.extend(["--output".as_ref(), reported.as_os_str()]);
        if self.kind == Kind::Drawn {
            words.extend(["--keys".as_ref(), keys.as_os_str()]);
        }
        if board == "rp2040" {
            words.push("--uf2".as_ref());
            self.run(words)?;
            return Ok((reported, boots));
        }
        self.run(words)?;
        // As the file is left when the power goes while the board makes it.
        std::fs::write(&boots, [0xFF; 100])?;
        Ok((reported, boots))
    }

    fn run<A: AsRef<OsStr>>(&self, words: impl IntoIterator<Item = A>) -> Result<()> {
        let output = self.command().args(words).output().context("cannot start cara")?;
        let said = String::from_utf8_lossy(&output.stderr);
        ensure!(output.status.success(), "cara: {said}");
        Ok(())
    }
}
