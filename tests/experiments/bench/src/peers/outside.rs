//! Other systems, each in a program of its own that `cargo xtask peers` builds: which there are, which are absent, and
//! which broke.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use clap::Args;
use serde::{Deserialize, Serialize};

use crate::child::Refused;

/// Which of them take part.
#[derive(Debug, Clone, Args)]
pub(crate) struct Selection {
    /// Only these other systems instead of all that are built; `none` for none.
    #[arg(long = "peers", value_name = "PEER", value_delimiter = ',')]
    names: Vec<String>,
    /// The table of other systems.
    #[arg(long, value_name = "FILE", hide = true, default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/../peers/peers.toml"))]
    peers_file: PathBuf,
    /// Seconds that another system may take to start, or to answer for one block.
    #[arg(long, hide = true, default_value_t = 60)]
    patience_s: u64,
}

/// The table of other systems, as far as it matters here; `cargo xtask peers` reads the rest.
#[derive(Deserialize)]
struct Listed {
    peer: Vec<Entry>,
}

#[derive(Debug, Deserialize)]
struct Entry {
    name: String,
    /// What is measured, for the report.
    system: String,
    /// Prints the version, as a line of a shell.
    version: String,
    /// Program and first arguments, in the folder of the table.
    start: Vec<String>,
    /// What must be there, in the folder of the table.
    files: Vec<PathBuf>,
    /// Whether it has messages without an answer.
    one_way: bool,
    /// Whether its server listens on the end of a cable.
    #[serde(default)]
    cable: bool,
}

/// Another system.
#[derive(Debug)]
pub(crate) struct Outside {
    entry: Entry,
    folder: PathBuf,
    patience: Duration,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    broke: bool,
    notes: Vec<String>,
}

/// What the run says of one of them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct OutsideReport {
    pub(crate) peer: String,
    pub(crate) system: String,
    pub(crate) version: String,
    pub(crate) state: String,
    pub(crate) notes: Vec<String>,
}

impl Selection {
    /// Those that are built, and a report of each that is not.
    pub(crate) fn find(&self) -> Result<(Vec<Arc<Outside>>, Vec<OutsideReport>)> {
        let file = &self.peers_file;
        let text = std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
        let listed: Listed = toml::from_str(&text).with_context(|| format!("cannot read {}", file.display()))?;
        let known: Vec<&str> = listed.peer.iter().map(|entry| entry.name.as_str()).collect();
        for name in &self.names {
            ensure!(name == "none" || known.contains(&name.as_str()), "no other system is called {name}: {known:?}");
        }
        let folder = std::path::absolute(file.parent().unwrap_or(Path::new(".")))?;
        let (mut built, mut absent) = (Vec::new(), Vec::new());
        for entry in listed.peer.into_iter().filter(|entry| self.names.is_empty() || self.names.contains(&entry.name)) {
            match entry.files.iter().find(|file| !folder.join(file).exists()) {
                None => built.push(Arc::new(Outside::new(entry, &folder, Duration::from_secs(self.patience_s)))),
                Some(file) => absent.push(entry.absent(file)),
            }
        }
        Ok((built, absent))
    }
}

impl Entry {
    fn absent(&self, file: &Path) -> OutsideReport {
        let note = format!("{} is not there: `cargo xtask peers` builds it, or says what is missing", file.display());
        let (peer, system) = (self.name.clone(), self.system.clone());
        OutsideReport { peer, system, version: String::new(), state: "absent".into(), notes: vec![note] }
    }
}

impl Outside {
    fn new(entry: Entry, folder: &Path, patience: Duration) -> Self {
        Self { entry, folder: folder.to_owned(), patience, state: Mutex::default() }
    }

    pub(crate) fn name(&self) -> &str {
        &self.entry.name
    }

    /// Whether it has messages without an answer.
    pub(crate) fn is_one_way(&self) -> bool {
        self.entry.one_way
    }

    /// Whether it takes part on links of a given rate.
    pub(crate) fn has_cable(&self) -> bool {
        self.entry.cable
    }

    /// How long it may take to start, or to answer.
    pub(crate) fn patience(&self) -> Duration {
        self.patience
    }

    pub(crate) fn command(&self) -> Command {
        let mut words = self.entry.start.iter();
        let program = words.next().map_or("", String::as_str);
        let program = if program.contains('/') { self.folder.join(program) } else { program.into() };
        let mut command = Command::new(program);
        command.args(words).current_dir(&self.folder);
        command
    }

    /// What it did not do. A question that it refused leaves it in the run; anything else puts it out.
    pub(crate) fn failed(&self, error: &anyhow::Error) {
        let mut state = self.state();
        state.broke |= !error.is::<Refused>();
        let note = format!("{error:#}");
        if !state.notes.contains(&note) {
            eprintln!("{}: {note}", self.entry.name);
            state.notes.push(note);
        }
    }

    pub(crate) fn works(&self) -> bool {
        !self.state().broke
    }

    pub(crate) fn report(&self) -> OutsideReport {
        let state = self.state();
        let shell = Command::new("sh").args(["-c", &self.entry.version]).current_dir(&self.folder).output();
        let version = shell.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default();
        OutsideReport {
            peer: self.entry.name.clone(),
            system: self.entry.system.clone(),
            version,
            state: if state.broke { "broken" } else { "measured" }.into(),
            notes: state.notes.clone(),
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
