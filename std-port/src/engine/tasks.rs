//! Calls whose handlers are futures: the executor of the application runs them, or a thread of the unit. A call has its
//! slot at its link until it is answered, which bounds how many there are.

use std::future::Future;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Wake, Waker};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::session::Incoming;
use cara_core::time::Duration;

use super::driving::{Alarm, Driver};
use super::link::LinkCell;
use super::nested;
use super::served::{GivenUp, PAUSE, Reports};
use super::tape::OFFERS;
use crate::executor::Executor;
use crate::handler::{self, Begin, Work};
use crate::lease::LeaseEnded;
use crate::locks::lock;

/// A task as an executor gets it.
pub(crate) type Spawned = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Gives a task to the executor of the application.
type Spawn = dyn Fn(Spawned) + Send + Sync;

/// What runs the handlers that are futures.
#[derive(Default)]
pub(crate) struct Runner {
    /// Of the application.
    spawn: Mutex<Option<Arc<Spawn>>>,
    /// The unit's own thread, once there is a service that needs it.
    own: Mutex<Option<Arc<Executor>>>,
}

impl Runner {
    /// Handlers that begin from here on are given to `spawn`.
    pub(crate) fn run_on(&self, spawn: Arc<Spawn>) {
        *lock(&self.spawn) = Some(spawn);
    }

    /// There is something that runs futures. [`Error::Network`] when the system refuses the thread.
    pub(crate) fn make(&self) -> Result<(), Error> {
        let mut own = lock(&self.own);
        if own.is_none() && lock(&self.spawn).is_none() {
            *own = Some(Arc::new(Executor::start("cara-tasks")?));
        }
        Ok(())
    }

    pub(super) fn spawn(&self, task: Spawned) {
        let spawn = lock(&self.spawn).clone();
        if let Some(spawn) = spawn {
            // A task that the executor does not take is dropped, and so its call is answered.
            if catch_unwind(AssertUnwindSafe(|| spawn(task))).is_err() {
                tracing::error!("the executor of the services panicked");
            }
            return;
        }
        let own = lock(&self.own).clone();
        if let Some(executor) = own {
            OwnTask::start(task, executor);
        }
    }

    /// Ends the unit's own thread.
    pub(super) fn end(&self) {
        let own = lock(&self.own).take();
        own.into_iter().for_each(|executor| executor.end());
    }
}

/// One call until it is answered. Dropped before, as by an executor that ends, it is answered as not ready.
pub(super) struct Task {
    unit: Arc<dyn Reports>,
    driver: Arc<Driver>,
    link: Arc<LinkCell>,
    call: Incoming,
    /// Until when its caller waits for an answer, on the system's boot clock.
    end: Option<Duration>,
    /// The handler, while it runs.
    work: Option<Work>,
    /// What is answered once it does not.
    result: Result<Box<ParametersView>, Error>,
    given_up: Option<Arc<GivenUp>>,
    /// The handler is notified that its call is given up, instead of being dropped.
    to_its_end: bool,
    lease: LeaseEnded,
    alarm: Alarm,
    /// What it has said of its failure.
    failure: Option<Box<Failure>>,
    answered: bool,
}

impl Task {
    /// Begins the handler of a call; what it leads to is answered by the task.
    pub(super) fn begin(
        unit: Arc<dyn Reports>,
        driver: Arc<Driver>,
        link: &Arc<LinkCell>,
        call: Incoming,
        reported: handler::Served,
        (begin, to_its_end): (&Begin, bool),
        arguments: Box<ParametersView>,
    ) -> Self {
        let (lease, given_up) = (reported.lease_ended(), reported.given_up.clone());
        let caller = reported.caller.clone();
        let waited_for = call.wants_reply && call.order.is_none();
        let end = waited_for.then(|| driver.clock().boot_time_of(call.deadline));
        let work = nested::until(end, || catch_unwind(AssertUnwindSafe(|| begin(reported, arguments))));
        if work.is_err() {
            tracing::error!(%caller, "a handler panicked");
        }
        let (work, result) = match work {
            Ok(work) => (Some(work), Err(Error::Service(ServiceError::NotReady))),
            Err(_) => (None, Err(Error::Service(ServiceError::Panicked))),
        };
        let alarm = Alarm::new(driver.clone());
        let link = link.clone();
        let (failure, answered) = (None, false);
        Self { unit, driver, link, call, end, work, result, given_up, to_its_end, lease, alarm, failure, answered }
    }

