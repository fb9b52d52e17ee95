//! A call of all nodes, with an outcome for each, including those that could not be called.

use std::collections::HashSet;
use std::ops::ControlFlow;

use super::describe;
use super::protocol::{Answer, Failure};
use super::sink::{End, Sink, send};
use crate::{CommunicationSystem, Peer};

/// Makes the call, and then reports each node that it has not reached.
pub(super) fn call<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    function: &str,
    sink: Sink<'_>,
    call: impl FnOnce(Sink<'_>) -> Result<(), End>,
) -> Result<(), End> {
    let mut reported = HashSet::new();
    let outcome = call(&mut |answer: Answer| -> ControlFlow<()> {
        if let Answer::Called { node, id, .. } = &answer {
            reported.insert((node.clone(), *id));
        }
        sink(answer)
    });
    let asked = system.asked_with_all(function);
    let missed = asked.iter().filter(|peer| !reported.contains(&(peer.name().to_owned(), peer.id())));
    match outcome {
        Ok(()) => {}
        // No node offers it: each of the roster is told of instead.
        Err(End::Failed(failure)) if failure.error == "UnknownFunction" && !asked.is_empty() => {}
        Err(end) => return Err(end),
    }
    missed.clone().try_for_each(|peer| send(sink, missing(peer, function)))
}

/// Why a call of all skipped a node.
pub(super) fn not_called<T: Send + 'static>(peer: &Peer<T>, lacks: Option<&str>) -> Failure {
    let failure = Failure::not_called(lacks);
    match describe::under(peer) {
        Some(under) => failure.and(under),
        None => failure,
    }
}

fn missing<T: Send + 'static>(peer: &Peer<T>, function: &str) -> Answer {
    let lacks_it = peer.is_connected() && !peer.their_function_list().contains(function);
    let failure = not_called(peer, lacks_it.then_some(function));
    let (node, id) = (peer.name().to_owned(), peer.id());
    let (results, functions) = (Vec::new(), Vec::new());
    Answer::Called { node, id, results, call: None, error: Some(failure), took_us: 0, functions }
}
