//! The `cara` command: what is on the network, why something is not, and calls from the command line.

mod close_names;
mod commands;
mod doctor;
mod exit;
mod global;
mod name_and_id;
mod node;
mod output;
mod text;
mod units;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::exit::EXIT_CODES;
use crate::global::Global;

/// Shows and calls the nodes of a CARA fleet, through the m_unit that runs on this host or as an m_unit itself.
#[derive(Parser)]
#[command(name = "cara", version, max_term_width = 100, after_long_help = EXIT_CODES, subcommand_required = true)]
pub(crate) struct CommandLine {
    #[command(flatten)]
    global: Global,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Scan(commands::scan::Arguments),
    Functions(commands::functions::Arguments),
    Call(commands::call::Arguments),
    Publish(commands::publish::Arguments),
    Set(commands::set::Arguments),
    Watch(commands::watch::Arguments),
    Counters(commands::counters::Arguments),
    Ping(commands::ping::Arguments),
    Bench(commands::bench::Arguments),
    Node(node::Arguments),
    Doctor(doctor::Arguments),
    Completions(commands::completions::Arguments),
    Man(commands::man::Arguments),
}

fn main() -> ExitCode {
    let CommandLine { global, verb } = CommandLine::parse();
    let outcome = run(verb, &global);
    exit::code_of(outcome, &global)
}

fn run(verb: Verb, global: &Global) -> anyhow::Result<ExitCode> {
    match verb {
        Verb::Scan(arguments) => commands::scan::run(arguments, global),
        Verb::Functions(arguments) => commands::functions::run(arguments, global),
        Verb::Call(arguments) => commands::call::run(arguments, global),
        Verb::Publish(arguments) => commands::publish::run(arguments, global),
        Verb::Set(arguments) => commands::set::run(arguments, global),
        Verb::Watch(arguments) => commands::watch::run(arguments, global),
        Verb::Counters(arguments) => commands::counters::run(arguments, global),
        Verb::Ping(arguments) => commands::ping::run(arguments, global),
        Verb::Bench(arguments) => commands::bench::run(arguments, global),
        Verb::Node(arguments) => node::run(arguments, global),
        Verb::Doctor(arguments) => doctor::run(arguments, global),
        Verb::Completions(arguments) => commands::completions::run(arguments, global),
        Verb::Man(arguments) => commands::man::run(arguments, global),
    }
}
