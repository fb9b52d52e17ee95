//! Running the peers' calls: on the thread of the pool that read them; emergencies on the thread of their service.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::config::Priority;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::Ticket;
use cara_core::services::session::Incoming;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::nested;
use super::served::{PAUSE, Reports, Serving};
use super::services::Parked;
use super::state_gate::{Access, Entered, Held as StateHeld, Turn};
use super::tape::OFFERS;
#[cfg(feature = "async")]
use super::tasks::Task;
use super::worker::{Worker, arena};
use crate::handler::{self, Handler, Run};
use crate::lease::LeaseWatch;
use crate::locks::Locked;
use crate::storage::Boxed;

/// A service that holds the state for longer is warned about, since calls that need the state wait meanwhile.
const LONG: Duration = Duration::from_secs(1);

/// A call that has begun.
#[derive(Clone, Copy)]
pub(super) struct Started {
    pub(super) call: Incoming,
    /// Its turn, where it takes the application's state.
    turn: Option<Turn>,
}

/// What running a call led to.
enum Ran {
    Over(Result<(), Error>),
    NotYet(Turn),
    /// It is to be begun as a task.
    #[cfg(feature = "async")]
    Apart(Box<handler::Served>, Arc<handler::Begin>, bool),
}

impl<T: Send + 'static> Engine<T> {
    /// A call has begun, under its link's lock: it takes its turn.
    pub(super) fn started(
        &self,
        functions: &FunctionList<Boxed, Handler<T>>,
        link: &LinkCell,
        call: Incoming,
    ) -> Started {
        let access = functions.function(call.slot).and_then(|function| function.handler.run.access());
        Started { call, turn: access.map(|access| self.services.state.take_turn(Some(link.id), access)) }
    }

    /// Runs a call and those that waited behind it.
    pub(super) fn serve(&self, link: &Arc<LinkCell>, started: Started, worker: &mut Worker) {
        let mut next = Some(started);
        while let Some(started) = next {
            let served = self.serve_one(self.now(), link, started, worker);
            let state = served.map_or_else(|| link.lock(), |(state, _)| state);
            // Peers take turns: where no thread is left for the others, theirs come before this peer's next call.
            if state.session.has_next_call() && self.driver.pool().others_wait(link.token()) {
                self.hand_over(link);
                self.settle(link, state);
                return;
            }
            next = self.next_call(link, state, worker);
        }
    }

    /// Runs one call and answers it. Returns the time of its last look at the clock as well; `None` when the call has to
    /// wait for the application's state, and goes on elsewhere.
    pub(super) fn serve_one<'l>(
        &self,
        began: Instant,
        link: &'l Arc<LinkCell>,
        started: Started,
        worker: &mut Worker,
    ) -> Option<(Locked<'l, LinkState>, Instant)> {
        let occupied = self.driver.pool().occupancy.enter();
        let ran = self.run(link, started, &mut worker.arguments);
        drop(occupied);
        let result = match ran {
            Ran::Over(result) => result,
            Ran::NotYet(turn) => {
                link.lock().reading.ran(Duration::MAX);
                let spare = arena(worker.longest());
                let arguments = std::mem::replace(&mut worker.arguments, spare);
                self.services.park(turn, Parked { link: link.clone(), call: started.call, arguments });
                return None;
            }
            #[cfg(feature = "async")]
            Ran::Apart(reported, begin, to_its_end) => {
                link.lock().reading.ran(self.now().since(began));
                let spare = arena(worker.longest());
                let arguments = std::mem::replace(&mut worker.arguments, spare);
                self.begin_task(link, started.call, *reported, (&*begin, to_its_end), arguments);
                return None;
            }
        };
        let now = self.now();
        let ran = now.since(began);
        if started.turn.is_some() && ran > LONG {
            self.warn_of_long(started.call.slot, ran);
        }
        let mut state = link.lock();
        state.reading.ran(ran);
        state.backlog.moved(now);
        Some((self.answer(now, link, state, &started.call, result, &worker.arguments), now))
    }

    /// Warns of a service that has held the state for so long, once.
    #[cold]
    fn warn_of_long(&self, slot: Slot, held: Duration) {
        let function = {
            let functions = self.services.functions();
            let Some(function) = functions.function(slot) else { return };
            if function.handler.held_long.swap(true, Ordering::Relaxed) {
                return;
            }
            function.name().to_owned()
        };
        let (unit, _) = self.hub.lock().identity();
        let advice = "calls that need the state wait meanwhile: begin what takes long, and return";
        tracing::warn!(%unit, function, held_ms = held.as_millis(), "a service held the unit's state for over a second; {advice}");
    }

    /// Takes the next call that may begin on a link. If there is one more, another thread is told, unless handlers are quick:
    /// then the clock tells one, should this handler take long after all.
    pub(super) fn next_call(
        &self,
        link: &Arc<LinkCell>,
        mut state: Locked<'_, LinkState>,
        worker: &mut Worker,
    ) -> Option<Started> {
        let mut next = None;
        self.dispatch_emergencies(link, &mut state);
        if state.is_paused() && !state.session.has_next_call() {
            self.feed(self.now(), link, &mut state, &mut [], None, None);
        }
        let is_quick = state.reading.is_quick();
        if state.session.has_next_call() && self.may_run(is_quick) {
            next = self.take_call(link, &mut state, worker);
        }
        if state.session.has_next_call() {
            match next {
                // This thread comes back for it before another one would have begun.
                Some(_) if is_quick => {
                    self.driver.pool().note_waiting(link.token());
                    self.links.begin_watch();
                }
                _ => self.hand_over(link),
            }
        }
        self.settle(link, state);
        next
    }

    /// Begins the next call of a link.
    pub(super) fn take_call(&self, link: &LinkCell, state: &mut LinkState, worker: &mut Worker) -> Option<Started> {
        let call = self.with(link, state, |session, cx| session.next_call(cx, &mut worker.arguments))?;
        Some(self.started(&self.services.functions(), link, call))
    }

    /// Gives emergencies that have come to the threads of their services. No thread that reads runs them.
    pub(super) fn dispatch_emergencies(&self, link: &Arc<LinkCell>, state: &mut LinkState) {
        while state.session.has_next_emergency() {
            let mut arguments = arena(self.services.call_bytes());
            let call =
                self.with(link, state, |session, cx| session.unrecorded(OFFERS).next_emergency(cx, &mut arguments));
            let Some(call) = call else { return };
            let started = self.started(&self.services.functions(), link, call);
            self.run_emergency(&self.services.functions(), link, started, arguments);
        }
    }

    /// Leaves an emergency to the thread of its service. One of a service that is none for emergencies has a thread with
    /// all others of that kind.
    pub(super) fn run_emergency(
        &self,
        functions: &FunctionList<Boxed, Handler<T>>,
        link: &Arc<LinkCell>,
        started: Started,
        mut arguments: Box<ParametersView>,
    ) {
        let Some(engine) = self.me.upgrade() else { return };
        let executor = functions.function(started.call.slot).and_then(|function| function.handler.executor.clone());
        let Some(executor) = executor.or_else(|| self.driver.pool().executor()) else { return };
        let link = link.clone();
        executor.run(move || match engine.run(&link, started, &mut arguments) {
            Ran::Over(result) => {
                let state = engine.answer(engine.now(), &link, link.lock(), &started.call, result, &arguments);
                if state.session.has_next_call() {
                    engine.hand_over(&link);
                }
                engine.settle(&link, state);
            }
            Ran::NotYet(turn) => engine.services.park(turn, Parked { link, call: started.call, arguments }),
            #[cfg(feature = "async")]
            Ran::Apart(reported, begin, to_its_end) => {
                engine.begin_task(&link, started.call, *reported, (&*begin, to_its_end), arguments);
            }
        });
    }

    #[cfg(feature = "async")]
    fn begin_task(
        &self,
        link: &Arc<LinkCell>,
        call: Incoming,
        reported: handler::Served,
        begin: (&handler::Begin, bool),
        arguments: Box<ParametersView>,
    ) {
        let Some(me) = self.me.upgrade() else { return };
        let task = Task::begin(me, self.driver.clone(), link, call, reported, begin, arguments);
        self.services.runner.spawn(Box::pin(task));
    }

    /// Leaves a link's calls to another thread of the pool.
    pub(super) fn hand_over(&self, link: &LinkCell) {
        self.driver.pool().hand_over(link.token());
    }

    /// Runs a call that was parked, and those that wait behind it on its link.
    pub(super) fn serve_parked(&self, worker: &mut Worker) {
        let Some((Parked { link, call, arguments }, turn)) = self.services.state.take_ready() else { return };
        self.services.go_on_with_parked();
        let now = self.now();
        // A call that waited for its turn may be late, and its caller may be gone.
        let is_over = now >= call.deadline || Serving::new(self.me.clone(), &link, call.ticket).is_cancelled();
        let result = if is_over { Err(Error::Expired) } else { turn.map(drop) };
        let own = std::mem::replace(&mut worker.arguments, arguments);
        let state = match result {
            Ok(()) => self.serve_one(now, &link, Started { call, turn: turn.ok() }, worker).map(|(state, _)| state),
            Err(error) => {
                self.services.give_up(turn.ok());
                Some(self.answer(now, &link, link.lock(), &call, Err(error), &worker.arguments))
            }
        };
        worker.arguments = own;
        let next = self.next_call(&link, state.unwrap_or_else(|| link.lock()), worker);
        if let Some(next) = next {
            self.serve(&link, next, worker);
        }
    }

    fn run(&self, link: &Arc<LinkCell>, started: Started, arguments: &mut ParametersView) -> Ran {
        let Started { call, turn } = started;
        let (run, reported) = match self.prepare(link, &call) {
            Ok(prepared) => prepared,
            Err(error) => {
                self.services.give_up(turn);
                return Ran::Over(Err(error));
            }
        };
        // An order goes on when its caller waits no longer.
        let waited_for = call.wants_reply && call.order.is_none();
        let end = waited_for.then(|| self.driver.clock().boot_time_of(call.deadline));
        match run {
            Run::Free(run) => {
                self.services.give_up(turn);
                Ran::Over(guarded(&reported, end, || run(&reported, arguments)))
            }
            Run::Method(run) => self.run_with_state(link, turn, Access::Change, |held| {
                let change = |state: &mut T| run(state, &reported, arguments);
                guarded(&reported, end, || held.change(change).unwrap_or(Err(ServiceError::NotReady)))
            }),
            Run::Reader(run) => self.run_with_state(link, turn, Access::Read, |held| {
                guarded(&reported, end, || run(held.state(), &reported, arguments))
            }),
            #[cfg(feature = "async")]
            Run::Task(begin) => {
                self.services.give_up(turn);
                let reported = handler::Served { given_up: Some(Arc::default()), ..reported };
                let to_its_end =
                    self.services.functions().function(call.slot).is_some_and(|function| function.handler.to_its_end);
                Ran::Apart(Box::new(reported), begin, to_its_end)
            }
        }
    }

    fn run_with_state(
        &self,
        link: &LinkCell,
        turn: Option<Turn>,
        access: Access,
        run: impl FnOnce(&StateHeld<'_, T, Parked>) -> Result<(), Error>,
    ) -> Ran {
        // The function may have been replaced since the call began, by one that takes the state.
        let turn = turn.unwrap_or_else(|| self.services.state.take_turn(Some(link.id), access));
        let result = match self.services.state.enter_by(turn) {
            Entered::Held(held) => run(&held),
            Entered::NotYet => return Ran::NotYet(turn),
            Entered::Refused(error) => Err(error),
        };
        self.services.go_on_with_parked();
        Ran::Over(result)
    }

    /// How a call is run, and what its handler is told.
    fn prepare(&self, link: &Arc<LinkCell>, call: &Incoming) -> Result<(Run<T>, handler::Served), Error> {
        let peer = link.peer.get().ok_or(Error::NotConnected)?;
        let (run, actuator) = {
            let functions = self.services.functions();
            let Handler { run, actuator, .. } = functions.function(call.slot).ok_or(Error::StaleFunction)?.handler;
            (run.clone(), actuator.clone())
        };
        // A stop or reset waits too: the hooks of what it has stopped run first, unless they take long.
        let is_safe = actuator.as_ref().is_none_or(|actuator| actuator.safe.has_run());
        let moved = actuator.zip(call.order);
        if let Some((actuator, _)) = &moved {
            if !is_safe {
                return Err(Error::Service(ServiceError::NotReady));
            }
            // An earlier call has given way.
            actuator.lease.wake();
        }
        let reported = handler::Served {
            caller: peer.identity.clone(),
            priority: call.priority,
            deadline: call.deadline,
            wants_reply: call.wants_reply,
            lease: moved.map(|(actuator, order)| LeaseWatch::of(order, actuator)),
            serving: Serving::new(self.me.clone(), link, call.ticket),
            #[cfg(feature = "async")]
            given_up: None,
        };
        Ok((run, reported))
    }

    /// Answers, waiting for room until the call's deadline.
    fn answer<'l>(
        &self,
        mut now: Instant,
        link: &'l Arc<LinkCell>,
        mut state: Locked<'l, LinkState>,
        call: &Incoming,
        result: Result<(), Error>,
        results: &ParametersView,
    ) -> Locked<'l, LinkState> {
        let failure = state.details.take_failure(call.ticket);
        loop {
            let answer = match result {
                Ok(()) => Ok(results),
                Err(error) => Err(error),
            };
            if self.try_answer(now, link, &mut state, call.ticket, answer, failure.as_deref()).is_ok() {
                return state;
            }
            if now >= call.deadline {
                state.session.unrecorded(OFFERS).drop_answer(call.ticket);
                return state;
            }
            self.settle(link, state);
            state = link.lock();
            state = state.wait(&link.room, PAUSE);
            now = self.now();
        }
    }
}

