//! Calls that an operator makes: to one node or to all, once or again and again.

use std::ops::ControlFlow;
use std::task::{Context, Poll};
use std::time::Instant;

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Cause, Error};
use cara_core::services::call::{Caller, OnProgress, Outgoing};
use cara_core::services::heart::Renew;
use cara_core::time::Duration;

use super::protocol::{Answer, Argument, CallQuestion, Failure, Said};
use super::sink::{End, LOOK, Sink, pause, send};
use super::{attributes, select, values};
use crate::communication_system::thread_waker;
use crate::engine::{Answered, Pending};
use crate::error::CallError;
use crate::growing::GrowingParameters;
use crate::{CommunicationSystem, Delivery, Peer, RequestOptions, TheirFunction};

/// Most bytes of parameters in flight when all nodes are called.
const BYTES_AT_A_TIME: usize = 64 * 1024 * 1024;

/// A call of all that has no answer for so long is [`News::Late`].
const LATE: std::time::Duration = std::time::Duration::from_millis(500);

/// Calls one node, or all that offer the function. Once `wanted` returns `false`, calls that have not ended are given
/// up.
pub(super) fn call<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &CallQuestion,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let options = options(question)?;
    let Some(node) = &question.node else { return call_all(system, question, &options, sink, wanted) };
    let peer = select::node(system, node)?;
    if question.asynchronous {
        return notify(&peer, question, &options, sink);
    }
    let started = Instant::now();
    let outcome = await_one(&peer, question, &options, sink, wanted)?.map(|(outcome, _)| outcome);
    send(sink, called(&peer, outcome, started))
}

/// Makes a call of one node that is not waited for.
fn notify<T: Send + 'static>(
    peer: &Peer<T>,
    question: &CallQuestion,
    options: &RequestOptions,
    sink: Sink<'_>,
) -> Result<(), End> {
    let started = Instant::now();
    let outcome = prepare(peer, question).and_then(|prepared| {
        let id = peer.send(question.function.as_str().into(), &prepared.parameters, options);
        id.map(|id| Outcome { call: Some(id.0), ..Outcome::default() }).map_err(|failed| prepared.explain(&failed))
    });
    send(sink, called(peer, outcome, started))
}

/// What a call has led to.
#[derive(Default)]
pub(super) struct Outcome {
    results: Vec<Argument>,
    call: Option<u32>,
}

/// A call that could be made.
pub(super) struct Prepared {
    function: TheirFunction,
    pub(super) parameters: GrowingParameters,
}

pub(super) fn options(question: &CallQuestion) -> Result<RequestOptions, Failure> {
    let priority = question.priority.as_deref().map(|word| {
        attributes::priority_of(word).ok_or_else(|| {
            let text = format!("'{word}' is no priority: it is emergency, high, normal or low");
            Failure::configuration("UnknownPriority", text)
        })
    });
    if question.best_effort && !question.asynchronous {
        let text = "a call in one datagram has no reply: ask for it as asynchronous";
        return Err(Failure::configuration("BadQuestion", text));
    }
    Ok(RequestOptions {
        timeout: question.timeout_ms.map(Duration::from_millis),
        priority: priority.transpose()?,
        delivery: if question.best_effort { Delivery::BestEffort } else { Delivery::Reliable },
        // What an operator starts runs for one lease and no longer: no client would release it.
        renew: Renew::Never,
        take_over: question.take_over,
        operator: true,
        progress: question.progress,
        ..RequestOptions::new()
    })
}

