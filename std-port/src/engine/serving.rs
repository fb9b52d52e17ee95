//! Running the peers' calls, on the thread that read them.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, MutexGuard, PoisonError};

use cara_core::distribution::function_list::Slot;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::unit::Call;
use cara_core::time::{Duration, Instant};

use super::link::{LinkCell, LinkState};
use super::{Engine, lock, read};
use crate::handler::{self, Run};
use crate::lease::LeaseWatch;

/// How long an answer waits for room at a time.
const PAUSE: std::time::Duration = std::time::Duration::from_millis(20);

/// A handler that takes less than this is quick: the thread that ran it may stay on the link.
const QUICK: Duration = Duration::from_micros(50);

impl<T: Send + 'static> Engine<T> {
    /// Runs a call and those that waited behind it.
    pub(super) fn serve(&self, link: &Arc<LinkCell>, call: Call, arguments: &mut ParametersView) {
        let mut next = Some(call);
        while let Some(call) = next {
            let (state, _) = self.serve_one(self.now(), link, &call, arguments);
            next = self.next_call(link, state, arguments);
        }
    }

    /// Runs one call and answers it. Returns the time of its last look at the clock as well.
    pub(super) fn serve_one<'l>(
        &self,
        began: Instant,
        link: &'l Arc<LinkCell>,
        call: &Call,
        arguments: &mut ParametersView,
    ) -> (MutexGuard<'l, LinkState>, Instant) {
        let occupied = self.crew().occupancy.enter();
        let result = self.run(link, call, arguments);
        drop(occupied);
        let now = self.now();
        let mut state = link.lock();
        state.quick = now.since(began) < QUICK;
        state.is_called = true;
        state.moved_at = now;
        (self.answer(now, link, state, call, result, arguments), now)
    }

    /// Takes the next call that may begin on a link; another thread is told if there is one more.
    pub(super) fn next_call(
        &self,
        link: &Arc<LinkCell>,
        mut state: MutexGuard<'_, LinkState>,
        arguments: &mut ParametersView,
    ) -> Option<Call> {
        let mut next = None;
        if state.is_paused() && !state.session.has_next_call() {
            self.feed(self.now(), link, &mut state, &mut [], None, None);
        }
        if state.session.has_next_call() && self.may_run(state.quick) {
            next = self.with(link, &mut state, |session, cx| session.next_call(cx, arguments));
        }
        if state.session.has_next_call() {
            self.hand_over(link);
        }
        self.settle(link, state);
        next
    }

    /// Leaves a link's calls to another thread of the pool.
    pub(super) fn hand_over(&self, link: &LinkCell) {
        self.crew().hand_over(link.token());
    }

    fn run(&self, link: &LinkCell, call: &Call, arguments: &mut ParametersView) -> Result<(), Error> {
        let Some(peer) = link.peer.get() else { return Err(Error::NotConnected) };
        let (run, lease, detached) = {
            let functions = read(&self.functions);
            let function = functions.function(call.slot).ok_or(Error::StaleFunction)?;
            (function.handler.run.clone(), function.handler.lease.clone(), function.handler.detached)
        };
        if detached {
            self.detach(link, call);
        }
        let told = handler::Call {
            caller: peer.identity.clone(),
            priority: call.priority,
            deadline: call.deadline,
            wants_reply: call.wants_reply,
            lease: lease.map(|lease| LeaseWatch::new(lease, self.clock)),
        };
        let run = AssertUnwindSafe(|| match run {
            Run::Free(run) => run(&told, arguments).map_err(Error::Service),
            Run::Method(run) => {
                let mut state = self.state.enter(Some(link.id))?;
                run(&mut state, &told, arguments).map_err(Error::Service)
            }
        });
        catch_unwind(run).unwrap_or_else(|_| {
            tracing::error!(slot = call.slot.0, caller = %peer.identity, "a handler panicked");
            Err(Error::Service(ServiceError::Panicked))
        })
    }

    /// Lets the caller's next call of the class begin while this one runs.
    fn detach(&self, link: &LinkCell, call: &Call) {
        let mut state = link.lock();
        state.session.detach(call.ticket);
        let next = state.session.has_next_call();
        drop(state);
        if next {
            self.hand_over(link);
        }
    }

    /// Answers, waiting for room while somebody waits for the answer.
    fn answer<'l>(
        &self,
        mut now: Instant,
        link: &'l Arc<LinkCell>,
        mut state: MutexGuard<'l, LinkState>,
        call: &Call,
        result: Result<(), Error>,
        results: &ParametersView,
    ) -> MutexGuard<'l, LinkState> {
        loop {
            let answer = match result {
                Ok(()) => Ok(results),
                Err(error) => Err(error),
            };
            let kept = self.with_at(now, link, &mut state, |session, cx| session.answer(cx, call.ticket, answer));
            if kept.is_ok() {
                return state;
            }
            if now >= call.deadline {
                state.session.drop_answer(call.ticket);
                return state;
            }
            self.settle(link, state);
            state = link.lock();
            state = link.room.wait_timeout(state, PAUSE).unwrap_or_else(PoisonError::into_inner).0;
            now = self.now();
        }
    }

    /// Runs the safe hook of a service whose lease ended.
    pub(super) fn make_safe(&self, slot: Slot) {
        let hook = read(&self.functions).function(slot).and_then(|function| function.handler.safe.clone());
        self.run_hook(hook);
    }

    /// Runs the hook for the loss of a peer.
    pub(super) fn run_lost_hook(&self) {
        let hook = lock(&self.lost_hook).clone();
        self.run_hook(hook);
    }

    /// While a method holds the state, the hook is left to it: the thread that comes here may be the clock's, or that
    /// method's own, which reads for its reply.
    fn run_hook(&self, hook: Option<Arc<handler::Hook<T>>>) {
        let Some(hook) = hook else { return };
        self.state.run_or_leave(Box::new(move |state| {
            if catch_unwind(AssertUnwindSafe(|| hook(state))).is_err() {
                tracing::error!("a hook panicked");
            }
        }));
    }
}
