//! The manager's process.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_std::{CommunicationSystem, Constraints, Error, Interfaces, Peer, RequestOptions};
use serde_json::json;

use crate::child::{self, Block, Called, Counters, Question};
use crate::proc;
use crate::units::{MANAGER, number, text};

/// Errors that are reported by name.
const FAILURES: usize = 5;
/// How long one call may take; the machine may be busy.
const TIMEOUT: Duration = Duration::from_secs(20);

/// Starts the manager, with defaults but for the number of nodes, and does what it is asked.
pub(crate) fn run(arguments: &crate::Manager) -> Result<()> {
    let constraints = Constraints { maximum_nodes: arguments.nodes, ..Constraints::M_UNIT };
    let builder = CommunicationSystem::builder(MANAGER.0, MANAGER.1)?.constraints(constraints);
    let builder = builder.fleet(arguments.fleet).discovery_port(arguments.port).interfaces(Interfaces::Loopback);
    let manager = builder.build()?;
    manager.start()?;
    child::serve(|question| answer(&manager, question))
}

fn answer(manager: &CommunicationSystem, question: Question) -> Result<serde_json::Value> {
    let offering = || manager.nodes_offering("touch").len();
    Ok(match question {
        Question::Connected { count, within_ms } => {
            json!(until(within_ms, 2, || manager.number_of_s_units() >= count))
        }
        Question::Offering { count, within_ms } => json!(until(within_ms, 50, || offering() >= count)),
        Question::Counters => json!(counters(manager)),
        Question::Exchange { chars } => json!(exchange(manager, chars)?),
        Question::Trim => {
            manager.trim_buffers();
            json!(null)
        }
        Question::CallAll => json!(call_all(manager)?),
        Question::Block { node, calls } => json!(block(manager, node, calls)?),
        question => anyhow::bail!("a manager does not answer {question:?}"),
    })
}

fn until(within_ms: u64, pause_ms: u64, condition: impl Fn() -> bool) -> bool {
    let end = Instant::now() + Duration::from_millis(within_ms);
    while !condition() {
        if Instant::now() >= end {
            return false;
        }
        std::thread::sleep(Duration::from_millis(pause_ms));
    }
    true
}

fn options() -> RequestOptions {
    RequestOptions { timeout: Some(TIMEOUT.into()), ..RequestOptions::default() }
}

/// Sums up what each call came to.
fn called(began: Instant, outcomes: impl Iterator<Item = (String, Result<(), Error>)>) -> Called {
    let mut called = Called { succeeded: 0, failures: Vec::new(), micros: 0 };
    for (name, outcome) in outcomes {
        match outcome {
            Ok(()) => called.succeeded += 1,
            Err(error) if called.failures.len() < FAILURES => called.failures.push(format!("{name}: {error}")),
            Err(_) => {}
        }
    }
    called.micros = began.elapsed().as_micros() as u64;
    called
}

/// A text to each node in turn, and back.
fn exchange(manager: &CommunicationSystem, chars: usize) -> Result<Called> {
    let sent = "x".repeat(chars);
    let mut text = text()?;
    let began = Instant::now();
    let outcomes = manager.s_units().into_iter().map(|peer| {
        let outcome = text.set_value("text", sent.as_str());
        let outcome = outcome.and_then(|()| peer.call("echo", &mut *text).with(options()).wait().map_err(Error::from));
        (peer.name().to_owned(), outcome)
    });
    Ok(called(began, outcomes))
}

fn call_all(manager: &CommunicationSystem) -> Result<Called> {
    let number = number()?;
    let began = Instant::now();
    let outcomes = manager.call_all("touch", &number).with(options()).wait().into_iter();
    Ok(called(began, outcomes.map(|(peer, outcome)| (peer.name().to_owned(), outcome.map(drop).map_err(Error::from)))))
}

/// Calls in a row, of one node or of each in turn.
fn block(manager: &CommunicationSystem, node: Option<u32>, calls: usize) -> Result<Block> {
    let peers: Vec<Peer> = match node {
        Some(id) => vec![manager.node_with_id(id).with_context(|| format!("no node has the ID number {id}"))?],
        None => manager.s_units(),
    };
    let mut number = number()?;
    let mut round_trips = Vec::with_capacity(calls);
    let cpu = proc::own_cpu_time()?;
    for peer in peers.iter().cycle().take(calls) {
        let began = Instant::now();
        peer.call("touch", &mut number).with(options()).wait()?;
        round_trips.push(began.elapsed().as_nanos() as u64);
    }
    Ok(Block::new(round_trips, proc::own_cpu_time()?.saturating_sub(cpu)))
}

fn counters(manager: &CommunicationSystem) -> Counters {
    manager.counters().into_iter().map(|(name, count)| (name.to_owned(), count)).collect()
}
