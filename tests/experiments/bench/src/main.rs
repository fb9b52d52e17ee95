//! The paper's experiments, and what goes beyond them, against the floor in one interleaved run.
//!
//! Each peer gets a server process and a client process of its own, pinned when they start. The scheduler tells the
//! clients in turn to make a block of calls (A B C A B C …), so that whatever else the machine does meets all of them
//! alike, and compares each block with the floor's block of the same turn. `floor_again` is the floor a second time:
//! its ratio shows how far two equal things differ here. `results.rs` describes every row.
//!
//! Only a release build measures anything: `cargo xtask bench --help`.

mod child;
mod counted;
mod counts;
mod deadlines;
mod experiments;
mod lanes;
mod nodes;
mod page;
mod pair;
mod peers;
mod plots;
mod progress;
mod recording;
mod results;
mod share;
mod soak;
mod statistics;
mod table;

use std::path::PathBuf;

use anyhow::Result;
use cara_bench_ends::{End, Place, further, serve};
use clap::{Parser, Subcommand};

/// Measures CARA against raw sockets.
#[derive(Parser)]
#[command(max_term_width = 120)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Response time, throughput, the share of messages, scale, constraints and availability.
    Experiments(experiments::Options),
    /// Draws the figures of an earlier run again.
    Plots {
        /// What it wrote.
        json: PathBuf,
        /// Where they go.
        folder: PathBuf,
    },
    /// Makes the tables of `docs/performance.md` anew.
    Page {
        /// What a run wrote.
        json: PathBuf,
        /// The page.
        page: PathBuf,
    },
    /// The share of deadlines met at loads of 50 to 150 %, in the simulator; prints a table.
    Deadlines {
        /// On Linux in place of the simulator, which takes five minutes.
        #[arg(long)]
        linux: bool,
        /// Where the figure goes, and the rows of Linux.
        folder: Option<PathBuf>,
    },
    /// Slopes of what the processes of a soak held; an error where something has grown.
    Soak {
        /// The file of `cargo xtask soak`.
        csv: PathBuf,
        /// Where the figure goes.
        folder: Option<PathBuf>,
    },
    /// What a recording costs the round trip of a call; prints it.
    Recording,
    /// Counts what each end of a round trip asks of the kernel; an error where that has grown.
    Counts,
    /// The process that answers; started by the others.
    #[command(hide = true)]
    Serve(End),
    /// The process that calls; started by the others.
    #[command(hide = true)]
    Call(End),
    /// The process of the five further nodes; started by the others.
    #[command(hide = true)]
    Further(End),
    /// The process that holds idle s_units; started by the others.
    #[command(hide = true)]
    Idle(Place),
    /// The process of a manager; started by the others.
    #[command(hide = true)]
    Manager(nodes::Nodes),
    /// The process of a manager's s_units; started by the others.
    #[command(hide = true)]
    Units(nodes::Nodes),
}

fn main() -> Result<()> {
    match Arguments::parse().command {
        Command::Experiments(options) => {
            if cfg!(debug_assertions) {
                eprintln!("note: this is not a release build; its figures mean nothing");
            }
            experiments::run(&options)
        }
        Command::Plots { json, folder } => plots::draw(&results::Results::read(&json)?, &folder),
        Command::Page { json, page } => page::write(&results::Results::read(&json)?, &page),
        Command::Deadlines { linux, folder } => {
            let shares = if linux { deadlines::linux::measure() } else { deadlines::measure() }?;
            print!("{}", deadlines::table(&shares));
            folder.map_or(Ok(()), |folder| plots::draw_deadlines(&shares, linux, &folder))
        }
        Command::Soak { csv, folder } => {
            let processes = soak::parsed(&csv)?;
            folder.map_or(Ok(()), |folder| plots::draw_soak(&processes, &folder))?;
            soak::judge(&processes)
        }
        Command::Recording => recording::measure(),
        Command::Counts => counts::check(),
        Command::Serve(end) => serve(&*peers::named(&end.peer)?, &end),
        Command::Call(end) => child::call(&end),
        Command::Further(end) => further(&*peers::named(&end.peer)?, &end),
        Command::Idle(place) => peers::cara::idle(&place),
        Command::Manager(nodes) => nodes::manager(&nodes),
        Command::Units(nodes) => nodes::units(&nodes),
    }
}
