//! One question, answered against a system of this process.

use std::collections::HashSet;
use std::ops::ControlFlow;
use std::sync::atomic::Ordering;
use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;

use cara_core::config::Constraints;
use cara_core::distribution::identity::Role;
use cara_core::error::Error;
use cara_core::services::access::Verb;
use cara_core::time::Duration;

use super::commands::Followed;
use super::failure::name_of;
use super::protocol::{Answer, CallQuestion, Failure, Question, unix_ms};
use super::sink::{End, LOOK, Lives, Sink, permit, send};
use super::stop::{self, Which};
use super::{call, constraint, describe, everybody, hold, select, stream};
use crate::{CommunicationSystem, Finding, HandOverError, Identity, Manager, NameAndId, Peer};

/// Events that wait to be written before some are lost.
const EVENTS: usize = 1024;
/// Of commands and calls, of which those of [`LOOK`] are read at once.
const COMMANDS: usize = 16 * 1024;
/// How long a refusal is shown. A node that still tries is refused again within [`LONGEST_SEARCH`](cara_core::config::LONGEST_SEARCH).
const REFUSED: Duration = Duration::from_secs(300);
/// Bytes of metrics in one answer.
#[cfg(feature = "metrics")]
const PIECE_BYTES: usize = 256 * 1024;
/// Answers one question: any number of answers, of which the last is [`Answer::Done`] or [`Answer::Failed`]. It returns
/// when all are given, or when `answer` says `Break`. It takes as long as what was asked for: a call until its reply, a
/// watch until the unit stops.
pub fn execute<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &Question,
    answer: &mut dyn FnMut(Answer) -> ControlFlow<()>,
) {
    execute_for(system, question, answer, &|| Some(Instant::now()));
}

/// As [`execute`], for a client elsewhere: `lives` says when it last sent something, or `None` once it has gone. What takes
/// long ends then: a watch, values of streams, a call. What a [`Question::Hold`] keeps moving ends as well when that was
/// longer ago than its lease: a gateway forwards its client's signs of life and makes none up.
pub fn execute_while<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &Question,
    answer: &mut dyn FnMut(Answer) -> ControlFlow<()>,
    lives: &dyn Fn() -> Option<Instant>,
) {
    execute_for(system, question, answer, lives);
}

/// As [`execute`]; a call or a watch ends as well when the client has gone.
pub(super) fn execute_for<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &Question,
    sink: Sink<'_>,
    lives: Lives<'_>,
) {
    // A client that is gone misses its last answer.
    let _ = match attempt(system, question, sink, lives) {
        Ok(()) => sink(Answer::Done),
        Err(End::Failed(failure)) => sink(Answer::Failed(failure)),
        Err(End::Gone) => ControlFlow::Break(()),
    };
}

