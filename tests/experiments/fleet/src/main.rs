//! A thousand s_units on one manager over loopback: how fast they meet, what that costs the network, and what a node
//! costs the manager's process.
//!
//! Processes: the manager, one that holds all s_units but one, and one with a single s_unit; twice a manager with a
//! single s_unit, to compare with. All of them end with this one. Counts are counters of the public API; threads and
//! memory are what the kernel tells of the manager's process.
//!
//! Only a release build measures anything: `cargo run --release -p cara-fleet -- --help`.

mod child;
mod floor;
mod manager;
mod parent;
mod phases;
mod proc;
mod report;
mod streams;
mod units;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Parser, Subcommand};

/// Measures a manager with many nodes.
#[derive(Parser)]
#[command(max_term_width = 120)]
struct Arguments {
    #[command(subcommand)]
    role: Option<Role>,
    #[command(flatten)]
    plan: Plan,
}

/// What to measure.
#[derive(Args)]
pub(crate) struct Plan {
    /// S_units that join the manager.
    #[arg(long, default_value_t = 1_000, value_parser = clap::value_parser!(u16).range(2..=10_000))]
    nodes: u16,
    /// Processes that share all s_units but one, which has a process of its own. Each s_unit takes three descriptors.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    processes: u16,
    /// Turns of the comparison of the cost per request.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Also writes the figures here.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Subcommand)]
enum Role {
    /// Measures streams of many vehicles over a slow cable, beside calls; needs root.
    Streams(streams::Plan),
    /// The manager's process of that; started by the others.
    #[command(hide = true)]
    StreamsManager(streams::Part),
    /// The vehicles' process; started by the others.
    #[command(hide = true)]
    StreamsUnits(streams::Part),
    /// The process of another m_unit; started by the others.
    #[command(hide = true)]
    StreamsReader(streams::Part),
    /// The manager's process; started by the others.
    #[command(hide = true)]
    Manager(Manager),
    /// A process with s_units; started by the others.
    #[command(hide = true)]
    Units(Units),
    /// A process that answers on raw sockets; started by the others.
    #[command(hide = true)]
    FloorServer(Floor),
    /// A process that calls over raw sockets; started by the others.
    #[command(hide = true)]
    FloorClient(Floor),
}

/// What a manager's process is told.
#[derive(Args)]
pub(crate) struct Manager {
    #[arg(long)]
    fleet: u32,
    /// The UDP port of broadcasts.
    #[arg(long)]
    port: u16,
    /// Its constraint `maximum_nodes`, the only one that differs from the defaults.
    #[arg(long)]
    nodes: u16,
}

/// What a process with s_units is told.
#[derive(Args)]
pub(crate) struct Units {
    #[arg(long)]
    fleet: u32,
    #[arg(long)]
    port: u16,
    /// The ID number of the first; the others follow.
    #[arg(long)]
    first: u32,
    #[arg(long)]
    count: u32,
}

/// What a process with raw sockets is told.
#[derive(Args)]
pub(crate) struct Floor {
    /// The fleet that it belongs to, as told to every child.
    #[arg(long)]
    fleet: u32,
    /// The TCP port.
    #[arg(long)]
    port: u16,
    #[arg(long)]
    count: usize,
}

fn main() -> Result<ExitCode> {
    let arguments = Arguments::parse();
    match arguments.role {
        Some(Role::Streams(plan)) => streams::run(&plan).map(|()| ExitCode::SUCCESS),
        Some(Role::StreamsManager(part)) => streams::manager(&part).map(|()| ExitCode::SUCCESS),
        Some(Role::StreamsUnits(part)) => streams::units(&part).map(|()| ExitCode::SUCCESS),
        Some(Role::StreamsReader(part)) => streams::reader(&part).map(|()| ExitCode::SUCCESS),
        Some(Role::Manager(manager)) => manager::run(&manager).map(|()| ExitCode::SUCCESS),
        Some(Role::Units(units)) => units::run(&units).map(|()| ExitCode::SUCCESS),
        Some(Role::FloorServer(floor)) => floor::serve(floor.port, floor.count).map(|()| ExitCode::SUCCESS),
        Some(Role::FloorClient(floor)) => floor::call(floor.port, floor.count).map(|()| ExitCode::SUCCESS),
        None => measure(&arguments.plan),
    }
}

fn measure(plan: &Plan) -> Result<ExitCode> {
    if cfg!(debug_assertions) {
        eprintln!("note: this is not a release build; its times and its memory mean little");
    }
    let figures = phases::run(plan)?;
    let broken = report::table(&figures);
    if let Some(path) = &plan.json {
        report::json(&figures, path)?;
    }
    Ok(if broken { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}
