//! A stop or a reset by an operator: each function with that attribute, of one node or of the whole roster, at the same time.
//! A stop is carried out to its end whether or not its client is there and reads. Where its call cannot be made, or is not
//! answered soon, it is sent one way as well, as a datagram and in the stream.

use std::collections::{HashMap, HashSet};
use std::time::Instant;

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::services::access::Verb;
use cara_core::services::call::Caller;

use super::call::{News, block_all, called, prepare};
use super::everybody::not_called;
use super::protocol::{Answer, CallQuestion, Failure};
use super::select;
use super::sink::{End, Sink, permit, send};
use crate::{CommunicationSystem, Delivery, Identity, Peer, RequestOptions};

/// Which functions are called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Which {
    Stop,
    Reset,
}

impl Which {
    const fn has(self, attributes: &Attributes) -> bool {
        match self {
            Self::Stop => attributes.stop,
            Self::Reset => attributes.reset,
        }
    }

    fn missing(self) -> Failure {
        let (error, does) = match self {
            Self::Stop => ("NoStop", "stops"),
            Self::Reset => ("NoReset", "resets"),
        };
        Failure::peer(error, format!("it has published no function that {does}"))
    }
}

/// What has come of a node.
struct Outcome<'p, T: Send + 'static> {
    peer: &'p Peer<T>,
    /// Those that are called.
    functions: Vec<String>,
    /// Functions that have not answered.
    open: usize,
    error: Option<Failure>,
    /// A call of it was sent one way as well.
    is_one_way: bool,
}

/// An [`Answer::Called`] for each node, once all its functions that stop (or reset) have answered. What could not be called is
/// told last: calls come first.
pub(super) fn call<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    which: Which,
    node: Option<&str>,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let started = Instant::now();
    let peers = match node {
        Some(node) => vec![select::node(system, node)?],
        None => everybody(system, which),
    };
    let mut allowed = HashMap::new();
    let (mut questions, mut outcomes, mut missed) = (Vec::new(), Vec::new(), Vec::new());
    for peer in &peers {
        let mut outcome = Outcome { peer, functions: Vec::new(), open: 0, error: None, is_one_way: false };
        match functions(peer, which) {
            Err(failure) => outcome.error = Some(failure),
            Ok(functions) => {
                outcome.functions.clone_from(&functions);
                for function in functions {
                    let may = allowed.entry(function.clone()).or_insert_with(|| permit(system, &function, Verb::Call));
                    match may {
                        Ok(()) => {
                            questions.push((outcomes.len(), CallQuestion { function, ..CallQuestion::default() }));
                            outcome.open += 1;
                        }
                        Err(failure) => outcome.error = Some(failure.clone()),
                    }
                }
            }
        }
        if outcome.open > 0 { outcomes.push(outcome) } else { missed.push(outcome) }
    }
    let options = RequestOptions { priority: Some(Priority::Emergency), operator: true, ..RequestOptions::default() };
    let calls: Vec<_> = questions.iter().filter_map(|(of, call)| Some((outcomes.get(*of)?.peer, call))).collect();
    let is_stop = which == Which::Stop;
    let mut notify = |outcome: &Outcome<'_, T>| match reported(outcome, started, sink) {
        Err(_) if is_stop => Ok(()),
        reported => reported,
    };
    block_all(&calls, &options, &|| is_stop || wanted(), &mut |number, news| {
        let Some((of, question)) = questions.get(number) else { return Ok(()) };
        let Some(outcome) = outcomes.get_mut(*of) else { return Ok(()) };
        match news {
            News::Late if is_stop => outcome.is_one_way |= send_one_way(outcome.peer, question, &options),
            News::Late => {}
            News::Answer(answer) => {
                let Answer::Called { error, .. } = *answer else { return Ok(()) };
                outcome.open -= 1;
                outcome.error = outcome.error.take().or(error);
                if outcome.open == 0 {
                    return notify(outcome);
                }
            }
        }
        Ok(())
    })?;
    missed.iter().try_for_each(notify)
}

/// Whether it has left, one way or the other: nothing acknowledges it.
fn send_one_way<T: Send + 'static>(peer: &Peer<T>, question: &CallQuestion, options: &RequestOptions) -> bool {
    let Ok(prepared) = prepare(peer, question) else { return false };
    let ways = [Delivery::BestEffort, Delivery::Reliable].map(|delivery| {
        let options = RequestOptions { delivery, ..*options };
        peer.send(question.function.as_str().into(), &prepared.parameters, &options).is_ok()
    });
    ways.contains(&true)
}

/// The whole roster, and any other node that can be stopped (or reset).
fn everybody<T: Send + 'static>(system: &CommunicationSystem<T>, which: Which) -> Vec<Peer<T>> {
    let mut all = system.roster();
    let others = select::nodes(system).into_iter().filter(|peer| functions(peer, which).is_ok());
    let known: HashSet<Identity> = all.iter().map(|peer| peer.identity().clone()).collect();
    all.extend(others.filter(|peer| !known.contains(peer.identity())));
    all
}

/// The names of the functions that are called; why there are none.
fn functions<T: Send + 'static>(peer: &Peer<T>, which: Which) -> Result<Vec<String>, Failure> {
    if !peer.is_connected() {
        return Err(not_called(peer, None));
    }
    let list = peer.their_function_list();
    let meant = list.iter().filter(|function| which.has(&function.attributes));
    let names: Vec<String> = meant.map(|function| function.definition.name().to_owned()).collect();
    if names.is_empty() { Err(which.missing()) } else { Ok(names) }
}

fn reported<T: Send + 'static>(outcome: &Outcome<'_, T>, started: Instant, sink: Sink<'_>) -> Result<(), End> {
    let sent = "it was sent one way as well, which nothing acknowledges: look whether the node stands";
    let error = outcome.error.clone().map(|error| if outcome.is_one_way { error.and(sent) } else { error });
    let mut answer = called(outcome.peer, error.map_or_else(|| Ok(Default::default()), Err), started);
    if let Answer::Called { functions, .. } = &mut answer {
        functions.clone_from(&outcome.functions);
    }
    send(sink, answer)
}
