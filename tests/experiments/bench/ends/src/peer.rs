//! What is measured: each peer can echo a string, and take strings without an answer, between two processes.

use std::any::Any;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Result;
use clap::Args;
use serde::{Deserialize, Serialize};

use crate::clock;
use crate::print::Printer;

/// One way to exchange strings. An instance lives in one server process, one client process or one process of
/// further nodes.
pub trait Peer: Sync {
    /// Starts to serve in threads of its own.
    fn start_server(&self, place: &Place) -> Result<Server>;

    /// A caller that is ready to call; asked for once per caller, from several threads at a time. Callers that share
    /// something share it through `self`.
    fn connect(&self, place: &Place, address: &str) -> Result<Box<dyn Caller>>;

    /// One of the further nodes of distribution 2.
    fn connect_further(&self, place: &Place, address: &str, _number: u32) -> Result<Box<dyn Caller>> {
        self.connect(place, address)
    }
}

/// What tells the processes of one pair from all others, and how the server serves.
#[derive(Debug, Clone, Default, Args)]
pub struct Place {
    /// Differs from that of all other pairs, of other runs as well.
    #[arg(long)]
    pub run: u32,
    /// The service prints what it gets.
    #[arg(long)]
    pub print: bool,
    /// Which of the pair's client processes this is.
    #[arg(long, default_value_t = 0)]
    pub client: u32,
}

impl Place {
    /// The address to listen on: that of the server's end of a cable, else loopback.
    pub fn host(&self) -> IpAddr {
        cable_end().unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST))
    }

    /// Prints as this place wants it.
    pub fn printer(&self) -> Printer {
        Printer(self.print)
    }

    /// The port of broadcasts, so that units of other pairs do not even hear each other; below those that the kernel
    /// gives out.
    pub fn discovery_port(&self) -> u16 {
        20_000 + (self.run % 10_000) as u16
    }
}

/// This environment variable holds the address of the server's end of a cable, for all processes of the pair.
pub const CABLE_END: &str = "CARA_BENCH_CABLE";

/// The address of the server's end where the pair has a cable.
pub fn cable_end() -> Option<IpAddr> {
    std::env::var(CABLE_END).ok()?.parse().ok()
}

/// A server that runs until its process ends.
pub struct Server {
    /// What the clients are told; any text without line breaks.
    pub address: String,
    /// What the one-way service counted.
    pub executed: Arc<Executed>,
    /// Changes what callers may do; `None` where there are no such limits.
    pub constrain: Option<Constrain>,
    /// What the server counts of its own accord, by name; a run that loses something tells it.
    pub counters: Box<dyn Fn() -> Counters>,
    /// Whatever must not be dropped.
    pub keep: Box<dyn Any>,
}

/// Tells all callers other limits.
pub type Constrain = Box<dyn Fn(Limits) -> Result<()>>;

impl Server {
    /// A server without constraints and counters of its own.
    pub fn new(address: String, executed: Arc<Executed>, keep: impl Any) -> Self {
        Self { address, executed, constrain: None, counters: Box::new(Counters::new), keep: Box::new(keep) }
    }
}

/// Counters by name.
pub type Counters = BTreeMap<String, u64>;

/// The constraints of the paper that a server can tell its callers.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Limits {
    /// Least time between two requests of one caller.
    pub minimum_interval_ms: u64,
    /// Longest message in bytes.
    pub message_size: u32,
}

/// Counts of the one-way service itself.
#[derive(Debug, Default)]
pub struct Executed {
    count: AtomicU64,
    last: AtomicU64,
}

impl Executed {
    /// One more.
    pub fn note(&self) {
        self.last.store(clock::now(), Ordering::Relaxed);
        self.count.fetch_add(1, Ordering::Release);
    }

    /// How many so far, and when the last one was, on the clock of [`clock::now`].
    pub fn read(&self) -> (u64, u64) {
        (self.count.load(Ordering::Acquire), self.last.load(Ordering::Relaxed))
    }
}

/// How a one-way message travels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Delivery {
    /// In the stream.
    Reliable,
    /// In a datagram, now or never.
    BestEffort,
}

/// A caller; used by one thread at a time.
pub trait Caller: Send {
    /// Sends `text` there and back, and makes a string of it at both ends; the length that came back in bytes.
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
