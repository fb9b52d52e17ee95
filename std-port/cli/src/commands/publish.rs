//! `cara publish`: the unit's own functions become visible to others.

use std::process::ExitCode;
use std::time::Duration;

use cara_std::control::protocol::{Answer, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output::{self, BAD};
use cara_tools::units::parse_time;

/// Makes the unit's own functions visible: to one node, or to all, also later ones.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// To this node only: NAME, NAME/ID or #ID.
    node: Option<String>,
    /// How long to wait until the nodes have read the list.
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = parse_time)]
    timeout: Duration,
}

pub(crate) fn run(Arguments { node, timeout }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let need = node.as_deref().map_or(Need::Everybody, Need::Node);
    let mut operator = Operator::open(global, &need)?;
    let node = match node {
        Some(node) => Some(nodes::connected(&mut operator, &node)?.selector),
        None => None,
    };
    let question = Question::Publish { node: node.clone(), timeout_ms: timeout.as_millis() as u64 };
    let unread: Vec<_> = operator.answers(&question)?.into_iter().filter_map(unread).collect();
    let to = node.as_deref().unwrap_or("all nodes, also those that come later");
    if global.json {
        output::object(&json!({ "to": node, "unread": unread }))?;
    } else {
        let all_read = node.is_none() || unread.is_empty();
        if all_read {
            output::line(format_args!("published to {to}"))?;
        }
        unread.iter().try_for_each(|node| output::line(format_args!("{BAD}not read in time:{BAD:#} {node}")))?;
    }
    Ok(if unread.is_empty() { Exit::Done } else { Exit::Failed }.into())
}

fn unread(answer: Answer) -> Option<String> {
    match answer {
        Answer::Unread { node, id } => Some(format!("{node}/{id}")),
        _ => None,
    }
}
