//! The child processes as the one that measures sees them.

use std::iter::once;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use cara_processes::Process;
use cara_test_keys::KeyFolder;
use serde::de::DeserializeOwned;

use crate::child::{Counters, Question, Ready};
use crate::units::{MANAGER, name};

/// Longest wait for an answer; the longest question waits a minute itself.
const PATIENCE: Duration = Duration::from_secs(180);

/// A running child.
pub(crate) struct Child {
    process: Process,
    pub(crate) pid: u32,
    /// When its process was started.
    pub(crate) started: Instant,
}

/// Which fleet, with which keys, and on which port its units look for each other.
pub(crate) struct Place {
    fleet: u32,
    port: u16,
    keys: KeyFolder,
}

impl Place {
    /// One of its own, so that several runs on one machine do not meet, for a manager and so many s_units.
    pub(crate) fn new(count: u32) -> Result<Self> {
        let fleet = cara_processes::random_fleet();
        let s_units = (1..=count).map(|id| format!("{}/{id}", name(id)));
        let nodes: Vec<_> = once(format!("{}/{}@m_unit", MANAGER.0, MANAGER.1)).chain(s_units).collect();
        let keys = KeyFolder::draw(fleet, &nodes.iter().map(String::as_str).collect::<Vec<_>>())?;
        // Below the ports that the kernel gives out.
        Ok(Self { fleet, port: 20_000 + (fleet % 10_000) as u16, keys })
    }
}

impl Place {
    /// Keys for further m_units.
    pub(crate) fn add_m_units(&self, m_units: &[(&str, u32)]) -> Result<()> {
        let nodes: Vec<_> = m_units.iter().map(|(name, id)| format!("{name}/{id}@m_unit")).collect();
        self.keys.add(&nodes.iter().map(String::as_str).collect::<Vec<_>>())
    }
}

impl Child {
    pub(crate) fn manager(place: &Place, nodes: u16) -> Result<Self> {
        Self::start("manager", place, &["--nodes", &nodes.to_string()])
    }

    /// S_units with ID numbers from `first` on.
    pub(crate) fn units(place: &Place, first: u32, count: u32) -> Result<Self> {
        Self::start("units", place, &["--first", &first.to_string(), "--count", &count.to_string()])
    }

    /// One end of so many raw connections: `floor-server` first, then `floor-client`.
    pub(crate) fn floor(role: &str, place: &Place, count: u16) -> Result<Self> {
        Self::start(role, place, &["--count", &count.to_string()])
    }

    /// A process of this role.
    pub(crate) fn start(role: &str, place: &Place, more: &[&str]) -> Result<Self> {
        let (fleet, port) = (place.fleet.to_string(), place.port.to_string());
        let (keys, program) = (format!("CARA_KEYS={}", place.keys.path().display()), std::env::current_exe()?);
        let program = program.to_str().context("this program's path is no text")?;
        let arguments = [keys.as_str(), program, role, "--fleet", &fleet, "--port", &port];
        let started = Instant::now();
        let mut process = Process::start(role, Path::new("env"), arguments.iter().chain(more))?;
        let ready = process.expect("pid", PATIENCE)?;
        let Ready { pid } = serde_json::from_str(&ready.text)?;
        Ok(Self { process, pid, started })
    }

    /// Asks and waits for the answer.
    pub(crate) fn ask<A: DeserializeOwned>(&mut self, question: &Question) -> Result<A> {
        self.ask_when(question).map(|(answer, _)| answer)
    }

    /// Also tells when the answer came.
    pub(crate) fn ask_when<A: DeserializeOwned>(&mut self, question: &Question) -> Result<(A, Instant)> {
        self.process.send(&serde_json::to_string(question)?)?;
        let line = self.process.expect("{\"", PATIENCE)?;
        let answer: Result<A, String> = serde_json::from_str(&line.text)?;
        Ok((answer.map_err(|error| anyhow!("{}: {error}", self.process.name()))?, line.at))
    }

    pub(crate) fn counters(&mut self) -> Result<Counters> {
        self.ask(&Question::Counters)
    }

    /// Ends it as a loss of power would; when.
    pub(crate) fn kill(mut self) -> Result<Instant> {
        self.process.kill()
    }
}

/// What the units of these processes have counted, in all.
pub(crate) fn counters<'c>(children: impl IntoIterator<Item = &'c mut Child>) -> Result<Counters> {
    let mut sum = Counters::new();
    for child in children {
        for (name, count) in child.counters()? {
            *sum.entry(name).or_default() += count;
        }
    }
    Ok(sum)
}

/// The sum of some of them.
pub(crate) fn sum(counters: &Counters, names: &[&str]) -> Result<u64> {
    names.iter().map(|name| counters.get(*name).copied().with_context(|| format!("no counter {name}"))).sum()
}

/// Broadcasts that the units of these processes have sent: questions of all, and the managers' answers to all.
pub(crate) fn broadcasts<'c>(children: impl IntoIterator<Item = &'c mut Child>) -> Result<u64> {
    sum(&counters(children)?, &["WhoHasSent", "AnnounceBroadcast"])
}
