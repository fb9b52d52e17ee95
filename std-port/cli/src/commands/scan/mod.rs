//! `cara scan`: the nodes on the network, and the ones that were refused and why.

pub(crate) mod all_managers;
mod survey;

use std::process::ExitCode;
use std::time::Duration;

use anstyle::Style;
use cara_std::control::protocol::{Answer, LimitsInfo, NodeInfo, Question, RefusedInfo};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, BAD, FAINT, PLAIN, Rows};
use cara_tools::units::{parse_time, show_bytes, show_micros};

/// Nodes that a line lists.
const LISTED: usize = 8;

/// Shows the nodes on the network: name, ID, role, address, version and limits; and refused ones, with the reason.
///
/// Through the m_unit that runs on this host: the nodes that it knows. With --as: those that join. Without either, a
/// survey of the network: all that answer.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Only nodes that offer this function.
    #[arg(long, value_name = "FUNCTION")]
    offering: Option<String>,
    /// Let the unit search now, before it is asked.
    #[arg(long, conflicts_with = "survey")]
    search: bool,
    /// Survey the network, also where an m_unit runs on this host.
    #[arg(long, conflicts_with_all = ["unit", "socket", "act_as", "offering"])]
    survey: bool,
    /// Which manager has which s_unit, as far as the m_units of this host that can be asked and a survey show.
    #[arg(long, conflicts_with_all = ["unit", "socket", "act_as", "offering", "search", "survey"])]
    all_managers: bool,
    /// How long a survey listens, and what is found by --search is waited for.
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = parse_time)]
    listen: Duration,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let Arguments { offering, search, survey, all_managers, listen } = arguments;
    // Before the verb clap takes them together.
    if (survey || all_managers) && (global.unit.is_some() || global.socket.is_some() || global.act_as.is_some()) {
        let text = "--survey and --all-managers ask no single unit: leave --unit, --socket and --as away";
        return Err(Ended::usage(text));
    }
    if all_managers {
        all_managers::show(listen, global)?;
        return Ok(Exit::Done.into());
    }
    let operator = if survey { None } else { Operator::open_if_any(global, &Need::Everybody)? };
    match (operator, offering) {
        (Some(mut operator), offering) => {
            if search {
                operator.ask(&Question::Search, |_| Ok(()))?;
                std::thread::sleep(listen);
            }
            of_unit(operator, offering, global)?;
        }
        (None, None) => survey::show(listen, global)?,
        (None, Some(_)) => {
            let text = "no m_unit runs on this host, and a survey does not see functions: start a manager \
                        (`cara node …`), or be one with `--as NAME/ID --fleet NUMBER`";
            return Err(Ended::no_unit(text));
        }
    }
    Ok(Exit::Done.into())
}

/// What a unit knows.
fn of_unit(mut operator: Operator, offering: Option<String>, global: &Global) -> anyhow::Result<()> {
    let unit = operator.unit()?;
    let (mut nodes, mut refused) = (Vec::new(), Vec::new());
    let filtered = offering.is_some();
    operator.ask(&Question::Nodes { offering }, |answer| {
        match answer {
            Answer::Node(node) => nodes.push(node),
            Answer::Refused(refusal) => refused.push(refusal),
            _ => {}
        }
        Ok(())
    })?;
    nodes.sort_by(|a: &NodeInfo, b| (&a.name, a.id).cmp(&(&b.name, b.id)));
    if global.json {
        return Ok(output::object(&json!({ "unit": unit, "nodes": nodes, "refused": refused }))?);
    }
    if nodes.is_empty() {
        let who = if filtered { "no such node has joined" } else { "no node has joined yet" };
        output::line(format_args!("{who}; `cara doctor` looks for reasons"))?;
    }
    joined(&nodes).print()?;
    missing(&nodes)?;
    if !refused.is_empty() {
        output::line("")?;
    }
    turned_away(&refused).print()?;
    Ok(())
}

fn joined(nodes: &[NodeInfo]) -> Rows {
    let mut rows = Rows::new(["NODE", "ID", "ROLE", "STATE", "ADDRESS", "VERSION", "FUNCTIONS", "LIMITS"]);
    for node in nodes {
        let (style, state) = state(node);
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        rows.add(
            style,
            [
                node.name.clone(),
                node.id.to_string(),
                node.role.clone(),
                [node.link.and_then(|link| link.trouble()), node.clock.and_then(|clock| clock.trouble())]
                    .into_iter()
                    .flatten()
                    .fold(state, |state, trouble| format!("{state}, {trouble}")),
                or_dash(node.address.clone()),
                or_dash(node.version.map(|version| version.to_string())),
                node.functions.to_string(),
                or_dash(node.limits.as_ref().map(limits)),
            ],
        );
    }
    rows
}

fn state(node: &NodeInfo) -> (Style, String) {
    let left = |left_ms: u64| format!("left {}", ago(left_ms));
    match (node.connected, node.expected, node.left_ms, &node.left_text) {
        (true, ..) => (PLAIN, "connected".into()),
        (.., Some(text)) if node.left_reason.as_deref() == Some("Fenced") => (BAD, text.clone()),
        (false, true, None, _) => (BAD, "absent".into()),
        (false, true, Some(left_ms), _) => (BAD, left(left_ms)),
        (false, false, left_ms, _) => (FAINT, left_ms.map_or_else(|| "left".into(), left)),
    }
}

/// Those of the roster that are not there: what a call to all would miss.
fn missing(nodes: &[NodeInfo]) -> std::io::Result<()> {
    let expected = nodes.iter().filter(|node| node.expected);
    let missing: Vec<String> = expected.clone().filter(|node| !node.connected).map(nodes::full_name).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let more = missing.len().saturating_sub(LISTED);
    let more = if more == 0 { String::new() } else { format!(" and {more} more") };
    let (count, all) = (missing.len(), expected.count());
    let names = missing.iter().take(LISTED).cloned().collect::<Vec<_>>().join(", ");
    output::line(format_args!(
        "\n{BAD}missing{BAD:#}: {count} of {all} s_units of the roster: {names}{more}; `cara doctor NODE` looks for the reason, \
         `cara retire NODE` takes one off the roster"
    ))
}

fn limits(limits: &LimitsInfo) -> String {
    let mut text = format!(
        "message {}, frame {}, {} calls",
        show_bytes(limits.message_size.into()),
        show_bytes(limits.chunk_size.into()),
        limits.calls
    );
    if limits.minimum_interval_us > 0 {
        text += &format!(", {} apart", show_micros(limits.minimum_interval_us as f64));
    }
    text
}

/// `3 s ago`.
fn ago(ms: u64) -> String {
    let whole = if ms < 60_000 { 1_000 } else { 60_000 };
    format!("{} ago", show_micros((ms / whole * whole) as f64 * 1000.0))
}

fn turned_away(refused: &[RefusedInfo]) -> Rows {
    let mut rows = Rows::new(["REFUSED", "ADDRESS", "WHEN", "REASON", "WHAT TO DO"]);
    for RefusedInfo { address, node, reason, text, ago_ms } in refused {
        let node = node.clone().unwrap_or_else(|| "-".into());
        // A node that still tries is refused again sooner.
        let style = if *ago_ms > 30_000 { FAINT } else { BAD };
        rows.add(style, [node, address.clone(), ago(*ago_ms), reason.clone(), text.clone()]);
    }
    rows
}