impl<T: Send + 'static> Reports for Engine<T> {
    fn notify(&self, link: &Arc<LinkCell>, ticket: Ticket, values: &ParametersView) -> Result<(), Error> {
        let mut state = link.lock();
        let reported = self.send_progress(self.now(), link, &mut state, ticket, values);
        self.settle(link, state);
        reported
    }

    fn try_answer(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        ticket: Ticket,
        result: Result<&ParametersView, Error>,
        failure: Option<&Failure>,
    ) -> Result<(), Error> {
        self.with_at(now, link, state, |session, cx| match (result, failure) {
            (Err(error), Some(failure)) if error == failure.into() => {
                session.unrecorded(OFFERS).answer_failed(cx, ticket, failure)
            }
            _ => session.unrecorded(OFFERS).answer(cx, ticket, result),
        })
    }

    #[cfg(feature = "async")]
    fn give_up_lock<'l>(&self, now: Instant, link: &'l Arc<LinkCell>, state: Locked<'l, LinkState>) {
        self.settle_at(now, link, state);
    }
}

/// Runs a handler, which may panic. Not for an order that ended while its call waited for a thread or for its turn.
pub(super) fn guarded(
    reported: &handler::Served,
    end: Option<Duration>,
    run: impl FnOnce() -> Result<(), ServiceError>,
) -> Result<(), Error> {
    if reported.lease.as_ref().is_some_and(|lease| !lease.is_live()) {
        return Err(Error::Expired);
    }
    nested::until(end, || catch_unwind(AssertUnwindSafe(run))).map_or_else(
        |_| {
            tracing::error!(caller = %reported.caller, "a handler panicked");
            Err(Error::Service(ServiceError::Panicked))
        },
        |result| result.map_err(Error::Service),
    )
}

/// Whether an emergency is to be given to another thread than the one that read it.
pub(super) fn is_emergency(call: &Incoming) -> bool {
    call.priority == Priority::Emergency
}