/// Calls one node and waits for its results; the call is returned as well, whose lease may go on. It is given up when
/// `wanted` says no.
pub(super) fn await_one<T: Send + 'static>(
    peer: &Peer<T>,
    question: &CallQuestion,
    options: &RequestOptions,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<Result<(Outcome, Answered), Failure>, End> {
    let mut prepared = match prepare(peer, question) {
        Ok(prepared) => prepared,
        Err(failure) => return Ok(Err(failure)),
    };
    let signature = prepared.function.definition.clone();
    let mut unheard = None;
    let mut hear = |progress: &ParametersView| {
        let values = values::arguments(signature.signature().progress(), progress);
        match send(sink, Answer::Progress { node: peer.name().to_owned(), id: peer.id(), values }) {
            Ok(()) => ControlFlow::Continue(()),
            Err(end) => {
                unheard = Some(end);
                ControlFlow::Break(())
            }
        }
    };
    let waker = thread_waker();
    let mut cx = Context::from_waker(&waker);
    let mut pending = None;
    let outcome = loop {
        let progress: Option<OnProgress<'_>> = if question.progress { Some(&mut hear) } else { None };
        if let Poll::Ready(outcome) = prepared.poll(peer, &mut pending, options, progress, &mut cx) {
            break outcome;
        }
        if !wanted() {
            return Err(End::Gone);
        }
        std::thread::park_timeout(LOOK);
    };
    match unheard {
        Some(end) => Err(end),
        None => Ok(prepared.outcome(outcome)),
    }
}

pub(super) fn prepare<T: Send + 'static>(peer: &Peer<T>, question: &CallQuestion) -> Result<Prepared, Failure> {
    if !peer.is_connected() {
        return Err(Error::NotConnected.into());
    }
    let function = peer.function(&question.function).ok_or_else(|| unknown(peer, &question.function))?;
    let signature = function.definition.signature();
    let mut parameters =
        values::parameters(&question.arguments, signature.arguments()).map_err(|failure| signed(failure, &function))?;
    peer.with_room(&question.function, &mut parameters);
    Ok(Prepared { function, parameters })
}

fn unknown<T: Send + 'static>(peer: &Peer<T>, function: &str) -> Failure {
    let list = peer.their_function_list();
    let names: Vec<&str> = list.names().collect();
    let offered = if names.is_empty() { "nothing yet".to_owned() } else { names.join(", ") };
    let peer = peer.identity();
    Failure::configuration(
        "UnknownFunction",
        format!("{peer} does not offer '{function}' to this unit; it offers {offered}"),
    )
}

fn signed(failure: Failure, function: &TheirFunction) -> Failure {
    failure.and(format_args!("the signature is {}", function.definition.signature()))
}

impl Prepared {
    fn poll<'c, T: Send + 'static>(
        &'c mut self,
        peer: &Peer<T>,
        pending: &mut Option<Pending<T>>,
        options: &'c RequestOptions,
        progress: Option<OnProgress<'c>>,
        cx: &mut Context<'_>,
    ) -> Poll<Result<Answered, CallError>> {
        let (callee, parameters) = (self.function.definition.name().into(), &mut *self.parameters);
        peer.poll(pending, Outgoing { callee, parameters, options, progress, canceller: None }, cx)
    }

    fn outcome(&self, outcome: Result<Answered, CallError>) -> Result<(Outcome, Answered), Failure> {
        let answered = outcome.map_err(|failed| self.explain(&failed))?;
        let results = values::arguments(self.function.definition.signature().results(), &self.parameters);
        Ok((Outcome { results, call: None }, answered))
    }

    /// What the service has said of its failure; the text of an error in the arguments shows the function's signature.
    fn explain(&self, failed: &CallError) -> Failure {
        let signature = self.function.definition.signature();
        let failure = Failure::from(failed.error);
        match failed.failure() {
            Some(said) => {
                let values = values::arguments(signature.failure(), said.values());
                let said = Some(Box::new(Said { reason: said.text().to_owned(), values }));
                Failure { said, text: format!("the service failed: {failed}"), ..failure }
            }
            None if failed.error.cause() == Cause::Configuration => signed(failure, &self.function),
            None => failure,
        }
    }
}

pub(super) fn called<T: Send + 'static>(peer: &Peer<T>, outcome: Result<Outcome, Failure>, started: Instant) -> Answer {
    let took_us = u64::try_from(started.elapsed().as_micros()).unwrap_or(u64::MAX);
    let (outcome, error) = match outcome {
        Ok(outcome) => (outcome, None),
        Err(failure) => (Outcome::default(), Some(failure)),
    };
    let (node, id) = (peer.name().to_owned(), peer.id());
    Answer::Called { node, id, results: outcome.results, call: outcome.call, error, took_us, functions: Vec::new() }
}

