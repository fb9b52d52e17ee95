//! `cara orders`: who moves what, and what is stopped.

use std::process::ExitCode;

use cara_std::control::protocol::{Answer, InhibitedInfo, OrderInfo, QUIET_STREAM_MS, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output::{self, BAD, PLAIN, Rows};

/// Shows the order of each function that moves something: whose it is, how long it goes on at most, or how it ended, and what
/// keeps the next one from beginning.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID; all that are connected if absent.
    node: Option<String>,
}

pub(crate) fn run(Arguments { node }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let need = node.as_deref().map_or(Need::Everybody, Need::Node);
    let mut operator = Operator::open(global, &need)?;
    let node = match node {
        Some(node) => Some(nodes::connected(&mut operator, &node)?.selector),
        None => None,
    };
    let answers = operator.answers(&Question::Orders { node })?.into_iter();
    let orders: Vec<OrderInfo> =
        answers.filter_map(|answer| if let Answer::Order(order) = answer { Some(order) } else { None }).collect();
    if global.json {
        output::object(&json!({ "orders": orders }))?;
    } else if orders.is_empty() {
        output::line(format_args!("no node has published a function with a lease to this unit"))?;
    } else {
        table(&orders).print()?;
    }
    Ok(Exit::Done.into())
}

fn table(orders: &[OrderInfo]) -> Rows {
    let mut rows = Rows::new(["NODE", "FUNCTION", "ORDER", "OF UNIT", "ENDS WITHIN", "INHIBITED"]);
    for OrderInfo { node, id, function, order, holder, left_ms, inhibited, age_ms, .. } in orders {
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
        let cells = [
            format!("{node}/{id}"),
            function.clone(),
            match age_ms.filter(|age| *age > QUIET_STREAM_MS) {
                Some(age) => format!("{order}, {} s ago", age / 1000),
                None => order.clone(),
            },
            or_dash(holder.map(|holder| holder.to_string())),
            or_dash(left_ms.map(|left| format!("{left} ms"))),
            or_dash(inhibited.map(by_whom)),
        ];
        rows.add(if inhibited.is_some() { BAD } else { PLAIN }, cells);
    }
    rows
}

fn by_whom(InhibitedInfo { by, reason }: InhibitedInfo) -> String {
    if by == 0 { format!("by itself, reason {reason}") } else { format!("by unit {by}") }
}
