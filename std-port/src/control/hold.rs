//! A call whose lease is kept for as long as whoever asked for it stays: the operator is the dead man's handle.

use std::sync::mpsc::RecvTimeoutError;
use std::time::Instant;

use super::answering::{End, LOOK, Sink, send};
use super::call::{call_one, called, options};
use super::protocol::{Answer, CallQuestion, Failure};
use super::select;
use crate::{CommunicationSystem, Peer, RequestOptions, UnitEvent};

/// Events that wait while the call is made.
const EVENTS: usize = 1024;

/// Calls one node, keeps the lease until what was started has ended there, and gives it up when `wanted` says no.
pub(super) fn hold<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &CallQuestion,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let peer = held_node(system, question)?;
    let function = question.function.as_str();
    let options = RequestOptions { renew_lease: true, ..options(question)? };
    // Before the call: it may be finished before it is answered.
    let events = system.events_with_losses(EVENTS).0;
    let mut held = Held { peer: &peer, function, ended: false };
    let started = Instant::now();
    let outcome = call_one(&peer, question, &options);
    held.ended = outcome.is_err();
    send(sink, called(&peer, outcome, started))?;
    while !held.ended {
        match events.recv_timeout(LOOK) {
            Ok(event) => {
                if let Some(expired) = held.end(&event) {
                    held.ended = true;
                    send(sink, Answer::Ended { expired })?;
                }
            }
            Err(RecvTimeoutError::Timeout) if wanted() && !system.is_stopped() => {}
            Err(_) => return Err(End::Gone),
        }
    }
    Ok(())
}

fn held_node<T: Send + 'static>(system: &CommunicationSystem<T>, question: &CallQuestion) -> Result<Peer<T>, Failure> {
    let Some(node) = &question.node else {
        return Err(Failure::configuration("BadQuestion", "name the node whose lease is kept"));
    };
    let peer = select::node(system, node)?;
    let leased = peer.function(&question.function).is_none_or(|function| function.attributes.lease.is_some());
    if !leased {
        let text = format!("'{}' has no lease that could be kept: call it without", question.function);
        return Err(Failure::configuration("NoLease", text));
    }
    Ok(peer)
}

/// A lease that is kept; given up when it goes, however that comes.
struct Held<'h, T: Send + 'static> {
    peer: &'h Peer<T>,
    function: &'h str,
    ended: bool,
}

impl<T: Send + 'static> Held<'_, T> {
    /// Whether the event is the end of what was started, and whether it was cut short.
    fn end(&self, event: &UnitEvent) -> Option<bool> {
        match event {
            UnitEvent::LeaseEnded { peer, function, expired }
                if peer == self.peer.identity() && function == self.function =>
            {
                Some(*expired)
            }
            UnitEvent::Left { peer, .. } if peer == self.peer.identity() => Some(true),
            _ => None,
        }
    }
}

impl<T: Send + 'static> Drop for Held<'_, T> {
    fn drop(&mut self) {
        if !self.ended {
            // A node that is gone has no lease.
            let _ = self.peer.release(self.function);
        }
    }
}
