//! What is measured: each peer can echo a string between two processes in its own way.

pub(crate) mod cara;
mod floor;

use std::any::Any;
use std::sync::OnceLock;

use anyhow::{Context, Result};

/// One way to echo strings. An instance lives in one server process or one client process.
pub(crate) trait Peer: Sync {
    /// Starts to serve in threads of its own.
    fn start_server(&self, run: u32) -> Result<Server>;

    /// A caller that is ready to call; asked for once per caller, from one thread. Callers that share something share
    /// it through `self`.
    fn connect(&self, run: u32, address: &str) -> Result<Box<dyn Caller>>;
}

/// A server that runs until its process ends.
pub(crate) struct Server {
    /// What the clients are told; any text without line breaks.
    pub(crate) address: String,
    /// Whatever must not be dropped.
    pub(crate) keep: Box<dyn Any>,
}

/// One who calls; used by one thread at a time.
pub(crate) trait Caller: Send {
    /// Sends `text` there and back, with a UTF-8 check and a string made at both ends; the length that came back in
    /// bytes.
    fn echo(&mut self, text: &str) -> Result<usize>;
}

type Make = fn() -> Box<dyn Peer>;

/// All peers in the order in which they take turns. The first is the one that the others are compared with.
const PEERS: [(&str, Make); 5] = [
    ("floor", || Box::new(floor::Floor)),
    ("floor_again", || Box::new(floor::Floor)),
    ("cara", || Box::new(cara::Cara::LinkEach)),
    ("cara_one_link", || Box::new(cara::Cara::OneLink(OnceLock::new()))),
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
