//! How the processes talk: a question is one line of JSON on standard input, its answer one on standard output.
//!
//! A child ends when its standard input does, so none outlives the one that measures.

use std::collections::BTreeMap;
use std::io::{BufRead, Write, stdin, stdout};
use std::time::Duration;

use anyhow::Result;
use serde::{Deserialize, Serialize};

/// What a child is asked.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) enum Question {
    /// Answers when so many nodes are connected: `bool`, whether they are in time.
    Connected { count: usize, within_ms: u64 },
    /// As `Connected`, when so many nodes offer the functions of this program.
    Offering { count: usize, within_ms: u64 },
    /// Counters by name, summed over the units of the process.
    Counters,
    /// The manager sends a text of so many characters to each node in turn, which sends it back.
    Exchange { chars: usize },
    /// Unused message buffers are given back.
    Trim,
    /// The manager calls all nodes at the same time.
    CallAll,
    /// The manager makes so many calls: of one node, or of each in turn.
    Block { node: Option<u32>, calls: usize },
    /// How often `touch` ran on each node: fewest and most.
    Runs,
    /// Vehicles publish values, or no more.
    Publish { on: bool },
    /// Answers when a value of each stream has come: `bool`, whether they have in time.
    Subscribe,
    /// What was seen of ages since this was asked before.
    Ages,
    /// The manager makes so many calls of the vehicles in turn: how long each took, in microseconds.
    Calls { function: String, calls: u32 },
    /// Bytes that have left the manager's host, and that have come to it.
    Wire,
}

/// The first line of a child.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Ready {
    pub(crate) pid: u32,
}

/// Counters by name.
pub(crate) type Counters = BTreeMap<String, u64>;

/// What became of calls to many nodes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Called {
    pub(crate) succeeded: usize,
    /// The first few errors, with the node's name.
    pub(crate) failures: Vec<String>,
    pub(crate) micros: u64,
}

/// Round trips of a block of calls.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Block {
    pub(crate) median_ns: u64,
    /// CPU time of the manager's process per call.
    pub(crate) cpu_ns: u64,
}

impl Block {
    /// Of calls that took these times, in nanoseconds, and so much CPU time in all.
    pub(crate) fn new(mut round_trips: Vec<u64>, cpu: Duration) -> Self {
        round_trips.sort_unstable();
        let median_ns = round_trips.get(round_trips.len() / 2).copied().unwrap_or(0);
        Self { median_ns, cpu_ns: cpu.as_nanos() as u64 / round_trips.len().max(1) as u64 }
    }
}

/// Says that the process is ready, then answers each question until there are no more.
pub(crate) fn serve(mut answer: impl FnMut(Question) -> Result<serde_json::Value>) -> Result<()> {
    say(&Ready { pid: std::process::id() })?;
    for line in stdin().lock().lines() {
        let answer = answer(serde_json::from_str(&line?)?).map_err(|error| format!("{error:#}"));
        say(&answer)?;
    }
    Ok(())
}

fn say(answer: &impl Serialize) -> Result<()> {
    let mut line = serde_json::to_string(answer)?;
    line.push('\n');
    let mut out = stdout().lock();
    out.write_all(line.as_bytes())?;
    Ok(out.flush()?)
}