    /// Whether nothing wants the call any more: its caller's time is over, its link or its order has ended. Otherwise the
    /// task is woken when that changes.
    fn is_given_up(&mut self, cx: &mut Context<'_>) -> bool {
        let mut state = self.link.lock();
        let is_live = state.session.is_live() && !state.session.is_cancelled(self.call.ticket);
        if is_live {
            state.await_end(self.call.ticket, cx.waker());
        }
        drop(state);
        let waits = self.call.wants_reply;
        if !is_live || (waits && self.driver.clock().now() >= self.call.deadline) {
            return true;
        }
        if waits {
            self.alarm.set(self.call.deadline, cx.waker());
        }
        Pin::new(&mut self.lease).poll(cx).is_ready()
    }

    /// Goes on with the handler; ready when it does not run any more.
    fn go_on(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let is_given_up = self.work.is_some() && self.is_given_up(cx);
        let Some(work) = &mut self.work else { return Poll::Ready(()) };
        if is_given_up {
            self.given_up.iter().for_each(|given_up| given_up.notify());
        }
        let ended = if is_given_up && !self.to_its_end {
            Ok(Err(Error::Expired))
        } else {
            // What it asks once it is notified is no longer for its caller.
            let end = self.end.filter(|_| !is_given_up);
            match nested::until(end, || catch_unwind(AssertUnwindSafe(|| work.as_mut().poll(cx)))) {
                Ok(Poll::Pending) => return Poll::Pending,
                Ok(Poll::Ready(result)) => Ok(result.map_err(Error::Service)),
                Err(panic) => Err(panic),
            }
        };
        let dropped = catch_unwind(AssertUnwindSafe(|| self.work = None));
        self.result = ended.and_then(|ended| dropped.map(|()| ended)).unwrap_or_else(|_| {
            tracing::error!("a handler panicked");
            Err(Error::Service(ServiceError::Panicked))
        });
        Poll::Ready(())
    }

    /// Answers, unless there is no room for it now. Without a waker, or after the deadline, the answer is dropped then.
    fn answer(&mut self, waker: Option<&Waker>) -> Poll<()> {
        let (link, ticket) = (&self.link, self.call.ticket);
        let now = self.driver.clock().now();
        let answer = self.result.as_deref().map_err(|error| *error);
        let mut state = link.lock();
        if self.failure.is_none() {
            self.failure = state.details.take_failure(ticket);
        }
        let failure = self.failure.as_deref();
        let kept = self.unit.try_answer(now, link, &mut state, ticket, answer, failure);
        match waker.filter(|_| kept.is_err() && now < self.call.deadline) {
            Some(waker) => {
                state.await_change(waker);
                self.unit.give_up_lock(now, link, state);
                self.alarm.set(self.call.deadline.min(now + PAUSE), waker);
                Poll::Pending
            }
            None => {
                if kept.is_err() {
                    state.session.unrecorded(OFFERS).drop_answer(ticket);
                }
                state.await_no_end(ticket);
                if state.session.has_next_call() {
                    self.driver.pool().hand_over(link.token());
                }
                self.unit.give_up_lock(now, link, state);
                self.answered = true;
                Poll::Ready(())
            }
        }
    }
}

impl Future for Task {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        match self.go_on(cx) {
            Poll::Ready(()) => self.answer(Some(cx.waker())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl Drop for Task {
    fn drop(&mut self) {
        if !self.answered {
            // The handler's future may hold what the order's end needs, so it is dropped first.
            let _ = catch_unwind(AssertUnwindSafe(|| self.work = None));
            let _ = self.answer(None);
        }
    }
}

/// A task that the unit's own thread runs.
struct OwnTask {
    work: Mutex<Option<Spawned>>,
    executor: Arc<Executor>,
    /// It waits for the thread.
    is_queued: AtomicBool,
}

impl OwnTask {
    fn start(work: Spawned, executor: Arc<Executor>) {
        Arc::new(Self { work: Mutex::new(Some(work)), executor, is_queued: AtomicBool::new(false) }).wake();
    }

    fn poll(self: Arc<Self>) {
        // Before it is polled: what happens from here on queues it again.
        self.is_queued.store(false, Ordering::SeqCst);
        let waker = Waker::from(self.clone());
        let mut work = lock(&self.work);
        let is_over = work.as_mut().is_none_or(|work| work.as_mut().poll(&mut Context::from_waker(&waker)).is_ready());
        let ended = if is_over { work.take() } else { None };
        drop(work);
        drop(ended);
    }
}

impl Wake for OwnTask {
    fn wake(self: Arc<Self>) {
        if !self.is_queued.swap(true, Ordering::SeqCst) {
            let task = self.clone();
            self.executor.run(move || task.poll());
        }
    }
}