fn call_all<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    question: &CallQuestion,
    options: &RequestOptions,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let peers = system.nodes_offering(&question.function);
    if peers.is_empty() {
        let text = format!("no connected node offers '{}' to this unit", question.function);
        return Err(Failure::configuration("UnknownFunction", text).into());
    }
    if !question.asynchronous {
        let calls: Vec<_> = peers.iter().map(|peer| (peer, question)).collect();
        return block_all(&calls, options, wanted, &mut |_, news| match news {
            News::Late => Ok(()),
            News::Answer(answer) => send(sink, *answer),
        });
    }
    peers.iter().try_for_each(|peer| notify(peer, question, options, sink))
}

/// What [`block_all`] tells of a call.
pub(super) enum News {
    /// It could not be made, or has no answer after [`LATE`]. Once for each call at most.
    Late,
    Answer(Box<Answer>),
}

/// All at the same time, as far as the memory for their parameters reaches; `notify` gets the answers in the order of the replies,
/// each with the index of its call.
pub(super) fn block_all<T: Send + 'static>(
    calls: &[(&Peer<T>, &CallQuestion)],
    options: &RequestOptions,
    wanted: &dyn Fn() -> bool,
    notify: &mut dyn FnMut(usize, News) -> Result<(), End>,
) -> Result<(), End> {
    let mut calls = calls.iter().enumerate();
    let mut under_way = Vec::new();
    let mut bytes = 0;
    let waker = thread_waker();
    let mut cx = Context::from_waker(&waker);
    loop {
        while bytes < BYTES_AT_A_TIME
            && let Some((number, &(peer, question))) = calls.next()
        {
            let started = Instant::now();
            match prepare(peer, question) {
                Ok(prepared) => {
                    bytes += size_of_val(&*prepared.parameters);
                    under_way.push((number, peer, started, prepared, None, false));
                }
                Err(failure) => {
                    notify(number, News::Late)?;
                    notify(number, News::Answer(Box::new(called(peer, Err(failure), started))))?;
                }
            }
        }
        if under_way.is_empty() {
            return Ok(());
        }
        let before = under_way.len();
        let mut index = 0;
        while let Some((number, peer, started, prepared, pending, is_late)) = under_way.get_mut(index) {
            if let Poll::Ready(outcome) = prepared.poll(peer, pending, options, None, &mut cx) {
                bytes -= size_of_val(&*prepared.parameters);
                // It never left: what is urgent goes another way.
                let is_unsent = outcome.is_err() && !pending.as_ref().is_some_and(Pending::was_sent);
                let outcome = prepared.outcome(outcome).map(|(outcome, _)| outcome);
                let (number, answer) = (*number, called(peer, outcome, *started));
                drop(under_way.swap_remove(index));
                if is_unsent {
                    notify(number, News::Late)?;
                }
                notify(number, News::Answer(Box::new(answer)))?;
            } else {
                let is_sent = pending.as_ref().is_some_and(Pending::was_sent);
                if !*is_late && (!is_sent || started.elapsed() >= LATE) {
                    *is_late = true;
                    notify(*number, News::Late)?;
                }
                index += 1;
            }
        }
        if !wanted() {
            return Err(End::Gone);
        }
        if under_way.len() == before {
            std::thread::park_timeout(LOOK);
        }
    }
}

/// Sends pings, and tells how long each took.
pub(super) fn ping<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    node: &str,
    (count, between, timeout): (u32, Duration, Duration),
    sink: Sink<'_>,
) -> Result<(), End> {
    let peer = select::node(system, node)?;
    for number in 0..count {
        if number > 0 {
            pause(system, between)?;
        }
        let took = peer.ping(timeout).map(std::time::Duration::from);
        send(
            sink,
            match took {
                Ok(took) => Answer::Sample { us: Some(took.as_secs_f64() * 1e6), error: None },
                Err(error) => Answer::Sample { us: None, error: Some(error.into()) },
            },
        )?;
    }
    Ok(())
}
