//! What is measured: each peer can echo a string, and take strings without an answer, between two processes.

pub(crate) mod cara;
mod floor;

use std::any::Any;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use anyhow::{Context, Result};
use clap::Args;
use serde::{Deserialize, Serialize};

use crate::clock;
use crate::print::Printer;

/// One way to exchange strings. An instance lives in one server process, one client process or one process of
/// further nodes.
pub(crate) trait Peer: Sync {
    /// Starts to serve in threads of its own.
    fn start_server(&self, place: &Place) -> Result<Server>;

    /// A caller that is ready to call; asked for once per caller, from several threads at a time. Callers that share something share
    /// it through `self`.
    fn connect(&self, place: &Place, address: &str) -> Result<Box<dyn Caller>>;

    /// One of the further nodes of distribution 2.
    fn connect_further(&self, place: &Place, address: &str, _number: u32) -> Result<Box<dyn Caller>> {
        self.connect(place, address)
    }
}

/// What tells the processes of one pair from all others, and how the server serves.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Place {
    /// Differs from that of all other pairs, of other runs as well.
    #[arg(long)]
    pub(crate) run: u32,
    /// The service prints what it gets.
    #[arg(long)]
    pub(crate) print: bool,
}

impl Place {
    fn printer(&self) -> Printer {
        Printer(self.print)
    }

    /// The port of broadcasts, so that units of other pairs do not even hear each other; below those that the kernel
    /// gives out.
    pub(crate) fn discovery_port(&self) -> u16 {
        20_000 + (self.run % 10_000) as u16
    }
}

/// A server that runs until its process ends.
pub(crate) struct Server {
    /// What the clients are told; any text without line breaks.
    pub(crate) address: String,
    /// What the one-way service counted.
    pub(crate) executed: Arc<Executed>,
    /// Changes what callers may do; `None` where there are no such limits.
    pub(crate) constrain: Option<Box<dyn Fn(Limits) -> Result<()>>>,
    /// What the server counts of its own accord, by name; a run that loses something tells it.
    pub(crate) counters: Box<dyn Fn() -> Counters>,
    /// Whatever must not be dropped.
    pub(crate) keep: Box<dyn Any>,
}

/// Counters by name.
pub(crate) type Counters = BTreeMap<String, u64>;

/// The constraints of the paper that a server can tell its callers.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Limits {
    pub(crate) minimum_interval_ms: u64,
    pub(crate) message_size: u32,
}

/// Counts of the one-way service itself.
#[derive(Debug, Default)]
pub(crate) struct Executed {
    count: AtomicU64,
    last: AtomicU64,
}

impl Executed {
    /// One more.
    pub(crate) fn note(&self) {
        self.last.store(clock::now(), Ordering::Relaxed);
        self.count.fetch_add(1, Ordering::Release);
    }

    /// How many so far, and when the last one was, on the clock of [`clock::now`].
    pub(crate) fn read(&self) -> (u64, u64) {
        (self.count.load(Ordering::Acquire), self.last.load(Ordering::Relaxed))
    }
}

/// How a one-way message travels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Delivery {
    /// In the stream.
    Reliable,
    /// In a datagram, now or never.
    BestEffort,
}

/// One who calls; used by one thread at a time.
pub(crate) trait Caller: Send {
    /// Sends `text` there and back, with a UTF-8 check and a string made at both ends; the length that came back in
    /// bytes.
    fn echo(&mut self, text: &str) -> Result<usize>;

    /// Sends `text` one way, or tells why it was refused.
    fn send(&mut self, text: &str, delivery: Delivery) -> Result<(), String>;

    /// What has been sent need wait for nothing more.
    fn flush(&mut self) {}

    /// How many of those sent were reported as not executed since this was last asked.
    fn failed(&mut self) -> u64 {
        0
    }
}

type Make = fn() -> Box<dyn Peer>;

/// All peers in the order in which they take turns. The first is the one that the others are compared with.
const PEERS: [(&str, Make); 5] = [
    ("floor", || Box::new(floor::Floor)),
    ("floor_again", || Box::new(floor::Floor)),
    ("cara", || Box::new(cara::Cara::LinkEach)),
    ("cara_one_link", || Box::new(cara::Cara::OneLink(Mutex::new(None)))),
    ("cara_among_1000_idle", || Box::new(cara::Cara::AmongIdle)),
];

/// The names of all peers.
pub(crate) fn names() -> Vec<String> {
    PEERS.iter().map(|(name, _)| name.to_string()).collect()
}

/// A new instance of the peer called `name`.
pub(crate) fn named(name: &str) -> Result<Box<dyn Peer>> {
    let found = PEERS.iter().find(|(known, _)| *known == name);
    found.map(|(_, make)| make()).with_context(|| format!("no peer is called {name}; there are {:?}", names()))
}