fn attempt<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &Question,
    sink: Sink<'_>,
    lives: Lives<'_>,
) -> Result<(), End> {
    let wanted = &|| lives().is_some();
    match question {
        Question::Unit => send(sink, Answer::Unit(describe::unit(system))),
        Question::Nodes { offering } => nodes(system, offering.as_deref(), sink),
        // The connection has a role; a unit of this process is asked with all rights, unless its caller asks `Role::permit`.
        Question::As { .. } => {
            Err(Failure::configuration("BadQuestion", "only a connection to a control socket acts for somebody").into())
        }
        Question::Search => {
            system.broadcast();
            Ok(())
        }
        Question::Retire { node } => retire(system, node),
        Question::HandOver { node, to, timeout_ms } => {
            hand_over(system, node, to, Duration::from_millis(*timeout_ms), sink)
        }
        Question::Functions { node } => functions(system, node, sink),
        Question::Orders { node } => orders(system, node.as_deref(), sink),
        Question::Call(question) => {
            permit_call(system, question)?;
            match question.node {
                Some(_) => call::call(system, question, sink, wanted),
                None => {
                    everybody::call(system, &question.function, sink, |sink| call::call(system, question, sink, wanted))
                }
            }
        }
        Question::Hold(question) => {
            permit_call(system, question)?;
            hold::hold(system, question, sink, lives)
        }
        Question::Stop { node } => stop::call(system, Which::Stop, node.as_deref(), sink, wanted),
        Question::Reset { node } => stop::call(system, Which::Reset, node.as_deref(), sink, wanted),
        Question::Publish { node, timeout_ms } => {
            let own = system.my_function_list().names();
            own.iter().try_for_each(|function| permit(system, function, Verb::Publish))?;
            publish(system, node.as_deref(), Duration::from_millis(*timeout_ms), sink)
        }
        Question::Set { node, constraint, value } => {
            let constraints = set(system, node.as_deref(), constraint, *value)?;
            send(sink, Answer::Constraints(describe::constraints(&constraints)))
        }
        Question::Watch => watch(system, None, sink, wanted),
        Question::Commands => watch(system, Some(system.engine().commands().follow(COMMANDS)), sink, wanted),
        Question::Stream { node, name, interval_ms } => {
            stream::values(system, node, name.as_deref(), Duration::from_millis(*interval_ms), sink, wanted)
        }
        Question::Streams { interval_ms, names } => {
            stream::all(system, Duration::from_millis(*interval_ms), names, sink, wanted)
        }
        Question::Counters { node } => counters(system, node.as_deref(), sink),
        Question::Metrics => metrics(system, sink),
        Question::Ping { node, count, pause_us, timeout_ms } => {
            let times = (*count, Duration::from_micros(*pause_us), Duration::from_millis(*timeout_ms));
            call::ping(system, node, times, sink)
        }
    }
}

fn permit_call<T: Send + 'static>(system: &CommunicationSystem<T>, question: &CallQuestion) -> Result<(), Failure> {
    permit(system, &question.function, Verb::Call)?;
    if question.take_over { permit(system, &question.function, Verb::TakeOver) } else { Ok(()) }
}

fn nodes<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    offering: Option<&str>,
    sink: Sink<'_>,
) -> Result<(), End> {
    let all = match offering {
        Some(function) if !system.operator_sees(function) => {
            return Err(Failure::not_allowed(function, Verb::List).into());
        }
        Some(function) => system.nodes_offering(function),
        None => select::nodes(system),
    };
    let roster = system.roster();
    let roster: HashSet<&Identity> = roster.iter().map(Peer::identity).collect();
    for peer in &all {
        send(sink, Answer::Node(describe::node(peer, roster.contains(peer.identity()))))?;
    }
    // A refusal of a node that is connected now is out of date; a later refusal of a duplicate of it is not.
    let has_joined_since = |finding: &Finding| {
        let peer = finding.identity.as_ref().and_then(|identity| system.node(identity));
        peer.and_then(|peer| peer.connected_for()).is_some_and(|connected| connected < system.age(finding))
    };
    // Managers that stand by for each other meet now and then, and settle it.
    let (own, stands_by) = (system.identity(), system.engine().claims.stands_by());
    let is_of_pair = |finding: &Finding| stands_by && finding.identity.as_ref() == Some(&own);
    let is_over = |finding: &Finding| system.age(finding) > REFUSED || has_joined_since(finding) || is_of_pair(finding);
    for finding in system.findings().into_iter().filter(|finding| !is_over(finding)) {
        send(sink, Answer::Refused(describe::refused(&finding, system.age(&finding))))?;
    }
    Ok(())
}

fn retire<T: Send + 'static>(system: &CommunicationSystem<T>, node: &str) -> Result<(), End> {
    let peer = select::node(system, node)?;
    if peer.retire() {
        return Ok(());
    }
    let text = format!("{} is connected: only one that is absent is taken off the roster", peer.identity());
    Err(Failure::configuration("Connected", text).into())
}

