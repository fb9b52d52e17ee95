//! Round trips and throughput against the floor, measured in one interleaved run.
//!
//! Each peer gets a server process and a client process of its own, pinned when they start. The scheduler tells the
//! clients in turn to make a block of calls (A B C A B C …), so that whatever else the machine does meets all of them
//! alike, and compares each block with the floor's block of the same turn. `floor_again` is the floor a second time:
//! its ratio shows how far two equal things differ here.
//!
//! Only a release build measures anything: `cargo run --release -p cara-bench -- skeleton --help`.

mod block;
mod child;
mod peers;
mod pin;
mod report;
mod schedule;
mod statistics;

use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Parser, Subcommand};

use crate::pin::Pin;

/// Measures CARA against raw sockets.
#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Echo calls: round trips and requests per second of each peer in each cell.
    Skeleton(Skeleton),
    /// The process that answers; started by the others.
    #[command(hide = true)]
    Serve(Child),
    /// The process that calls; started by the others.
    #[command(hide = true)]
    Call(Child),
    /// The process that holds idle s_units; started by the others.
    #[command(hide = true)]
    Idle(Child),
}

/// What to measure.
#[derive(Args)]
pub(crate) struct Skeleton {
    /// Lengths of the string that is echoed, 1 to 100000 characters.
    #[arg(long, value_delimiter = ',', default_value = "100,1000,20000", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    chars: Vec<u32>,
    /// Where the two processes run.
    #[arg(long, value_delimiter = ',', default_value = "same,split")]
    pins: Vec<Pin>,
    /// Callers at a time, each a thread with a connection of its own unless the peer says otherwise.
    #[arg(long, value_delimiter = ',', default_value = "1", value_parser = clap::value_parser!(u32).range(1..=1_000))]
    callers: Vec<u32>,
    /// Pauses between two calls of one caller, in milliseconds.
    #[arg(long, value_delimiter = ',', default_value = "0")]
    pause_ms: Vec<u64>,
    /// Turns: each peer makes one block per turn in each cell.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Calls per block, shared among the callers (each makes at least 25).
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
    calls: u32,
    /// Calls per caller and block in cells with a pause.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    paused_calls: u32,
    /// Peers to measure; the floor is always the first of them.
    #[arg(long, value_delimiter = ',', default_values_t = peers::names())]
    peers: Vec<String>,
    /// Writes the rows there as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// What a child process is told.
#[derive(Args)]
pub(crate) struct Child {
    /// Whom to play.
    #[arg(long)]
    peer: String,
    /// The CPU to stay on.
    #[arg(long)]
    cpu: Option<usize>,
    /// Tells the processes of this peer and pin from all others, of other runs as well.
    #[arg(long)]
    run: u32,
    /// Where the server listens, as it told.
    #[arg(long, default_value = "")]
    address: String,
}

fn main() -> Result<()> {
    match Arguments::parse().command {
        Command::Skeleton(skeleton) => {
            if cfg!(debug_assertions) {
                eprintln!("note: this is not a release build; its figures mean nothing");
            }
            let rows = schedule::run(&skeleton)?;
            report::table(&rows);
            skeleton.json.as_deref().map_or(Ok(()), |path| report::json(&rows, path))
        }
        Command::Serve(child) => child::serve(&child),
        Command::Call(child) => child::call(&child),
        Command::Idle(child) => peers::cara::idle(child.run),
    }
}
