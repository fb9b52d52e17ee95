//! The processes of a manager and of many s_units, to see what a node costs.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use cara_bench_ends::{Place, answer_all, clock, pin, text};
use cara_std::keys::{FleetKeys, Store, location::file_name};
use cara_std::{
    Builder, CommunicationSystem, Constraints, Fleet, Identity, Interfaces, Parameters, ParametersView, Peer,
    RequestOptions, Served, ServiceError, Threads, Unit,
};
use clap::Args;
use serde::{Deserialize, Serialize};
use serde_json::json;

/// The manager's name and ID number.
const MANAGER: (&str, u32) = ("depot", 1);
/// The text that each node exchanges with the manager once before memory is looked at.
const TEXT_BYTES: u32 = 20_000;
/// How long one call may take.
const TIMEOUT: Duration = Duration::from_secs(20);

/// What these processes are told.
#[derive(Args)]
pub(crate) struct Nodes {
    #[command(flatten)]
    pub(crate) place: Place,
    /// How many nodes.
    #[arg(long)]
    pub(crate) count: u32,
    /// The CPU to stay on.
    #[arg(long)]
    pub(crate) cpu: Option<usize>,
    /// The folder of their keys; none for plain mode.
    #[arg(long)]
    pub(crate) keys: Option<PathBuf>,
}

/// What a manager's process is asked.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) enum Question {
    /// When all nodes are connected; an error where they are not in time.
    Connected { within_s: u64 },
    /// The long text to each node and back.
    Exchange,
    /// Resident memory in bytes.
    Resident,
    /// Round trips in nanoseconds of calls of the first node, or of each in turn.
    Block { calls: u32, each: bool },
}

/// Draws keys for the manager of run `run` and so many nodes, into a folder of their own.
pub(crate) fn draw_keys(run: u32, count: u32) -> Result<tempfile::TempDir> {
    let folder = tempfile::tempdir()?;
    let mut keys = FleetKeys::draw(Fleet(run))?;
    let manager = Identity::m_unit(MANAGER.0, MANAGER.1)?;
    keys.add(&manager, &[])?;
    let nodes = (0..count).map(|index| Identity::s_unit(&name(FIRST_ID + index), FIRST_ID + index));
    keys.add_all(&nodes.collect::<Result<Vec<_>, _>>()?, std::slice::from_ref(&manager))?;
    Store::create(folder.path(), keys)?.save()?;
    Ok(folder)
}

fn name(id: u32) -> String {
    format!("agv-{id}")
}

impl Nodes {
    fn placed<R>(&self, builder: Builder<(), R>, identity: &Identity) -> Builder<(), R> {
        let fleet = self.place.run;
        let builder = builder.fleet(fleet).discovery_port(self.place.discovery_port()).interfaces(Interfaces::Loopback);
        match &self.keys {
            Some(folder) => builder.key_file(folder.join(file_name(identity, Fleet(fleet)))),
            None => builder.insecure(),
        }
    }
}

/// The manager's process, with defaults but for the number of nodes.
pub(crate) fn manager(nodes: &Nodes) -> Result<()> {
    pin::stay_on(nodes.cpu)?;
    let constraints = Constraints { maximum_nodes: u16::try_from(nodes.count)?, ..Constraints::M_UNIT };
    let builder = CommunicationSystem::builder(MANAGER.0, MANAGER.1)?;
    let builder = nodes.placed(builder, &Identity::m_unit(MANAGER.0, MANAGER.1)?);
    let manager = builder.constraints(constraints).build()?;
    manager.start()?;
    answer_all(|question| {
        Ok(match question {
            Question::Connected { within_s } => json!(connected(&manager, nodes.count as usize, within_s)?),
            Question::Exchange => json!(exchange(&manager)?),
            Question::Resident => json!(clock::resident_bytes()?),
            Question::Block { calls, each } => json!(block(&manager, calls, each)?),
        })
    })
}

/// On the clock of [`clock::now`].
fn connected(manager: &CommunicationSystem, count: usize, within_s: u64) -> Result<u64> {
    let end = Instant::now() + Duration::from_secs(within_s);
    let mut joined = None;
    loop {
        let so_far = manager.number_of_s_units();
        if so_far >= count {
            let joined = *joined.get_or_insert_with(clock::now);
            if manager.nodes_offering("touch").len() >= count {
                return Ok(joined);
            }
        }
        if Instant::now() >= end {
            bail!("only {so_far} of {count} nodes joined within {within_s} s");
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn options() -> RequestOptions {
    RequestOptions { timeout: Some(TIMEOUT.into()), ..RequestOptions::default() }
}

fn exchange(manager: &CommunicationSystem) -> Result<()> {
    let (sent, mut parameters) = (text(TEXT_BYTES), text_parameters()?);
    for peer in manager.s_units() {
        parameters.set_value("text", sent.as_str())?;
        let outcome = peer.call("echo", &mut *parameters).with(options()).wait();
        outcome.with_context(|| format!("the long text to {}", peer.name()))?;
    }
    Ok(())
}

fn block(manager: &CommunicationSystem, calls: u32, each: bool) -> Result<Vec<u64>> {
    let peers: Vec<Peer> =
        if each { manager.s_units() } else { vec![manager.node_with_id(FIRST_ID).context("the first node has left")?] };
    let mut number = number()?;
    let mut round_trips = Vec::with_capacity(calls as usize);
    for peer in peers.iter().cycle().take(calls as usize) {
        let began = clock::now();
        peer.call("touch", &mut number).with(options()).wait()?;
        round_trips.push(clock::now() - began);
    }
    Ok(round_trips)
}

/// ID number of the first s_unit.
const FIRST_ID: u32 = 1;

/// The process of the s_units, with one set of threads for all; ends when its standard input does.
pub(crate) fn units(nodes: &Nodes) -> Result<()> {
    pin::stay_on(nodes.cpu)?;
    let threads = Threads::new()?;
    let units = (0..nodes.count).map(|index| unit(nodes, FIRST_ID + index, &threads));
    let units = units.collect::<Result<Vec<_>>>()?;
    let _ = std::io::stdin().lines().next();
    drop(units);
    Ok(())
}

fn unit(nodes: &Nodes, id: u32, threads: &Threads) -> Result<Unit> {
    let builder = Unit::builder(&name(id), id, MANAGER.0, MANAGER.1)?;
    let unit = nodes.placed(builder, &Identity::s_unit(&name(id), id)?).threads(threads).build()?;
    unit.my_function_list().add_function("echo", &*text_parameters()?, same)?;
    unit.my_function_list().add_function("touch", &number()?, same)?;
    unit.publish_my_function_list()?;
    unit.start()?;
    Ok(unit)
}

fn same(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    Ok(())
}

/// Argument and result of `echo`.
fn text_parameters() -> Result<Box<Parameters<{ TEXT_BYTES as usize + 1_024 }>>> {
    let mut text = Box::new(Parameters::sized());
    text.add_string("text", TEXT_BYTES)?;
    Ok(text)
}

/// Argument and result of `touch`.
fn number() -> Result<Parameters> {
    let mut number = Parameters::new();
    number.add_int("number", 1)?;
    Ok(number)
}