fn hand_over<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    node: &str,
    to: &str,
    timeout: Duration,
    sink: Sink<'_>,
) -> Result<(), End> {
    let started = Instant::now();
    let named: NameAndId = to.parse().map_err(|error| Failure::configuration("BadName", error))?;
    let to = Manager::new(&named.name, named.id)?;
    let peer = select::node(system, node)?;
    if peer.identity().role() == Role::MUnit {
        let text = format!("{} is an m_unit: only s_units belong to a manager", peer.identity());
        return Err(Failure::configuration("NoVehicle", text).into());
    }
    let outcome = match peer.is_connected() {
        true => peer.hand_over(&to, timeout).map_err(not_handed_over),
        false => Err(everybody::not_called(&peer, None)),
    };
    send(sink, call::called(&peer, outcome.map(|()| call::Outcome::default()), started))
}

/// Of a vehicle that was connected.
fn not_handed_over(error: HandOverError) -> Failure {
    match error {
        HandOverError::Refused(refusal) => Failure::peer(&name_of(&refusal), refusal),
        HandOverError::Link(Error::NotConnected | Error::TimedOut) => {
            let text = "it was lost before its answer, or does not answer, as boards do: it may be on its way; `cara scan` shows it \
                        at the manager that has it";
            Failure::peer("NotKnown", text)
        }
        HandOverError::Link(error) => error.into(),
    }
}

fn functions<T: Send + 'static>(system: &CommunicationSystem<T>, node: &str, sink: Sink<'_>) -> Result<(), End> {
    let peer = select::node(system, node)?;
    if !peer.is_connected() {
        return Err(Error::NotConnected.into());
    }
    let functions = peer.their_function_list();
    let mut seen = functions.iter().filter(|function| system.operator_sees(function.definition.name()));
    seen.try_for_each(|function| send(sink, Answer::Function(describe::function(function))))
}

fn orders<T: Send + 'static>(system: &CommunicationSystem<T>, node: Option<&str>, sink: Sink<'_>) -> Result<(), End> {
    let peers = match node {
        Some(node) => vec![select::node(system, node)?],
        None => select::nodes(system),
    };
    if node.is_some() && !peers.iter().all(Peer::is_connected) {
        return Err(Error::NotConnected.into());
    }
    for peer in &peers {
        let functions = peer.their_function_list();
        let moves = functions.iter().filter(|function| function.attributes.lease.is_some());
        let mut seen = moves.filter(|function| system.operator_sees(function.definition.name()));
        seen.try_for_each(|function| {
            send(sink, Answer::Order(describe::order(system.identity().id(), peer, function.definition.name())))
        })?;
    }
    Ok(())
}

fn publish<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    node: Option<&str>,
    timeout: Duration,
    sink: Sink<'_>,
) -> Result<(), End> {
    let unread = match node {
        None => system.publish_and_wait(timeout)?,
        Some(node) => {
            let peer = select::node(system, node)?;
            match peer.publish_and_wait(timeout) {
                Ok(()) => Vec::new(),
                Err(Error::TimedOut) => vec![peer.identity().clone()],
                Err(error) => return Err(error.into()),
            }
        }
    };
    unread
        .iter()
        .try_for_each(|identity| send(sink, Answer::Unread { node: identity.name().to_owned(), id: identity.id() }))
}

fn set<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    node: Option<&str>,
    name: &str,
    value: u64,
) -> Result<Constraints, Failure> {
    let Some(node) = node else {
        let changed = constraint::changed(system.constraints(), name, value)?;
        system.set_constraints(changed).map_err(|error| constraint::refused(error, name, value))?;
        return Ok(system.constraints());
    };
    let peer = select::node(system, node)?;
    constraint::check_for_one(name)?;
    let changed = constraint::changed(peer.constraints(), name, value)?;
    peer.set_constraints(changed).map_err(|error| constraint::refused(error, name, value))?;
    Ok(peer.constraints())
}

