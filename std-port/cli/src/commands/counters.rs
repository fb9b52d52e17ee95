//! `cara counters`: what a unit and its links have counted.

use std::process::ExitCode;

use cara_std::control::protocol::{Answer, Question};
use serde_json::{Map, Value, json};

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, FAINT, HEADING, PLAIN};

/// Shows counters: of the unit and of each link, or of the link to one node.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The link to this node only: NAME, NAME/ID or #ID.
    node: Option<String>,
    /// Show zeros too.
    #[arg(long)]
    zeros: bool,
    /// Print them in Prometheus' text form, as `cara node --metrics` serves them.
    #[arg(long, conflicts_with_all = ["node", "zeros"])]
    prometheus: bool,
}

pub(crate) fn run(Arguments { node, zeros, prometheus }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let need = node.as_deref().map_or(Need::Everybody, Need::Node);
    let mut operator = Operator::open(global, &need)?;
    if prometheus {
        if global.json {
            return Err(Ended::usage("--prometheus is a form of its own: leave out --json"));
        }
        return print_metrics(&mut operator);
    }
    let node = match node {
        Some(node) => Some(nodes::connected(&mut operator, &node)?.selector),
        None => None,
    };
    let answers = operator.answers(&Question::Counters { node })?.into_iter();
    let counters: Vec<_> = answers.filter_map(counted).collect();
    if global.json {
        output::object(&as_json(&counters))?;
    } else {
        for (node, counters) in &counters {
            show(node.as_deref(), counters, zeros)?;
        }
    }
    Ok(Exit::Done.into())
}

fn print_metrics(operator: &mut Operator) -> anyhow::Result<ExitCode> {
    for answer in operator.answers(&Question::Metrics)? {
        if let Answer::Metrics { text } = answer {
            output::bytes(text.as_bytes())?;
        }
    }
    Ok(Exit::Done.into())
}

type Counters = (Option<String>, Vec<(String, u64)>);

fn counted(answer: Answer) -> Option<Counters> {
    match answer {
        Answer::Counters { node, counters } => Some((node, counters)),
        _ => None,
    }
}

fn as_json(all: &[Counters]) -> Value {
    let object = |counters: &[(String, u64)]| -> Map<String, Value> {
        counters.iter().map(|(name, count)| (name.clone(), (*count).into())).collect()
    };
    let unit = all.iter().find(|(node, _)| node.is_none()).map(|(_, counters)| object(counters));
    let nodes = all.iter().filter_map(|(node, counters)| Some((node.clone()?, object(counters).into())));
    json!({ "unit": unit, "nodes": nodes.collect::<Map<String, Value>>() })
}

fn show(node: Option<&str>, counters: &[(String, u64)], zeros: bool) -> std::io::Result<()> {
    match node {
        Some(node) => output::line(format_args!("{HEADING}link to {node}{HEADING:#}"))?,
        None => output::line(format_args!("{HEADING}unit{HEADING:#}"))?,
    }
    let width = counters.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    for (name, count) in counters.iter().filter(|(_, count)| zeros || *count > 0) {
        let style = if *count == 0 { FAINT } else { PLAIN };
        output::line(format_args!("{style}  {name:width$}  {count}{style:#}"))?;
    }
    Ok(())
}
