//! An m_unit of this process, for the time of a command.

use std::time::{Duration, Instant};

use cara_std::control::Control;
use cara_std::control::protocol::FunctionInfo;
use cara_std::survey::Survey;
use cara_std::{BuildError, Builder, CommunicationSystem, Constraints, Fleet, Mode};

use super::{Need, Operator, running};
use crate::nodes::{self, Chosen};
use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::listening;
use cara_tools::name_and_id::NameAndId;
use cara_tools::output;
use cara_tools::units::show_micros;

/// Most nodes of such a unit: enough for a whole fleet.
const MAXIMUM_NODES: u16 = 1024;
/// How long a unit of the same name and ID may take to answer on the network.
const DUPLICATE: Duration = Duration::from_millis(500);
/// All nodes have joined when none joined for so long.
const QUIET: Duration = Duration::from_millis(1500);
/// Interval between two looks at the nodes that have joined.
const LOOK: Duration = Duration::from_millis(20);
/// How long requests that need no reply are given to leave.
const LEAVE: Duration = Duration::from_millis(300);

/// Starts it, unless a unit of its name and ID is there already.
pub(super) fn start(identity: &NameAndId, global: &Global) -> anyhow::Result<CommunicationSystem> {
    refuse_if_it_runs(identity, global)?;
    refuse_if_it_answers(identity, global)?;
    let builder = CommunicationSystem::builder(&identity.name, identity.id)
        .map_err(|error| Ended::usage(format!("{identity}: {error}")))?;
    let constraints = Constraints { maximum_nodes: MAXIMUM_NODES, ..Constraints::M_UNIT };
    let builder = builder.fleet(global.fleet.unwrap_or(0)).interfaces(global.interfaces());
    let builder = global.discovery_port.into_iter().fold(builder, Builder::discovery_port);
    let builder = builder.constraints(constraints).control(Control::Off).tcp_port(global.as_port.unwrap_or(0));
    let keys = global.keys().unwrap_or_default();
    let system = keys.given_to(builder).build().map_err(|error| match error {
        BuildError::Keys(error) => cara_tools::keys::failed(error),
        BuildError::Unit(error) => network(error),
        other => Ended::failed("Failed", other.to_string()),
    })?;
    if system.mode() == Mode::Plain {
        output::warning(format_args!(
            "{identity} is in plain mode, on port {}: every host on the network can read what it says, and speak as any unit",
            system.discovery_port()
        ));
    }
    system.start().map_err(Ended::not_started)?;
    Ok(system)
}

fn network(error: cara_std::Error) -> anyhow::Error {
    Ended::failed(format!("{error:?}"), error.to_string())
}

/// A unit of this host that has a control socket.
fn refuse_if_it_runs(identity: &NameAndId, global: &Global) -> anyhow::Result<()> {
    if !running::runs(identity, global.fleet.unwrap_or(0))? {
        return Ok(());
    }
    let text = format!(
        "{identity} runs on this host, and cara does not act as a manager behind its back: leave out --as to ask it \
         (without --as, --unit {identity})"
    );
    Err(Ended::usage(text))
}

/// A unit of another host, or one without a control socket.
fn refuse_if_it_answers(identity: &NameAndId, global: &Global) -> anyhow::Result<()> {
    // Where nothing can be heard, or keys cannot be read, the start will say so.
    let survey = listening::keys(global).and_then(|keys| listening::open(global, keys));
    let Ok(mut survey) = survey else { return Ok(()) };
    let fleet = Fleet(global.fleet.unwrap_or(0));
    let is_it = |survey: &Survey| {
        let duplicate = survey.heard().iter().find(|heard| {
            let same = heard.identity.as_ref().is_some_and(|other| {
                // A vehicle of the same name and ID would be mistaken for it, too.
                other.name() == identity.name && other.id() == identity.id
            });
            same && heard.fleet == fleet
        });
        duplicate.map(|duplicate| duplicate.source)
    };
    survey.ask(fleet);
    survey.listen_until(Instant::now().checked_add(DUPLICATE), |survey| is_it(survey).is_some());
    match is_it(&survey) {
        None => Ok(()),
        Some(source) => Err(Ended::usage(format!(
            "{identity} answers at {}, and cara does not act as a manager behind its back: run cara on that host, or \
             choose another --as",
            source.ip()
        ))),
    }
}

/// Waits for what a command is about, at most for `span`. What is missing then is for the command to say.
pub(super) fn wait_for(operator: &mut Operator, need: &Need, span: Duration) -> anyhow::Result<()> {
    let start = Instant::now();
    let mut seen = (Vec::new(), start);
    while start.elapsed() < span && !is_met(operator, need, &mut seen)? {
        std::thread::sleep(LOOK);
    }
    Ok(())
}

/// The nodes that were seen, with how much each has published, and since when that has not changed.
type Seen = (Vec<(String, usize)>, Instant);

fn is_met(operator: &mut Operator, need: &Need, seen: &mut Seen) -> anyhow::Result<bool> {
    match *need {
        Need::Nothing => Ok(true),
        Need::UnitOrNode(meant) => Ok(operator.is_itself(meant)? || is_there(operator, meant)?.is_some()),
        Need::Node(meant) => Ok(is_there(operator, meant)?.is_some_and(|node| node.node.functions > 0)),
        Need::Function(meant, function) => match is_there(operator, meant)? {
            Some(node) => Ok(offers(&nodes::functions(operator, &node.selector)?, function)),
            None => Ok(false),
        },
        Need::Everybody => settled(operator, None, seen),
        Need::Offering(function) => settled(operator, Some(function), seen),
    }
}

fn offers(functions: &[FunctionInfo], wanted: &str) -> bool {
    functions.iter().any(|function| function.name == wanted)
}

fn is_there(operator: &mut Operator, meant: &str) -> anyhow::Result<Option<Chosen>> {
    // Not yet there is no error while it is waited for.
    Ok(nodes::connected(operator, meant).ok())
}

/// Whether a node is connected and nothing has changed for [`QUIET`].
fn settled(operator: &mut Operator, offering: Option<&str>, (seen, since): &mut Seen) -> anyhow::Result<bool> {
    let all = nodes::all(operator, offering)?;
    let now: Vec<_> =
        all.iter().filter(|node| node.connected).map(|node| (nodes::full_name(node), node.functions)).collect();
    if now != *seen {
        (*seen, *since) = (now, Instant::now());
    }
    Ok(!seen.is_empty() && since.elapsed() >= QUIET)
}

/// One-way requests that gather leave, and get there before the unit says goodbye.
pub(super) fn deliver(system: &CommunicationSystem) {
    for peer in system.s_units().iter().chain(&system.m_units()) {
        // Fails for a peer that has left.
        let _ = peer.flush();
    }
    std::thread::sleep(LEAVE);
}

/// How long was waited, for an error.
pub(super) fn within(waited: Option<Duration>) -> String {
    waited.map(|span| format!(" (waited {})", show_micros(span.as_micros() as f64))).unwrap_or_default()
}
