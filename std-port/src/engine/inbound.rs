//! What arrives on a link: bytes are given to its session, and what comes out is a call, a reply, or something to be noted.

use std::sync::Arc;

use cara_core::distribution::failure::Failure;
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::services::session::{Event, ReplyBlock};
use cara_core::time::Instant;

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::services;
use super::serving::{self, Started};
use super::worker::arena;
use crate::handler::Handler;
use crate::storage::Boxed;

/// The call of its own that a thread reads for.
pub(super) struct OwnCall<'p> {
    pub(super) id: CallId,
    pub(super) parameters: &'p mut ParametersView,
    pub(super) result: Option<Result<(), Error>>,
}

/// What one step of feeding led to.
struct Step {
    consumed: usize,
    paused: bool,
    /// Something was consumed or came out: there may be more.
    progress: bool,
    joined: bool,
    call: Option<Started>,
}

impl Step {
    /// Nothing was looked at.
    const PAUSED: Self = Self { consumed: 0, paused: true, progress: false, joined: false, call: None };
}

impl<T: Send + 'static> Engine<T> {
    /// Gives the session what was read. Returns the call that is to be run, its arguments in `arguments`.
    pub(super) fn feed(
        &self,
        now: Instant,
        link: &Arc<LinkCell>,
        state: &mut LinkState,
        bytes: &mut [u8],
        mut arguments: Option<&mut ParametersView>,
        mut own: Option<&mut OwnCall<'_>>,
    ) -> Option<Started> {
        let (was_paused, stalled) = (state.is_paused(), state.backlog.is_stalled(now));
        let (mut earlier, mut position) = state.backlog.take();
        let bytes = if was_paused {
            earlier.extend_from_slice(bytes);
            &mut earlier[..]
        } else {
            bytes
        };
        let mut call = None;
        loop {
            let rest = bytes.get_mut(position..).unwrap_or_default();
            let step = if !rest.is_empty() && !stalled && state.holds_back() {
                Step::PAUSED
            } else {
                let arguments = arguments.as_deref_mut().filter(|_| call.is_none());
                self.step(now, link, state, rest, arguments, own.as_deref_mut())
            };
            position += step.consumed;
            call = call.or(step.call);
            // One emergency alone has a place to wait, and the next one may be among these bytes.
            self.dispatch_emergencies(link, state);
            if step.joined {
                self.joined(link, state);
            }
            if step.paused && was_paused {
                state.backlog.put(earlier, position);
                return call;
            }
            if step.paused {
                state.backlog.put(bytes.get(position..).unwrap_or_default().to_vec(), 0);
                state.backlog.moved(now);
                return call;
            }
            let through = position == bytes.len() && !state.session.holds_received();
            if through || !step.progress {
                return call;
            }
        }
    }

    /// One call of `Session::receive`, with its event taken apart; an emergency goes to the thread of its service.
    fn step(
        &self,
        now: Instant,
        link: &Arc<LinkCell>,
        state: &mut LinkState,
        bytes: &mut [u8],
        mut arguments: Option<&mut ParametersView>,
        own: Option<&mut OwnCall<'_>>,
    ) -> Step {
        self.links.make_call_room(state);
        let functions = self.services.functions();
        let LinkState { session, waiters, notices, woken, .. } = state;
        let receipt = self.with_functions(now, &functions, link, session, |session, cx| {
            session.receive(cx, bytes, arguments.as_deref_mut())
        });
        let mut step = Step {
            consumed: receipt.consumed,
            paused: receipt.paused,
            progress: receipt.consumed > 0 || receipt.event.is_some(),
            joined: false,
            call: None,
        };
        match receipt.event {
            None => {}
            Some(Event::Joined) => step.joined = true,
            Some(Event::Incoming(call)) => {
                let started = self.started(&functions, link, call);
                match arguments.filter(|_| serving::is_emergency(&call)) {
                    None => step.call = Some(started),
                    Some(arguments) => self.copy_emergency(&functions, link, started, arguments),
                }
            }
            Some(Event::Progress(id, values)) => {
                let block = session.progress_values(&values, bytes);
                if let Ok(block) = block
                    && let Some(waiter) = waiters.iter_mut().find(|waiter| waiter.id == id)
                {
                    waiter.progress = read(&block).or(waiter.progress.take());
                    waiter.wake.wake(woken);
                }
            }
            Some(Event::Reply(id, outcome)) => {
                let failure = outcome.err().and_then(|_| session.failure(bytes));
                let outcome = outcome.and_then(|results| Ok((results.function(), session.results(&results, bytes)?)));
                if let Some(waiter) = waiters.iter_mut().find(|waiter| waiter.id == id) {
                    waiter.failure = failure.inspect(|failure| show(id, failure)).map(Box::new);
                    match own.filter(|own| own.id == id) {
                        Some(own) => own.result = Some(outcome.and_then(|(_, block)| block.read_into(own.parameters))),
                        None => {
                            waiter.finish(outcome.map(|((slot, of), block)| (slot, of, block.bytes().into())), woken)
                        }
                    }
                }
                state.wake_tasks();
            }
            Some(Event::Sample(sample)) => {
                let block = session.results(&sample.values, bytes);
                if let Some(peer) = link.peer.get()
                    && block.is_ok_and(|block| peer.streams.receive(now, sample.age, &block, woken))
                {
                    notices.push(Event::Sample(sample));
                }
            }
            Some(event) => {
                if let Event::Failed(id, _) = event
                    && let Some(failure) = session.failure(bytes)
                {
                    show(id, &failure);
                }
                if matches!(event, Event::ListChanged) && !link.is_introduced() {
                    // A node that counts has its place.
                    link.peer.get().into_iter().for_each(|peer| self.nodes.write().introduce(peer));
                    link.introduce();
                }
                if let Event::LeaseExpired(slot) = event {
                    services::wake_leased(&functions, slot);
                }
                notices.push(event);
            }
        }
        step
    }

    /// The thread that has read an emergency goes on reading.
    fn copy_emergency(
        &self,
        functions: &FunctionList<Boxed, Handler<T>>,
        link: &Arc<LinkCell>,
        started: Started,
        arguments: &ParametersView,
    ) {
        let mut copy = arena(self.services.call_bytes());
        if copy.copy_from(arguments).is_ok() {
            self.run_emergency(functions, link, started, copy);
        }
    }
}

/// What a call tells, with room for it.
fn read(block: &ReplyBlock<'_>) -> Option<Box<ParametersView>> {
    let mut values = arena(block.parameters_bytes() as usize);
    block.read_into(&mut values).is_ok().then_some(values)
}

fn show(id: CallId, failure: &Failure) {
    tracing::debug!(call = id.0, code = failure.code(), text = ?failure.text(), "a call has failed");
}
