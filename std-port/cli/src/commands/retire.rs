//! `cara retire`: a node is not missed any more.

use std::process::ExitCode;

use cara_std::control::protocol::Question;
use serde_json::json;

use crate::nodes;
use crate::operator::Operator;
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output;

/// Takes an absent node off the roster of the manager that runs on this host, until it joins again or the manager
/// restarts.
///
/// A manager misses each s_unit that its key file lists, or, in plain mode, that has joined since its start: `cara call --all`
/// fails while one is missing. One that has left for good is taken out of the key file with `cara keys revoke`.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID.
    node: String,
}

pub(crate) fn run(Arguments { node }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let why_not = "a manager for the time of a command has no roster to keep";
    let mut operator = Operator::open_running(global, why_not)?;
    let node = nodes::known(&mut operator, &node)?.selector;
    operator.ask(&Question::Retire { node: node.clone() }, |_| Ok(()))?;
    if global.json {
        output::object(&json!({ "retired": node }))?;
    } else {
        output::line(format_args!("{node} is off the roster until it joins again, or the manager restarts"))?;
    }
    Ok(Exit::Done.into())
}
