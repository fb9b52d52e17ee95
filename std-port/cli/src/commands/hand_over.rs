//! `cara hand-over`: vehicles go over to another manager.

use std::process::ExitCode;
use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, Failure, NodeInfo, Question};
use cara_std::{HAND_OVER_TIMEOUT, Shown};
use serde_json::json;

use crate::nodes::{self, Chosen, full_name};
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::name_and_id::NameAndId;
use cara_tools::output::{self, BAD};
use cara_tools::units::{parse_time, show_micros};

/// Hands vehicles over to another manager, each at standstill: its program does not restart, and its latches and last orders stay.
///
/// A vehicle refuses while something of it moves, and comes back unless it has joined the other manager within 10 s. Ends with 0 if
/// all have left and none was back after 12 s.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The vehicles: NAME, NAME/ID or #ID each.
    #[arg(value_name = "VEHICLE", required_unless_present = "all", conflicts_with = "all")]
    vehicles: Vec<String>,
    /// Every s_unit of the roster; it fails where one is absent.
    #[arg(long)]
    all: bool,
    /// The other manager: NAME/ID; NAME or #ID of one that is connected with this one.
    #[arg(long, value_name = "MANAGER")]
    to: String,
    /// How long to wait for the answer of each vehicle.
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = parse_time)]
    timeout: Duration,
    /// Do not wait for those that come back: return when each has answered.
    #[arg(long = "async")]
    asynchronous: bool,
}

/// A vehicle that comes back has joined again by then.
const BACK: Duration = Duration::from_secs(12);
const _: () = assert!(HAND_OVER_TIMEOUT.as_millis() < BACK.as_millis() as u64);
/// How often is looked for those that come back.
const LOOK: Duration = Duration::from_millis(250);

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let Arguments { vehicles, to, timeout, asynchronous, .. } = arguments;
    let need = if let [only] = vehicles.as_slice() { Need::Node(only) } else { Need::Everybody };
    let mut operator = Operator::open(global, &need)?;
    let to = manager(&mut operator, &to)?;
    let vehicles = chosen(&mut operator, &vehicles)?;
    let mut sum = Sum { to, nodes: vehicles.len(), waits: !asynchronous, ..Sum::default() };
    match sum.hand_over(&mut operator, &vehicles, timeout, global) {
        Ok(()) => {}
        Err(error) if sum.left.is_empty() && sum.missing.is_empty() => return Err(error),
        Err(error) => return Err(error.context(sum.to_string())),
    }
    match global.json {
        true => output::object(&json!({
            "to": sum.to, "nodes": sum.nodes, "moved": sum.left.len(), "missing": sum.missing,
        }))?,
        false => output::line(&sum)?,
    }
    Ok(if sum.missing.is_empty() { Exit::Done } else { Exit::Failed }.into())
}

/// As `NAME/ID`.
fn manager(operator: &mut Operator, meant: &str) -> anyhow::Result<String> {
    if meant.parse::<NameAndId>().is_ok() {
        return Ok(meant.to_owned());
    }
    let nodes = nodes::all(operator, None)?;
    Err(Ended::usage(match nodes::among(&nodes, meant)? {
        Some(Chosen { node, .. }) if node.role == "m_unit" => return Ok(full_name(&node)),
        Some(Chosen { node, .. }) => format!("{} is no manager: name one with `--to NAME/ID`", full_name(&node)),
        None => {
            let managers: Vec<_> = nodes.iter().filter(|node| node.role == "m_unit").map(full_name).collect();
            let known = if managers.is_empty() { "none".to_owned() } else { managers.join(", ") };
            format!("no manager `{}` is known here (known: {known}): name it with `--to NAME/ID`", Shown(meant))
        }
    }))
}

