//! The `cara` command: what is on the network, why something is not, and calls from the command line.

mod close_names;
mod command_line;
mod commands;
mod doctor;
mod exit;
mod files;
mod global;
mod interrupt;
mod keys;
mod listening;
mod name_and_id;
mod node;
mod nodes;
mod operator;
mod output;
mod provision;
mod statistics;
mod text;
mod units;

use std::process::ExitCode;

use crate::command_line::{CommandLine, Verb};
use crate::global::Global;

fn main() -> ExitCode {
    let CommandLine { global, verb } = match command_line::parse() {
        Ok(line) => line,
        Err(code) => return code,
    };
    let outcome = global.check().and_then(|()| run(verb, &global));
    exit::code_of(outcome, &global)
}

fn run(verb: Verb, global: &Global) -> anyhow::Result<ExitCode> {
    match verb {
        Verb::Scan(arguments) => commands::scan::run(arguments, global),
        Verb::Functions(arguments) => commands::functions::run(arguments, global),
        Verb::Call(arguments) => commands::call::run(arguments, global),
        Verb::Publish(arguments) => commands::publish::run(arguments, global),
        Verb::Retire(arguments) => commands::retire::run(arguments, global),
        Verb::Set(arguments) => commands::set::run(arguments, global),
        Verb::Watch(arguments) => commands::watch::run(arguments, global),
        Verb::Counters(arguments) => commands::counters::run(arguments, global),
        Verb::Ping(arguments) => commands::ping::run(arguments, global),
        Verb::Bench(arguments) => commands::bench::run(arguments, global),
        Verb::Node(arguments) => node::run(arguments, global),
        Verb::Doctor(arguments) => doctor::run(arguments, global),
        Verb::Keys(arguments) => keys::run(arguments, global),
        Verb::Access(arguments) => commands::access::run(arguments, global),
        Verb::Provision(arguments) => provision::run(arguments, global),
        Verb::Completions(arguments) => commands::completions::run(arguments, global),
        Verb::Man(arguments) => commands::man::run(arguments, global),
    }
}
