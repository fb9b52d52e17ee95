//! What runs a service: the runner itself, or a task that takes the calls.

use core::cell::RefCell;
use core::fmt;

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::{Ended, Lease, Service};
use cara_core::time::{Duration, Instant};

use crate::handle::Handle;
use crate::lease::LeaseWatch;
use crate::time::now;

/// What a handler is told about the call that it serves.
pub struct Served<T: 'static> {
    /// The caller.
    pub caller: Identity,
    /// The call's class.
    pub priority: Priority,
    /// After this the caller no longer waits; on the clock of [`now`](crate::now).
    pub deadline: Instant,
    /// Whether the caller waits.
    pub wants_reply: bool,
    /// The call's hold of the service's lease, if there is one: what the call starts may go on while it is live.
    pub lease: Option<LeaseWatch>,
    /// The unit that serves, which can request from any other, the caller among them.
    pub unit: Handle<T>,
    /// What the handler has said of its failure.
    #[cfg(feature = "details")]
    pub(crate) failure: core::cell::Cell<Option<cara_core::distribution::failure::Failure>>,
    /// The call, unless the handler has taken it.
    #[cfg(feature = "details")]
    pub(crate) running: core::cell::Cell<Option<crate::task_slots::Running>>,
}

impl<T> fmt::Debug for Served<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Served")
            .field("caller", &self.caller)
            .field("priority", &self.priority)
            .field("deadline", &self.deadline)
            .field("wants_reply", &self.wants_reply)
            .field("lease", &self.lease)
            .finish_non_exhaustive()
    }
}

impl<T> Served<T> {
    /// Runs `change` unless the order of the call has ended; always if the service has no lease.
    pub fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        match &self.lease {
            Some(lease) => lease.commit(change),
            None => Ok(change()),
        }
    }

    /// Completes when what the call started may no longer continue, for whatever reason; never for a service without a lease.
    /// Cancelling loses nothing.
    pub async fn lease_ended(&self) {
        self.unit.lease_ended(self.lease).await;
    }
}

/// A service that the runner runs, with the application's state.
pub type Method<T> = dyn Fn(&mut T, &Served<T>, &mut ParametersView) -> Result<(), ServiceError>;
/// A service that the runner runs, without it.
pub type Free<T> = dyn Fn(&Served<T>, &mut ParametersView) -> Result<(), ServiceError>;
/// Makes safe what a service has started.
pub type Safe = dyn Fn();
/// Runs after something has ended.
pub type Hook<T> = dyn Fn(&mut T);

/// What runs a service.
///
/// | form | example |
/// |---|---|
/// | in place | `Handler::method(&\|agv: &mut Agv, call, parameters\| agv.pos_info(parameters))` |
/// | in place, without the state, as an emergency service is | `Handler::free(&\|call, parameters\| brake())` |
/// | the paper's, free | `Handler::paper(echo)` with `fn echo(parameters: Parameters) -> Parameters` |
/// | the paper's, method | `Handler::paper_method(Agv::pos_info)` |
/// | by a task that awaits | `Handler::task()`, and there `unit.next_call("go_to", &mut parameters).await` |
pub struct Handler<T: 'static> {
    run: Run<T>,
}

impl<T> fmt::Debug for Handler<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Handler").finish_non_exhaustive()
    }
}

impl<T> Clone for Handler<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Handler<T> {}

enum Run<T: 'static> {
    Free(&'static Free<T>),
    Method(&'static Method<T>),
    Paper(fn(Parameters) -> Parameters),
    PaperMethod(fn(&mut T, Parameters) -> Parameters),
    Task,
}

impl<T> Clone for Run<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Run<T> {}

impl<T> Handler<T> {
    /// A service in place: arguments come in the parameters, results go there. It runs in the runner, so it must be
    /// short; a closure without captures or a function will do.
    pub const fn method(run: &'static Method<T>) -> Self {
        Self { run: Run::Method(run) }
    }

    /// A service in place that does not get the application's state.
    pub const fn free(run: &'static Free<T>) -> Self {
        Self { run: Run::Free(run) }
    }

    /// A function of the paper's form.
    pub const fn paper(run: fn(Parameters) -> Parameters) -> Self {
        Self { run: Run::Paper(run) }
    }

    /// A method of the paper's form.
    pub const fn paper_method(run: fn(&mut T, Parameters) -> Parameters) -> Self {
        Self { run: Run::PaperMethod(run) }
    }

    /// A task takes the calls with [`Handle::next_call`], and may await before it replies.
    pub const fn task() -> Self {
        Self { run: Run::Task }
    }

    pub(crate) fn is_task(&self) -> bool {
        matches!(self.run, Run::Task)
    }

    /// It may wait for something of the application.
    pub(crate) fn waits(&self) -> bool {
        !matches!(self.run, Run::Free(_) | Run::Paper(_))
    }

    /// [`Error::WouldDeadlock`] when the state is lent already.
    pub(crate) fn run(
        &self,
        state: &RefCell<T>,
        call: &Served<T>,
        parameters: &mut ParametersView,
    ) -> Result<(), Error> {
        let state = || state.try_borrow_mut().map_err(|_| Error::WouldDeadlock);
        let result = match self.run {
            Run::Free(run) => run(call, parameters),
            Run::Method(run) => run(&mut *state()?, call, parameters),
            Run::Paper(run) => by_value(parameters, &mut |arguments| run(arguments)),
            Run::PaperMethod(run) => {
                let mut state = state()?;
                by_value(parameters, &mut |arguments| run(&mut state, arguments))
            }
            Run::Task => Err(ServiceError::NotReady),
        };
        result.map_err(Error::Service)
    }
}

/// Runs a service of the paper's form on the parameters of a call. Kept apart: only such services pay for copies.
#[inline(never)]
fn by_value(view: &mut ParametersView, service: &mut dyn FnMut(Parameters) -> Parameters) -> Result<(), ServiceError> {
    let mut arguments = Parameters::new();
    arguments.copy_from(view).map_err(|_| ServiceError::BadResults)?;
    view.copy_from(&service(arguments)).map_err(|_| ServiceError::BadResults)
}

/// How a service wants to be called, and what makes it safe.
pub struct ServiceOptions<T: 'static> {
    pub(crate) attributes: Attributes,
    pub(crate) lease: Option<&'static Lease>,
    pub(crate) safe: Option<&'static Safe>,
    pub(crate) then: Option<&'static Hook<T>>,
}