/// The vehicles that are meant, all if none is named.
fn chosen(operator: &mut Operator, named: &[String]) -> anyhow::Result<Vec<Chosen>> {
    let mut chosen: Vec<Chosen> = Vec::new();
    for name in named {
        let vehicle = nodes::known(operator, name)?;
        if chosen.iter().all(|other| other.selector != vehicle.selector) {
            chosen.push(vehicle);
        }
    }
    if named.is_empty() {
        let nodes = nodes::all(operator, None)?;
        let vehicles = nodes.iter().filter(|node| node.role == "s_unit" && (node.connected || node.expected));
        chosen.extend(vehicles.map(|node| Chosen::among(&nodes, node)));
    }
    if chosen.is_empty() {
        let text = format!("no s_unit is known{}: none was handed over", operator.waited());
        return Err(Ended::failed("NoNodes", text));
    }
    Ok(chosen)
}

/// What came of all vehicles.
#[derive(Default)]
struct Sum {
    to: String,
    nodes: usize,
    /// Those that come back are waited for.
    waits: bool,
    /// Those that have left, each with a time before it was asked.
    left: Vec<(String, Instant)>,
    /// Those that have not, or are back, or of which that is not known.
    missing: Vec<String>,
}

impl Sum {
    fn hand_over(
        &mut self,
        operator: &mut Operator,
        vehicles: &[Chosen],
        timeout: Duration,
        global: &Global,
    ) -> anyhow::Result<()> {
        for Chosen { node, selector } in vehicles {
            let (name, asked) = (full_name(node), Instant::now());
            let timeout_ms = timeout.as_millis() as u64;
            let question = Question::HandOver { node: selector.clone(), to: self.to.clone(), timeout_ms };
            operator.ask(&question, |answer| {
                let Answer::Called { error, took_us, .. } = answer else { return Ok(()) };
                match error {
                    None => self.left.push((name.clone(), asked)),
                    Some(_) => self.missing.push(name.clone()),
                }
                Ok(show(&name, &self.to, error.as_ref(), took_us, global)?)
            })?;
        }
        if self.waits { self.await_returns(operator, global) } else { Ok(()) }
    }

    fn await_returns(&mut self, operator: &mut Operator, global: &Global) -> anyhow::Result<()> {
        let start = Instant::now();
        while start.elapsed() < BACK && !self.left.is_empty() {
            std::thread::sleep(LOOK);
            let now = Instant::now();
            let is_back = |node: &NodeInfo, asked: Instant| {
                node.connected_ms.is_some_and(|ms| Duration::from_millis(ms) < now.saturating_duration_since(asked))
            };
            let nodes = nodes::all(operator, None)?;
            let back = |(name, asked): &mut (String, Instant)| {
                let vehicles = nodes.iter().filter(|node| node.role == "s_unit" && full_name(node) == *name);
                vehicles.clone().any(|node| is_back(node, *asked))
            };
            for (name, asked) in self.left.extract_if(.., back).collect::<Vec<_>>() {
                let failure = came_back(&self.to);
                show(&name, &self.to, Some(&failure), asked.elapsed().as_micros() as u64, global)?;
                self.missing.push(name);
            }
        }
        Ok(())
    }
}

impl std::fmt::Display for Sum {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { to, nodes, waits, left, missing } = self;
        write!(f, "{} of {nodes} have left for {}", left.len(), Shown(to))?;
        if *waits && !left.is_empty() {
            write!(f, " and are not back after {} s", BACK.as_secs())?;
        }
        if !missing.is_empty() {
            write!(f, "; not moved, or not known: {}", Shown(&missing.join(", ")))?;
        }
        Ok(())
    }
}

fn came_back(to: &str) -> Failure {
    let text = format!("it is here again: it has not found {to} in time, or could not store that it belongs there");
    Failure { cause: "peer".to_owned(), error: "CameBack".to_owned(), kind: None, code: None, said: None, text }
}

fn show(name: &str, to: &str, error: Option<&Failure>, took_us: u64, global: &Global) -> std::io::Result<()> {
    match error {
        _ if global.json => output::object(&json!({ "node": name, "error": error, "took_us": took_us })),
        None => output::line(format_args!("{name}  leaves for {} after {}", Shown(to), show_micros(took_us as f64))),
        Some(Failure { error, text, .. }) => output::line(format_args!("{BAD}{name}: {error}:{BAD:#} {}", Shown(text))),
    }
}
