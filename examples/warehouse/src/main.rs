//! The processes of the warehouse, and the run that starts them all.

use std::process::ExitCode;

use anyhow::Result;
use cara_warehouse::{host, manager, mechanic, places, run};
use clap::{Parser, Subcommand};

/// A warehouse of vehicles on one machine.
#[derive(Parser)]
#[command(max_term_width = 120)]
struct Arguments {
    #[command(subcommand)]
    role: Role,
}

#[derive(Subcommand)]
enum Role {
    /// Starts all processes, breaks things, checks that nothing goes wrong, and reports.
    Run(run::Options),
    /// A process with vehicles.
    Vehicles(host::Options),
    /// The manager.
    Manager(manager::Options),
    /// The mechanic.
    Mechanic(mechanic::Options),
    /// Places that vehicles of several managers share.
    Places(places::Options),
}

fn main() -> Result<ExitCode> {
    use std::io::Write;
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("error"));
    // A terminal that takes nothing holds up no thread that moves or stops something.
    let lines = cara_std::LineQueue::new("log", |line, _| std::io::stderr().write_all(line))?;
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(move || lines.clone()).init();
    match Arguments::parse().role {
        Role::Run(options) => run::run(&options),
        Role::Vehicles(options) => host::run(&options).map(|()| ExitCode::SUCCESS),
        Role::Manager(options) => manager::run(&options),
        Role::Mechanic(options) => mechanic::run(&options).map(|()| ExitCode::SUCCESS),
        Role::Places(options) => places::run(&options).map(|()| ExitCode::SUCCESS),
    }
}
