//! The `cara` command: lists the nodes of a fleet, calls their functions, stops them, and finds out why a node is missing.
//!
//! A verb asks the manager that runs on this host, through its control socket, and decides nothing that the manager decides.
//! Only with `--as` is the command a manager itself. Each verb is a file of [`commands`]; `doctor`, `keys`, `provision` and
//! `web` are crates of their own. `docs/cara.md` has all options, JSON keys and exit codes.

mod attended;
mod command_line;
mod commands;
mod node;
mod nodes;
mod operator;
mod statistics;
mod text;

use std::process::ExitCode;

use crate::command_line::{CommandLine, Verb};
use cara_tools::global::Global;
use cara_tools::interrupt;

fn main() -> ExitCode {
    let CommandLine { global, verb } = match command_line::parse() {
        Ok(line) => line,
        Err(code) => return code,
    };
    let outcome = global.check().and_then(|()| run(verb, &global));
    cara_tools::exit::code_of(outcome, &global)
}

fn run(verb: Verb, global: &Global) -> anyhow::Result<ExitCode> {
    let ends_at_signals = matches!(
        verb,
        Verb::Scan(_)
            | Verb::Watch(_)
            | Verb::Stream(_)
            | Verb::Logs(_)
            | Verb::Replay(_)
            | Verb::Doctor(_)
            | Verb::HandOver(_)
    );
    if ends_at_signals {
        interrupt::end_at_signals()?;
    }
    match verb {
        Verb::Scan(arguments) => commands::scan::run(arguments, global),
        Verb::Functions(arguments) => commands::functions::run(arguments, global),
        Verb::Orders(arguments) => commands::orders::run(arguments, global),
        Verb::Call(arguments) => commands::call::run(arguments, global),
        Verb::Publish(arguments) => commands::publish::run(arguments, global),
        Verb::Stop(arguments) => commands::stop::stop(arguments, global),
        Verb::Reset(arguments) => commands::stop::reset(arguments, global),
        Verb::ForgetClaim(arguments) => commands::forget_claim::run(arguments, global),
        Verb::HandOver(arguments) => commands::hand_over::run(arguments, global),
        Verb::Retire(arguments) => commands::retire::run(arguments, global),
        Verb::Set(arguments) => commands::set::run(arguments, global),
        Verb::Watch(arguments) => commands::watch::run(arguments, global),
        Verb::Top(arguments) => commands::top::run(arguments, global),
        Verb::Logs(arguments) => commands::logs::run(arguments, global),
        Verb::Record(arguments) => commands::record::run(arguments, global),
        Verb::Replay(arguments) => commands::replay::run(arguments, global),
        Verb::BlackBox(arguments) => commands::black_box::run(arguments, global),
        Verb::Stream(arguments) => commands::stream::run(arguments, global),
        Verb::Counters(arguments) => commands::counters::run(arguments, global),
        Verb::Ping(arguments) => commands::ping::run(arguments, global),
        Verb::Web(arguments) => commands::web::run(arguments, global),
        Verb::Node(arguments) => node::run(arguments, global),
        Verb::Line(arguments) => cara_line::run(arguments, global),
        Verb::Doctor(arguments) => cara_doctor::run(arguments, global),
        Verb::SupportBundle(arguments) => commands::support_bundle::run(arguments, global),
        Verb::Keys(arguments) => cara_keys::run(arguments, global),
        Verb::Access(arguments) => commands::access::run(arguments, global),
        Verb::Provision(arguments) => cara_provision::run(arguments, global),
        Verb::Completions(arguments) => commands::completions::run(arguments, global),
        Verb::Man(arguments) => commands::man::run(arguments, global),
    }
}
