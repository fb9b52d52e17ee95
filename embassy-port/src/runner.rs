//! The task that drives a unit.

use core::convert::Infallible;
use core::fmt;
use core::future::{Future, poll_fn};
use core::pin::pin;
use core::task::{Context, Poll};

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::session::Incoming;
use cara_core::time::{Duration, Instant};

use crate::driving::Job;
use crate::handle::Handle;
use crate::handler::{Hook, Listed, Served};
use crate::lease::LeaseWatch;
use crate::machine::Started;
use crate::machine::{Machine, Shared};
use crate::mail::Connection;
use crate::port::LinkSession;
use crate::task_slots::Running;
use crate::time::{now, timer};

/// Steps in a row before other tasks get their turn.
const BUDGET: usize = 64;
/// While something moves, it is looked at least this often whether an interrupt has stopped it.
const LOOK: Duration = Duration::from_millis(20);
/// Drives a unit; the one that [`new`](crate::new) returns. It needs a task of its own.
pub struct Runner<T: 'static> {
    pub(crate) shared: &'static Shared<T>,
    /// What arrives is looked at in here.
    pub(crate) scratch: &'static mut [u8],
    /// The arguments and results of the call that runs.
    pub(crate) arguments: &'static mut ParametersView,
    /// Nothing is due before, by what the last rest has seen.
    pub(crate) rested_until: Instant,
    /// A call whose results are still in there, because they could be kept nowhere else.
    pub(crate) unanswered: Option<(Running, Result<(), Error>)>,
}

impl<T> fmt::Debug for Runner<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Runner").finish_non_exhaustive()
    }
}

/// What a step led to.
enum Step {
    Job(Job),
    Again,
    Idle,
}