/// Events as they come, and commands, where they are followed.
fn watch<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    mut commands: Option<Followed>,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let (events, lost) = system.events_with_losses(EVENTS);
    let notify = |event: &str, text: String| Answer::Event {
        at_ms: system.uptime().as_millis(),
        unix_ms: unix_ms(),
        event: event.to_owned(),
        node: None,
        text,
    };
    send(sink, notify("watching", "events from here on".to_owned()))?;
    loop {
        match events.recv_timeout(LOOK) {
            Ok(event) => send(sink, describe::event(&event, system.uptime()))?,
            Err(RecvTimeoutError::Timeout) if system.is_stopped() => return Ok(()),
            Err(RecvTimeoutError::Timeout) if !wanted() => return Err(End::Gone),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
        let missed = lost.swap(0, Ordering::Relaxed);
        if missed > 0 {
            send(sink, notify("lost", format!("{missed} events came faster than they were read")))?;
        }
        let Some(commands) = &mut commands else { continue };
        let (mut commands, missed) = commands.take();
        commands.try_for_each(|command| send(sink, command))?;
        if missed > 0 {
            send(sink, notify("lost", format!("{missed} commands came faster than they were read")))?;
        }
    }
}

fn counters<T: Send + 'static>(system: &CommunicationSystem<T>, node: Option<&str>, sink: Sink<'_>) -> Result<(), End> {
    let peers = match node {
        Some(node) => vec![select::node(system, node)?],
        None => {
            send(sink, Answer::Counters { node: None, counters: named(system.counters()) })?;
            select::nodes(system).into_iter().filter(|peer| peer.is_connected()).collect()
        }
    };
    peers.iter().try_for_each(|peer| {
        let counters = named(peer.counters());
        send(sink, Answer::Counters { node: Some(peer.identity().to_string()), counters })
    })
}

#[cfg(feature = "metrics")]
fn metrics<T: Send + 'static>(system: &CommunicationSystem<T>, sink: Sink<'_>) -> Result<(), End> {
    let text = system.metrics();
    pieces(&text, PIECE_BYTES).try_for_each(|piece| send(sink, Answer::Metrics { text: piece.to_owned() }))
}

/// Splits the text into pieces of whole lines: with many nodes it is longer than an answer may be.
#[cfg(feature = "metrics")]
fn pieces(mut text: &str, bytes: usize) -> impl Iterator<Item = &str> {
    std::iter::from_fn(move || {
        let from = text.floor_char_boundary(bytes);
        let end = text.get(from..).and_then(|rest| rest.find('\n')).map_or(text.len(), |end| from + end + 1);
        let (piece, rest) = text.split_at_checked(end)?;
        text = rest;
        (!piece.is_empty()).then_some(piece)
    })
}

#[cfg(not(feature = "metrics"))]
fn metrics<T: Send + 'static>(_: &CommunicationSystem<T>, _: Sink<'_>) -> Result<(), End> {
    let text = "the unit is built without metrics: build it with the feature `metrics` of cara-std";
    Err(Failure::configuration("NoMetrics", text).into())
}

fn named(counters: Vec<(&'static str, u64)>) -> Vec<(String, u64)> {
    counters.into_iter().map(|(name, count)| (name.to_owned(), count)).collect()
}

#[cfg(all(test, feature = "metrics"))]
mod tests {
    use super::pieces;

    #[test]
    fn pieces_are_whole_lines_and_lose_nothing() {
        for text in ["", "one\n", "one", "ä\nzwei\n\ndrei\n", "a\nb\nc\nd"] {
            for bytes in 0..12 {
                let all: Vec<&str> = pieces(text, bytes).collect();
                assert_eq!(all.concat(), text, "{bytes}");
                let (_, whole) = all.split_last().unwrap_or((&"", &[]));
                assert!(whole.iter().all(|piece| piece.ends_with('\n')), "{all:?}");
            }
        }
        assert_eq!(pieces("a\nb\nc\n", 2).collect::<Vec<_>>(), ["a\nb\n", "c\n"]);
    }
}
