//! Calls that a task takes.

use cara_core::config::Priority;
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::Context;
use cara_core::services::session::Incoming;
use cara_core::time::{Duration, Instant};
use core::fmt;

use crate::handle::Handle;
use crate::lease::LeaseWatch;
use crate::machine::Machine;
use crate::owned::Owned;
use crate::task_slots::{Holds, Running, TaskSlot, answer};
use crate::time::{now, timer};

/// How long an answer waits for room at a time.
pub(crate) const PAUSE: Duration = Duration::from_millis(5);

impl<T> Machine<T> {
    /// A slot that is free, or becomes free as what it holds is of no use any more.
    fn free_slot(&mut self) -> Option<&mut TaskSlot> {
        if !self.tasks.iter().any(TaskSlot::is_free) {
            self.answer_parked();
        }
        self.tasks.iter_mut().find(|slot| slot.is_free())
    }

    /// Keeps a call for a task; [`Error::Busy`] when there is no room.
    pub(crate) fn leave_to_task(
        &mut self,
        running: Running,
        call: Incoming,
        caller: Identity,
        arguments: &ParametersView,
    ) -> Result<(), Error> {
        self.left_to_tasks = self.left_to_tasks.wrapping_add(1);
        let number = self.left_to_tasks;
        let slot = self.free_slot().ok_or(Error::Busy)?;
        slot.parameters.copy_from(arguments).map_err(|_| Error::Busy)?;
        slot.holds = Holds::Call { running, call, caller, number };
        self.wakers.calls.wake();
        Ok(())
    }

    /// Answers a call; `false` when the answer cannot be kept now.
    pub(crate) fn answer(&mut self, running: &Running, result: Result<&ParametersView, Error>) -> bool {
        if self.link(running.link).is_none_or(|link| link.serial != running.serial) {
            return true;
        }
        self.with(running.link, |session, cx| answer(session, cx, running, result)).unwrap_or(true)
    }

    /// Drops the answer of a call for which there is no room at all, and counts it.
    pub(crate) fn give_up_answer(&mut self, running: &Running) {
        if self.link(running.link).is_some_and(|link| link.serial == running.serial) {
            self.with(running.link, |session, _| session.drop_answer(running.ticket));
        }
    }

    /// Answers a call whose task has dropped it.
    pub(crate) fn drop_taken(&mut self, running: &Running) {
        self.wake_runner();
        let error = Err(Error::Service(ServiceError::NotReady));
        if !self.answer(running, error) && !self.park(*running, error) {
            self.give_up_answer(running);
        }
    }

    /// Keeps an answer until there is room for it; `false` when there is no room here either.
    pub(crate) fn park(&mut self, running: Running, result: Result<&ParametersView, Error>) -> bool {
        let Some(slot) = self.free_slot() else { return false };
        let kept = match result {
            Ok(results) => slot.parameters.copy_from(results),
            Err(error) => Err(error),
        };
        slot.holds = Holds::Answer { running, result: kept };
        true
    }

    /// Refuses calls that no task has taken in time, or whose order has ended, and tries again to answer what could not be answered.
    pub(crate) fn answer_parked(&mut self) {
        for index in 0..self.tasks.len() {
            self.refuse_dead(index);
            let Self { tasks, links, mail, pool, functions, access, hub, proof, .. } = self;
            let Some(TaskSlot { parameters, holds }) = tasks.get_mut(index) else { return };
            let Holds::Answer { running, result } = *holds else { continue };
            let link = links.get_mut(usize::from(running.link)).filter(|link| link.serial == running.serial);
            let kept = link.and_then(|link| link.session.as_mut()).is_none_or(|session| {
                let access = access.0;
                let mut cx = Context { now: now(), mailman: mail, buffers: pool, functions, access, hub, keys: proof };
                answer(session, &mut cx, &running, result.map(|()| &**parameters))
            });
            if kept {
                *holds = Holds::Nothing;
            }
        }
    }

    fn refuse_dead(&mut self, index: usize) {
        let Some(Holds::Call { running, call, .. }) = self.tasks.get(index).map(|slot| &slot.holds) else { return };
        let lease = self.functions.function(call.slot).and_then(|function| function.handler.lease);
        let is_over = now() >= running.deadline || LeaseWatch::new(lease, call).is_some_and(|lease| !lease.is_live());
        #[cfg(feature = "details")]
        let is_over = is_over || self.is_given_up(running);
        if is_over && let Some(slot) = self.tasks.get_mut(index) {
            slot.refuse(Error::Expired);
        }
    }

    /// Calls of a function that goes, or becomes another one, must not reach what takes its place in the list.
    pub(crate) fn refuse_calls_of(&mut self, function: Slot) {
        for slot in self.tasks.iter_mut().filter(|slot| slot.number_of(function).is_some()) {
            slot.refuse(Error::StaleFunction);
        }
        // A task that waits for its calls learns that it is gone.
        self.wakers.calls.wake();
        self.wake_runner();
    }

