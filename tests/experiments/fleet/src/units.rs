//! A process with many s_units: one set of threads for all of them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use anyhow::Result;
use cara_std::{Interfaces, Parameters, ParametersView, Served, ServiceError, Threads, Unit};
use serde_json::json;

use crate::child::{self, Counters, Question};

/// The manager's name and ID number.
pub(crate) const MANAGER: (&str, u32) = ("depot", 1);
/// Longest text that is sent there and back.
pub(crate) const TEXT_BYTES: u32 = 20_000;

/// Further functions that every node offers and that are never called: a list of usual length.
const FURTHER: [&str; 6] = ["go_to", "pos_info", "battery_state", "stop", "load", "unload"];

struct Node {
    unit: Unit,
    /// How often `touch` ran.
    runs: Arc<AtomicU32>,
}

/// Starts the units and answers questions about them.
pub(crate) fn run(arguments: &crate::Units) -> Result<()> {
    let threads = Threads::new()?;
    let ids = arguments.first..arguments.first + arguments.count;
    let nodes = ids.map(|id| start(arguments, id, &threads)).collect::<Result<Vec<_>>>()?;
    child::serve(|question| {
        Ok(match question {
            Question::Counters => json!(counters(&nodes)),
            Question::Runs => json!(runs(&nodes)),
            question => anyhow::bail!("s_units do not answer {question:?}"),
        })
    })
}

fn start(arguments: &crate::Units, id: u32, threads: &Threads) -> Result<Node> {
    let builder = Unit::builder(&name(id), id, MANAGER.0, MANAGER.1)?;
    let builder = builder.fleet(arguments.fleet).discovery_port(arguments.port).interfaces(Interfaces::Loopback);
    let unit = builder.threads(threads).build()?;
    let runs = Arc::new(AtomicU32::new(0));
    let counted = runs.clone();
    let touch = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        counted.fetch_add(1, Ordering::Relaxed);
        Ok(())
    };
    unit.my_function_list().add_function("echo", &*text()?, echo)?;
    unit.my_function_list().add_function("touch", &number()?, touch)?;
    for name in FURTHER {
        unit.my_function_list().add_function(name, &further()?, |parameters: Parameters| parameters)?;
    }
    unit.publish_my_function_list()?;
    unit.start()?;
    Ok(Node { unit, runs })
}

/// The name of the s_unit with an ID number.
pub(crate) fn name(id: u32) -> String {
    format!("agv-{id}")
}

fn echo(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    Ok(())
}

/// The argument and result of `echo`.
pub(crate) fn text() -> Result<Box<Parameters<{ TEXT_BYTES as usize + 1_024 }>>> {
    let mut text = Box::new(Parameters::sized());
    text.add_string("text", TEXT_BYTES)?;
    Ok(text)
}

/// The argument and result of `touch`.
pub(crate) fn number() -> Result<Parameters> {
    let mut number = Parameters::new();
    number.add_int("number", 1)?;
    Ok(number)
}

/// The arguments and results of the [`FURTHER`] functions.
fn further() -> Result<Parameters> {
    let mut parameters = Parameters::new();
    parameters.add_int("position", 2)?;
    parameters.add_float("speed", 1)?;
    Ok(parameters)
}

fn counters(nodes: &[Node]) -> Counters {
    let mut sum = Counters::new();
    for (name, count) in nodes.iter().flat_map(|node| node.unit.counters()) {
        *sum.entry(name.to_owned()).or_default() += count;
    }
    sum
}

fn runs(nodes: &[Node]) -> (u32, u32) {
    let runs = || nodes.iter().map(|node| node.runs.load(Ordering::Relaxed));
    (runs().min().unwrap_or(0), runs().max().unwrap_or(0))
}
