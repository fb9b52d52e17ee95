//! A call whose lease is kept for as long as whoever asked for it stays: the operator is the dead man's handle.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{LazyLock, Mutex};
use std::time::Instant;

use cara_core::distribution::identity::Identity;
use cara_core::services::access::Verb;

use super::answering::{End, LOOK, Sink, send};
use super::call::{call_one, called, options};
use super::protocol::{Answer, CallQuestion, Failure};
use super::select;
use crate::engine::lock;
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
    let mut held = Held { peer: &peer, function, ended: false, turn: None };
    let started = Instant::now();
    let outcome = call_one(&peer, question, &options);
    held.ended = outcome.is_err();
    if !held.ended {
        // From here on the lease is this call's, whoever held it before.
        held.turn = Some(Turn::take((system.epoch().0, peer.identity().clone(), function.to_owned())));
    }
    send(sink, called(&peer, outcome, started))?;
    while !held.ended {
        if held.is_taken_over() {
            held.ended = true;
            let text = format!("another call of '{function}' took over what was held at {}", peer.identity());
            return Err(Failure::resource("TakenOver", text).into());
        }
        // The table may have changed since.
        if !system.operator_may_go_on(function) {
            return Err(Failure::not_allowed(function, Verb::Call).into());
        }
        // Before each event: however many there are, who has gone away holds nothing any more.
        if !wanted() || system.is_stopped() {
            return Err(End::Gone);
        }
        match events.recv_timeout(LOOK) {
            Ok(event) => {
                if let Some(expired) = held.end(&event) {
                    held.ended = true;
                    send(sink, Answer::Ended { expired })?;
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Err(End::Gone),
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
    turn: Option<Turn>,
}

/// A unit by its epoch, a node, and its function.
type Lease = (u64, Identity, String);

/// Whose turn it is to hold each lease: a unit has one for a function of a node, however many calls want to keep it.
static TURNS: LazyLock<Mutex<HashMap<Lease, u64>>> = LazyLock::new(Mutex::default);
static NEXT: AtomicU64 = AtomicU64::new(0);

/// The right to give a lease up, until the next call takes it.
struct Turn {
    lease: Lease,
    number: u64,
}

impl Turn {
    fn take(lease: Lease) -> Self {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        lock(&TURNS).insert(lease.clone(), number);
        Self { lease, number }
    }

    fn is_over(&self) -> bool {
        lock(&TURNS).get(&self.lease) != Some(&self.number)
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let mut turns = lock(&TURNS);
        if turns.get(&self.lease) == Some(&self.number) {
            turns.remove(&self.lease);
        }
    }
}

impl<T: Send + 'static> Held<'_, T> {
    fn is_taken_over(&self) -> bool {
        self.turn.as_ref().is_some_and(Turn::is_over)
    }

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
        if !self.ended && !self.is_taken_over() {
            // A node that is gone has no lease.
            let _ = self.peer.release(self.function);
        }
    }
}
