//! `cara stop` and `cara reset`: the functions with that attribute, of one node or of all.

use std::process::ExitCode;

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Failure, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, BAD};
use cara_tools::units::show_micros;

/// Calls each function with the attribute `stop`, at once and as an emergency: what they stop stands until a reset.
///
/// Ends with 0 only if every s_unit of the roster has acknowledged. Not a substitute for a certified emergency stop.
#[derive(clap::Args)]
pub(crate) struct Stop {
    #[command(flatten)]
    of: Of,
}

/// Calls each function with the attribute `reset`: what was stopped may move again, unless a node refuses.
#[derive(clap::Args)]
pub(crate) struct Reset {
    #[command(flatten)]
    of: Of,
}

#[derive(clap::Args)]
struct Of {
    /// The node: NAME, NAME/ID or #ID.
    #[arg(required_unless_present = "all", conflicts_with = "all")]
    node: Option<String>,
    /// Every s_unit of the roster, also those that are absent, and every m_unit that offers such a function.
    #[arg(long)]
    all: bool,
}

pub(crate) fn stop(Stop { of }: Stop, global: &Global) -> anyhow::Result<ExitCode> {
    run(of, Operator::open_to_stop, |node| Question::Stop { node }, global)
}

pub(crate) fn reset(Reset { of }: Reset, global: &Global) -> anyhow::Result<ExitCode> {
    run(of, Operator::open, |node| Question::Reset { node }, global)
}

fn run(
    of: Of,
    open: fn(&Global, &Need<'_>) -> anyhow::Result<Operator>,
    question: impl FnOnce(Option<String>) -> Question,
    global: &Global,
) -> anyhow::Result<ExitCode> {
    let need = of.node.as_deref().map_or(Need::Everybody, Need::Node);
    let mut operator = open(global, &need)?;
    let node = match of.node {
        Some(node) => Some(nodes::known(&mut operator, &node)?.selector),
        None => None,
    };
    let (mut nodes, mut acknowledged, mut last_us) = (0, 0, None);
    operator.ask(&question(node), |answer| {
        let Answer::Called { node, id, error, took_us, .. } = answer else { return Ok(()) };
        nodes += 1;
        if error.is_none() {
            acknowledged += 1;
            last_us = last_us.max(Some(took_us));
        }
        Ok(show(&format!("{node}/{id}"), error.as_ref(), took_us, global)?)
    })?;
    if nodes == 0 {
        return Err(Ended::failed("NoNodes", format!("no s_unit is known{}: nothing was called", operator.waited())));
    }
    if global.json {
        output::object(&json!({ "nodes": nodes, "acknowledged": acknowledged, "last_us": last_us }))?;
    } else {
        let last = last_us.map(|last| format!(", the last after {}", show_micros(last as f64))).unwrap_or_default();
        output::line(format_args!("{acknowledged} of {nodes} acknowledged{last}"))?;
    }
    Ok(if acknowledged == nodes { Exit::Done } else { Exit::Failed }.into())
}

fn show(node: &str, error: Option<&Failure>, took_us: u64, global: &Global) -> std::io::Result<()> {
    match error {
        _ if global.json => output::object(&json!({ "node": node, "error": error, "took_us": took_us })),
        None => output::line(format_args!("{node}  acknowledged after {}", show_micros(took_us as f64))),
        Some(Failure { error, text, .. }) => {
            let what = if error == "NotConnected" { "not reached" } else { error };
            output::line(format_args!("{BAD}{node}: {what}:{BAD:#} {}", Shown(text)))
        }
    }
}