impl<T> Runner<T> {
    /// Searches, connects, serves, for ever.
    ///
    /// In a task of its own: joined with the application in one task, the two wake each other for ever.
    pub async fn run(&mut self) -> ! {
        match poll_fn(|cx| self.poll(cx)).await {}
    }

    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Infallible> {
        // First, so that what a service asks of the unit is seen by the next poll.
        self.shared.machine.borrow_mut().wakers.runner.register(context.waker());
        for _ in 0..BUDGET {
            let is_through = match self.step(context) {
                Step::Job(job) => {
                    self.run_job(job);
                    false
                }
                Step::Again => self.serve_started(),
                Step::Idle => true,
            };
            // A waker that has given way may have been the last of a task, with which something was dropped.
            if is_through && self.rest(context) && !self.shared.unwanted.is_due() {
                return Poll::Pending;
            }
            let machine = &mut *self.shared.machine.borrow_mut();
            if core::mem::take(&mut machine.yields) | machine.proof.has_computed() {
                break;
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }

    /// Leases first, so that what moves stops before anything else is done.
    #[inline(never)]
    fn step(&mut self, context: &mut Context<'_>) -> Step {
        let shared = self.shared;
        let machine = &mut *shared.machine.borrow_mut();
        shared.unwanted.release(machine);
        // Each step may make something due at once. Only after a rest is it known until when nothing is due.
        let awaits_hook = machine.awaits_hook();
        let is_due = awaits_hook | (now() >= core::mem::replace(&mut self.rested_until, Instant::START));
        // Until there is an address each step looks: a connection must not be there before it.
        if is_due || machine.address.is_none() || machine.mail.is_cut() {
            machine.look_at_network(context);
        }
        if is_due {
            for index in machine.indices() {
                if let Some(event) = machine.poll_link(index, awaits_hook) {
                    return machine.recorded(index, event).map_or(Step::Again, Step::Job);
                }
            }
            machine.expire_reply(now());
        }
        // Answers before new bytes: a call that waits for room holds the parameters that the next call needs.
        self.answer_again(machine);
        machine.look_at_lines();
        if is_due && !machine.stopped {
            if let Some(command) = machine.poll_node(context) {
                machine.act(command);
                return Step::Again;
            }
            machine.look_at_claims();
        }
        if let Some(event) = machine.read_datagram(self.scratch, context) {
            let job = event.and_then(|(index, event)| machine.recorded(index, event));
            return job.map_or(Step::Again, Step::Job);
        }
        // What waits to be written goes out before more is read, or a peer that only sends would keep every answer back.
        machine.write_links();
        self.read(machine)
    }

    fn read(&mut self, machine: &mut Machine<T>) -> Step {
        if self.begin_emergency(machine) {
            return Step::Again;
        }
        let busy = self.unanswered.is_some();
        // Peers take turns: the one whose call began last comes last.
        let last = usize::from(machine.started_on);
        for index in machine.indices().cycle().skip(last.saturating_add(1)).take(machine.indices().len()) {
            let arguments = if busy { None } else { Some(&mut *self.arguments) };
            if let Some(event) = machine.read_link(index, self.scratch, arguments) {
                let job = event.and_then(|event| machine.recorded(index, event));
                return job.map_or(Step::Again, Step::Job);
            }
            if !busy && let Some(Some(call)) = machine.with(index, |session, cx| session.next_call(cx, self.arguments))
            {
                (machine.started, machine.started_on) = (Started::Call(call), index);
                return Step::Again;
            }
        }
        Step::Idle
    }

    /// Begins an emergency that waits, on whichever link, also while an answer waits for room: results that nobody reads give way.
    fn begin_emergency(&mut self, machine: &mut Machine<T>) -> bool {
        for index in machine.indices() {
            let session = machine.link(index).and_then(|link| link.session.as_ref());
            // One that moves something waits for its claim as any other call.
            if !session.is_some_and(|session| session.has_next_emergency() && !session.awaits_claim()) {
                continue;
            }
            // Arguments come where results are kept. The order of that call goes on.
            if let Some((running, Ok(()))) = self.unanswered {
                self.unanswered = None;
                machine.give_up_answer(&running);
            }
            if let Some(Some(call)) = machine.with(index, |session, cx| session.next_emergency(cx, self.arguments)) {
                (machine.started, machine.started_on) = (Started::Call(call), index);
                return true;
            }
        }
        false
    }

    /// Whether nothing is due before the task is woken.
    #[inline(never)]
    fn rest(&mut self, context: &mut Context<'_>) -> bool {
        let machine = &mut *self.shared.machine.borrow_mut();
        for (link, line) in machine.links.iter().zip(machine.mail.connections.iter()) {
            line.wake_on_news(context, link.session.as_ref().is_some_and(LinkSession::wants_to_write));
        }
        let unanswered = self.unanswered.map_or(Instant::FAR_FUTURE, |(running, _)| running.deadline);
        self.rested_until = machine.next_look().min(unanswered);
        pin!(timer(self.rested_until)).poll(context).is_pending()
    }

    fn run_job(&mut self, job: Job) {
        match job {
            Job::Safe(slot) => {
                let machine = self.shared.machine.borrow();
                let Some(Listed { safe, then, .. }) =
                    machine.functions.function(slot).map(|function| *function.handler)
                else {
                    return;
                };
                drop(machine);
                if let Some(safe) = safe {
                    safe();
                }
                self.run_hook(then);
            }
            Job::Lost => {
                let hook = self.shared.machine.borrow().lost_hook;
                self.run_hook(hook);
            }
        }
    }

    /// Runs the call that has begun, if one has. Whether nothing can have become due by it, so that another step would
    /// find nothing.
    fn serve_started(&mut self) -> bool {
        let (started, link) = {
            let machine = &mut *self.shared.machine.borrow_mut();
            (core::mem::replace(&mut machine.started, Started::Nothing), machine.started_on)
        };
        let Started::Call(call) = started else { return false };
        self.serve(link, &call);
        self.unanswered.is_none() && self.shared.machine.borrow().has_read_all()
    }

    fn run_hook(&self, hook: Option<&'static Hook<T>>) {
        // The state is lent for the length of one call only, and never across an await.
        if let (Some(hook), Ok(mut state)) = (hook, self.shared.state.try_borrow_mut()) {
            hook(&mut state);
        }
    }

    #[inline(never)]
    fn serve(&mut self, link: u16, call: &Incoming) {
        let serial = self.shared.machine.borrow().link(link).map_or(0, |link| link.serial);
        let running = Running { link, serial, ticket: call.ticket, deadline: call.deadline };
        let result = self.begin(running, call);
        let Some(result) = result else { return };
        let machine = &mut *self.shared.machine.borrow_mut();
        let answer = result.map(|()| &*self.arguments);
        if !machine.answer(&running, answer) && !machine.park(running, answer) {
            // An emergency's, beside an error that waits: there is one place.
            if let Some((earlier, _)) = self.unanswered.replace((running, result)) {
                machine.give_up_answer(&earlier);
            }
        }
    }

    /// Runs a call; `None` when it is answered, or a task is left to do so.
    fn begin(&mut self, running: Running, call: &Incoming) -> Option<Result<(), Error>> {
        let (reported, handler) = {
            let machine = &mut *self.shared.machine.borrow_mut();
            let Some(function) = machine.functions.function(call.slot) else {
                return Some(Err(Error::StaleFunction));
            };
            let Listed { handler, lease, .. } = *function.handler;
            let Some(caller) = machine.link(running.link).and_then(|link| link.peer().cloned()) else {
                return Some(Err(Error::NotConnected));
            };
            if call.order.is_some() {
                // An earlier call of the service has given way.
                machine.wakers.leases.wake();
            }
            if handler.is_task() {
                return machine.leave_to_task(running, *call, caller, self.arguments).err().map(Err);
            }
            let reported = Served {
                caller,
                priority: call.priority,
                deadline: call.deadline,
                wants_reply: call.wants_reply,
                lease: LeaseWatch::new(lease, call),
                unit: Handle { shared: self.shared },
                #[cfg(feature = "details")]
                failure: Default::default(),
                #[cfg(feature = "details")]
                running: Some(running).into(),
            };
            (reported, handler)
        };
        let result = handler.run(&self.shared.state, &reported, self.arguments);
        #[cfg(feature = "details")]
        reported.running.take()?;
        // If the failure cannot be kept now, only its code waits.
        #[cfg(feature = "details")]
        if let Some(failure) = reported.failure.take()
            && result == Err((&failure).into())
            && self.shared.machine.borrow_mut().answer_failed(&running, &failure)
        {
            return None;
        }
        Some(result)
    }

    fn answer_again(&mut self, machine: &mut Machine<T>) {
        machine.answer_parked();
        if let Some((running, result)) = self.unanswered {
            let answer = result.map(|()| &*self.arguments);
            if machine.answer(&running, answer) || machine.park(running, answer) {
                self.unanswered = None;
            }
        }
    }
}

impl<T> Machine<T> {
    /// When something is due, or may be: an interrupt that stops what moves wakes no task.
    fn next_look(&self) -> Instant {
        let deadline = self.deadline();
        // What slows down has no deadline here: a claim is stored behind it.
        if self.moves() || (self.unstored.is_some() && !self.stopped) { deadline.min(now() + LOOK) } else { deadline }
    }

    /// When something is due.
    fn deadline(&self) -> Instant {
        let sessions = self.links.iter().filter_map(|link| link.session.as_ref());
        let sessions = sessions.map(LinkSession::deadline).min().unwrap_or(Instant::FAR_FUTURE);
        let lines = self.mail.connections.iter().map(Connection::deadline).min().unwrap_or(Instant::FAR_FUTURE);
        let node = if self.stopped { Instant::FAR_FUTURE } else { self.hub.node.next_deadline() };
        let kept = self.reply_deadline().min(self.parked_deadline());
        sessions.min(lines).min(node).min(kept).min(self.look)
    }
}
