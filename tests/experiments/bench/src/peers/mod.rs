//! The systems that are measured: our own peers, which this program plays itself, and other systems in programs of
//! their own.

pub(crate) mod cara;
mod floor;
mod outside;

use std::path::PathBuf;
use std::process::Command;
use std::sync::{Arc, Mutex};

use anyhow::{Context, Result};
use cara_bench_ends::Peer;

use crate::results::Mode;

pub(crate) use outside::{Outside, OutsideReport, Selection};

/// CARA with keys; in the rows it is `cara` in secured mode.
pub(crate) const SECURED: &str = "cara_secured";

/// Those whose both ends spin; in the rows they are `cara_spinning` in either mode.
pub(crate) const SPINNING: &str = "cara_spinning";
pub(crate) const SPINNING_SECURED: &str = "cara_spinning_secured";

type Make = fn() -> Box<dyn Peer>;

/// All peers that this program plays, in the order in which they take turns. The first is the one that the others are
/// compared with.
const PEERS: [(&str, Make); 8] = [
    ("floor", || Box::new(floor::Floor)),
    ("floor_again", || Box::new(floor::Floor)),
    ("cara", || Box::new(cara::Cara::LinkEach)),
    (SECURED, || Box::new(cara::Cara::Secured)),
    (SPINNING, || Box::new(cara::Cara::Spinning { secured: false })),
    (SPINNING_SECURED, || Box::new(cara::Cara::Spinning { secured: true })),
    ("cara_one_link", || Box::new(cara::Cara::OneLink(Mutex::new(None)))),
    ("cara_among_1000_idle", || Box::new(cara::Cara::AmongIdle)),
];

/// A new instance of the peer called `name`.
pub(crate) fn named(name: &str) -> Result<Box<dyn Peer>> {
    let names = PEERS.map(|(name, _)| name);
    let found = PEERS.iter().find(|(known, _)| *known == name);
    found.map(|(_, make)| make()).with_context(|| format!("no peer is called {name}; there are {names:?}"))
}

/// One that takes its turns in an experiment.
#[derive(Debug, Clone)]
pub(crate) enum Contender {
    /// Played by this program.
    Own(&'static str),
    /// Played by this program under callgrind, which writes into this folder.
    Counted(&'static str, PathBuf),
    /// Another system.
    Outside(Arc<Outside>),
}

impl Contender {
    /// What its processes are told to play.
    pub(crate) fn name(&self) -> &str {
        match self {
            Self::Own(name) | Self::Counted(name, _) => name,
            Self::Outside(outside) => outside.name(),
        }
    }

    /// Its name as the rows say it, and how its messages are protected.
    pub(crate) fn name_and_mode(&self) -> (&str, Mode) {
        match self.name() {
            SECURED => ("cara", Mode::Secured),
            SPINNING_SECURED => (SPINNING, Mode::Secured),
            name => (name, Mode::Plain),
        }
    }

    /// The program that plays it.
    pub(crate) fn command(&self) -> Result<Command> {
        Ok(match self {
            Self::Own(_) | Self::Counted(..) => Command::new(std::env::current_exe()?),
            Self::Outside(outside) => outside.command(),
        })
    }

    /// A failure of our own ends the experiment; that of another system is written down, and the others go on.
    pub(crate) fn tolerate<T>(&self, outcome: Result<T>) -> Result<Option<T>> {
        match (self, outcome) {
            (_, Ok(value)) => Ok(Some(value)),
            (Self::Outside(outside), Err(error)) => {
                outside.failed(&error);
                Ok(None)
            }
            (_, Err(error)) => Err(error),
        }
    }

    /// Whether it can still be asked.
    pub(crate) fn works(&self) -> bool {
        match self {
            Self::Outside(outside) => outside.works(),
            _ => true,
        }
    }
}