impl<T> fmt::Debug for ServiceOptions<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServiceOptions").field("attributes", &self.attributes).finish_non_exhaustive()
    }
}

impl<T> Default for ServiceOptions<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T> ServiceOptions<T> {
    /// Normal priority, no lease.
    pub const fn new() -> Self {
        Self { attributes: Attributes::NORMAL, lease: None, safe: None, then: None }
    }

    /// The class of calls that name none.
    pub const fn priority(mut self, priority: Priority) -> Self {
        self.attributes.priority = priority;
        self
    }

    /// What the service starts goes on for this long after the caller's last sign that it wants it; then `safe` runs,
    /// once, before any other work. It must be short, and does not get the application's state: what it switches off is
    /// a pin, or a static that the motors read; what needs the state belongs in [`then`](Self::then). `lease` is a static
    /// of what the service moves, which a motor's interrupt can read: it is dead in time also when no task runs any more.
    /// Services that move the same thing share one, and its hook: an order of one of them takes the place of any other's.
    pub fn lease(mut self, length: impl Into<Duration>, lease: &'static Lease, safe: &'static Safe) -> Self {
        self.attributes.lease = Some(length.into());
        self.lease = Some(lease);
        self.safe = Some(safe);
        self
    }

    /// Before the handler runs, the order that holds this lease ends, whichever caller has it, and its hook runs before any
    /// other work. No order begins until a reset, and none that was asked for before the stop ever does. Not a substitute for
    /// a certified emergency stop.
    pub const fn stops(mut self, lease: &'static Lease) -> Self {
        self.lease = Some(lease);
        self.stops_all()
    }

    /// As [`stops`](Self::stops), for all leases of the unit.
    pub const fn stops_all(mut self) -> Self {
        self.attributes.stop = true;
        self
    }

    /// When the handler has returned results, orders of this lease may begin again, unless it was stopped meanwhile. A
    /// handler that finds it unsafe answers with an error.
    pub const fn resets(mut self, lease: &'static Lease) -> Self {
        self.lease = Some(lease);
        self.resets_all()
    }

    /// As [`resets`](Self::resets), for all leases of the unit.
    pub const fn resets_all(mut self) -> Self {
        self.attributes.reset = true;
        self
    }

    /// Runs each time after the safe hook, with the application's state.
    pub const fn then(mut self, hook: &'static Hook<T>) -> Self {
        self.then = Some(hook);
        self
    }

    /// Running it twice is as good as running it once.
    pub const fn idempotent(mut self) -> Self {
        self.attributes.idempotent = true;
        self
    }
}

/// A service as the list of functions holds it.
pub(crate) struct Listed<T: 'static> {
    pub(crate) handler: Handler<T>,
    pub(crate) lease: Option<&'static Lease>,
    pub(crate) safe: Option<&'static Safe>,
    pub(crate) then: Option<&'static Hook<T>>,
    /// Its newest value, of a stream.
    #[cfg(feature = "streams")]
    pub(crate) stream: Option<&'static dyn crate::stream_cell::Cell>,
}

impl<T> Clone for Listed<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Listed<T> {}

impl<T> Listed<T> {
    /// The service goes: an order that has not ended does so. Its safe hook is to run then; the one behind it, which takes the
    /// application's state, does not.
    pub(crate) fn clear(self) -> Option<&'static Safe> {
        // A service without a hook moves nothing: it stops or resets what others move.
        let safe = self.safe?;
        self.lease?.clear(now()).then_some(safe)
    }
}

impl<T> Service for Listed<T> {
    fn lease(&self) -> Option<&Lease> {
        self.lease
    }

    #[cfg(feature = "streams")]
    fn stream(&self) -> Option<&dyn cara_core::services::stream::Source> {
        self.stream.map(|cell| cell as &dyn cara_core::services::stream::Source)
    }
}