    /// When a call that waits, or an answer, is given up.
    pub(crate) fn parked_deadline(&self) -> Instant {
        let waiting = self.tasks.iter().filter_map(TaskSlot::running);
        waiting.map(|running| running.deadline).min().unwrap_or(Instant::FAR_FUTURE)
    }

    /// What waits for a task is not begun once its link has ended.
    pub(crate) fn forget_calls_of(&mut self, link: u16) {
        for slot in self.tasks.iter_mut() {
            if slot.running().is_some_and(|running| running.link == link) {
                slot.holds = Holds::Nothing;
            }
        }
    }

    /// Gives the oldest call of `function` to a task. One that is no longer wanted is refused instead.
    fn take_call(
        &mut self,
        function: &str,
        parameters: &mut ParametersView,
    ) -> Option<Result<(Running, Incoming, Identity), Error>> {
        let Some(wanted) = self.functions.find(function) else {
            return Some(Err(Error::UnknownFunction));
        };
        self.answer_parked();
        let newest = self.left_to_tasks;
        let waiting =
            self.tasks.iter_mut().filter_map(|slot| Some((newest.wrapping_sub(slot.number_of(wanted)?), slot)));
        let (_, slot) = waiting.max_by_key(|(age, _)| *age)?;
        let copied = parameters.copy_from(slot.parameters);
        // Room for another call, or an answer.
        self.wakers.runner.wake();
        if let Err(error) = copied {
            slot.refuse(Error::Service(ServiceError::NotReady));
            return Some(Err(error));
        }
        match core::mem::replace(&mut slot.holds, Holds::Nothing) {
            Holds::Call { running, call, caller, .. } => {
                self.own(running.link, Owned::taken(&running));
                Some(Ok((running, call, caller)))
            }
            _ => None,
        }
    }
}

/// A call that a task has taken, and replies to. Dropped without a reply, it is answered with
/// [`ServiceError::NotReady`].
#[must_use = "the caller waits for the reply"]
pub struct TakenCall<T: 'static> {
    pub(crate) unit: Handle<T>,
    pub(crate) running: Option<Running>,
    /// The caller.
    pub caller: Identity,
    /// The call's class.
    pub priority: Priority,
    /// After this the caller no longer waits; on the clock of [`now`].
    pub deadline: Instant,
    /// Whether the caller waits.
    pub wants_reply: bool,
    /// The call's hold of the service's lease, if there is one: what the call starts may go on while it is live.
    pub lease: Option<LeaseWatch>,
}

impl<T> fmt::Debug for TakenCall<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TakenCall")
            .field("caller", &self.caller)
            .field("priority", &self.priority)
            .finish_non_exhaustive()
    }
}

impl<T> Handle<T> {
    /// Takes the next call of one of this unit's services that was added with
    /// [`Handler::task`](crate::Handler::task); its arguments are in `parameters`, with room for its results.
    ///
    /// Cancel-safe: the call waits for the next `next_call`, until its deadline or its lease ends.
    ///
    /// [`Error::UnknownFunction`] when there is no such service; an error of `parameters` when the arguments do not
    /// fit, in which case the caller gets [`ServiceError::NotReady`].
    pub async fn next_call(&self, function: &str, parameters: &mut ParametersView) -> Result<TakenCall<T>, Error> {
        let (running, call, caller) = core::future::poll_fn(|cx| {
            self.lend(|machine| match machine.take_call(function, parameters) {
                Some(taken) => core::task::Poll::Ready(taken),
                None => {
                    machine.wakers.calls.register(cx);
                    core::task::Poll::Pending
                }
            })
        })
        .await?;
        let machine = self.shared.machine.borrow();
        let lease = machine.functions.function(call.slot).and_then(|function| function.handler.lease);
        Ok(TakenCall {
            unit: *self,
            running: Some(running),
            caller,
            priority: call.priority,
            deadline: call.deadline,
            wants_reply: call.wants_reply,
            lease: LeaseWatch::new(lease, &call),
        })
    }
}

impl<T> TakenCall<T> {
    /// Completes when what the call started may no longer continue, for whatever reason; never for a service without a lease.
    /// Cancelling loses nothing.
    pub async fn lease_ended(&self) {
        self.unit.lease_ended(self.lease).await;
    }

    /// Answers with results, or with why there are none; waits for room on the link while the caller waits for the
    /// answer. Cancelled, the caller gets [`ServiceError::NotReady`] instead.
    pub async fn reply(mut self, result: Result<&ParametersView, ServiceError>) {
        let result = result.map_err(Error::Service);
        while let Some(running) = self.running {
            if self.unit.act(|machine| machine.answer(&running, result)) {
                self.running = None;
                return;
            }
            timer(now() + PAUSE).await;
        }
    }
}

impl<T> Drop for TakenCall<T> {
    fn drop(&mut self) {
        let Some(running) = self.running.take() else { return };
        match self.unit.shared.machine.try_borrow_mut() {
            Ok(mut machine) => machine.drop_taken(&running),
            Err(_) => {
                self.unit.shared.unwanted.mark(running.link, Owned::taken(&running));
                self.unit.shared.unwanted.taken.set(Some(Machine::drop_marked));
            }
        }
    }
}
