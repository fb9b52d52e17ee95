//! A call whose lease is renewed as of the last sign of life of the operator's client: the operator is the dead man's handle.
//! The thread that watches the client beats the heart, and only for what the client has sent: if this thread hangs, or the
//! client does, nothing renews.

use std::cell::{Cell, RefCell};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use cara_core::error::CloseReason;
use cara_core::services::access::Verb;
use cara_core::services::call::Caller;
use cara_core::services::lease::LeaseEnd;

use super::call::{await_one, called, options};
use super::protocol::{Answer, BEAT, CallQuestion, Failure};
use super::select;
use super::sink::{End, LOOK, Lives, Sink, send};
use crate::heart::Hold;
use crate::{CommunicationSystem, Peer, RequestOptions, UnitEvent};

/// Events that wait while the call is made.
const EVENTS: usize = 1024;
/// So long the event of a lease's end may be on its way.
const PATIENCE: Duration = Duration::from_secs(1);

/// Calls one node and renews the lease until what it started has ended there. Gives the lease up when the client has
/// gone, or has sent no heartbeat for the length of the lease.
pub(super) fn hold<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &CallQuestion,
    sink: Sink<'_>,
    lives: Lives<'_>,
) -> Result<(), End> {
    let peer = held_node(system, question)?;
    let lease = lease_of(&peer, &question.function);
    let heart = RefCell::new(system.heart(BEAT));
    let options = RequestOptions { renew: heart.borrow().renew(), ..options(question)? };
    let last_beat = Cell::new(None);
    // Before the call: it may be finished before it is answered.
    let events = system.events_with_losses(EVENTS).0;
    let is_wanted = || {
        let last = lives();
        if last.is_some() && last_beat.replace(last) != last {
            heart.borrow_mut().beat();
        }
        last.is_some_and(|last| lease.is_none_or(|lease| last.elapsed() < lease)) && !system.is_stopped()
    };
    let gone = || match lives() {
        Some(_) if !system.is_stopped() => unattended(&question.function).into(),
        _ => End::Gone,
    };
    let is_silent = || lives().zip(lease).is_none_or(|(last, lease)| last.elapsed() > lease / 2);
    // The question is a sign of life as well, and the call needs a heart that beats.
    if !is_wanted() {
        return Err(gone());
    }
    let started = Instant::now();
    let mut held = match await_one(&peer, question, &options, sink, &is_wanted) {
        Err(End::Gone) => return Err(gone()),
        Err(end) => return Err(end),
        Ok(Ok((outcome, call))) => {
            let held = Held { peer: &peer, order: peer.hold(call), lost: None };
            send(sink, called(&peer, Ok(outcome), started))?;
            held
        }
        Ok(Err(failure)) => return send(sink, called(&peer, Err(failure), started)),
    };
    loop {
        // The table may have changed since.
        if !system.operator_may_go_on(&question.function) {
            return Err(Failure::not_allowed(&question.function, Verb::Call).into());
        }
        // Checked before each event, so that a stream of events does not delay the end of a gone client's lease.
        if !is_wanted() {
            return Err(gone());
        }
        let end = match events.recv_timeout(LOOK) {
            Ok(event) => held.end(&event),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return Err(End::Gone),
        };
        match end.or_else(|| held.has_given_way().then_some(LeaseEnd::Replaced)) {
            None => {}
            Some(LeaseEnd::Replaced) => {
                let text =
                    format!("another call of '{}' took over what was held at {}", question.function, peer.identity());
                return Err(Failure::resource("TakenOver", text).into());
            }
            // It expired there since nothing was renewed here.
            Some(LeaseEnd::Expired) if is_silent() => return Err(gone()),
            Some(why) => return send(sink, Answer::Ended { expired: why != LeaseEnd::Finished }),
        }
    }
}

fn held_node<T: Send + 'static>(system: &CommunicationSystem<T>, question: &CallQuestion) -> Result<Peer<T>, Failure> {
    let Some(node) = &question.node else {
        return Err(Failure::configuration("BadQuestion", "name the node whose lease is kept"));
    };
    if question.asynchronous {
        return Err(Failure::configuration(
            "BadQuestion",
            "a call whose lease is kept is waited for: ask without asynchronous",
        ));
    }
    let peer = select::node(system, node)?;
    if peer.function(&question.function).is_some() && lease_of(&peer, &question.function).is_none() {
        let text = format!("'{}' has no lease that could be kept: call it without", question.function);
        return Err(Failure::configuration("NoLease", text));
    }
    Ok(peer)
}

/// The length of a function's lease.
pub(super) fn lease_of<T: Send + 'static>(peer: &Peer<T>, function: &str) -> Option<Duration> {
    Some(peer.function(function)?.attributes.lease?.into())
}

pub(super) fn unattended(function: &str) -> Failure {
    let text =
        format!("the client gave no sign of life for the length of the lease of '{function}', which was given up");
    Failure::resource("Unattended", text)
}

/// A renewed lease, given up on drop. Nothing is sent for one that has ended there, or that a newer call has taken over.
struct Held<'h, T: Send + 'static> {
    peer: &'h Peer<T>,
    order: Hold<T>,
    /// Since when it is no longer renewed, without an event that says why.
    lost: Option<Instant>,
}

impl<T: Send + 'static> Held<'_, T> {
    /// Why what was started has ended, if the event is its end.
    fn end(&self, event: &UnitEvent) -> Option<LeaseEnd> {
        match event {
            UnitEvent::LeaseEnded { peer, call, why, .. }
                if peer == self.peer.identity() && *call == self.order.call.id =>
            {
                Some(*why)
            }
            // The end of this unit is no end of the node.
            UnitEvent::Left { reason: CloseReason::StoppedHere, .. } => None,
            UnitEvent::Left { peer, .. } if peer == self.peer.identity() => Some(LeaseEnd::Expired),
            _ => None,
        }
    }

    /// Whether newer calls have taken its place in the table of leases that this unit renews.
    fn has_given_way(&mut self) -> bool {
        if self.order.is_held() {
            return false;
        }
        self.lost.get_or_insert_with(Instant::now).elapsed() > PATIENCE
    }
}
