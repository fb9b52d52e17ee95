//! What runs a service: functions and methods, in the paper's form (`Parameters` in, `Parameters` out) and in place.

use std::fmt;
#[cfg(feature = "async")]
use std::future::Future;
#[cfg(feature = "async")]
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use cara_core::config::Priority;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::{ActuatorState, Claim, Ended, Latch, Lease, LeaseEnd, Order, Service};
use cara_core::services::stream::Source;
use cara_core::time::{Duration, Instant};

use crate::actuator::Actuator;
use crate::engine::served::Serving;
use crate::engine::state::State;
use crate::engine::state_gate::Access;
use crate::engine::streams::OwnStream;
use crate::executor::Executor;
use crate::growing::HandlerParameters;
use crate::lease::{LeaseEnded, LeaseWatch};

/// What a handler is told about the call that it serves.
#[derive(Clone, Debug)]
pub struct Served {
    /// The caller.
    pub caller: Identity,
    /// The call's class.
    pub priority: Priority,
    /// After this the caller no longer waits; on the unit's clock.
    pub deadline: Instant,
    /// Whether the caller waits.
    pub wants_reply: bool,
    /// The call's hold of the service's lease, if there is one: what the call starts may go on while it is live.
    pub lease: Option<LeaseWatch>,
    pub(crate) serving: Serving,
    /// For a handler that is a future.
    #[cfg(feature = "async")]
    pub(crate) given_up: Option<Arc<crate::engine::served::GivenUp>>,
}

impl Served {
    /// Runs `change` unless the order of the call has ended; always if the service has no lease. See
    /// [`LeaseWatch::commit`].
    ///
    /// ```
    /// # use std::sync::atomic::{AtomicI64, Ordering};
    /// # use cara_std::{Served, ParametersView, ServiceError};
    /// static TARGET: AtomicI64 = AtomicI64::new(0);
    ///
    /// fn go_to(call: &Served, parameters: &mut ParametersView) -> Result<(), ServiceError> {
    ///     let target: i64 = parameters.variable("target")?;
    ///     call.commit(|| TARGET.store(target, Ordering::SeqCst))?;
    ///     Ok(())
    /// }
    /// ```
    pub fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        match &self.lease {
            Some(lease) => lease.commit(change),
            None => Ok(change()),
        }
    }

    /// What the handler returns for this failure, whose text and values go to the caller.
    ///
    /// ```
    /// # use cara_std::{Served, Failure, ParametersView, ServiceError};
    /// fn go_to(call: &Served, parameters: &mut ParametersView) -> Result<(), ServiceError> {
    ///     Err(call.fail(Failure::new(7, "the way is blocked")))
    /// }
    /// ```
    pub fn fail(&self, failure: Failure) -> ServiceError {
        let error = failure.error();
        self.serving.fail(failure);
        error
    }

    /// Tells the caller how far the call is, if it wants to know and the signature says `progress (…)`. It does not wait: of
    /// values that cannot be sent at once only the newest are kept, and none is sent after the answer. An error if they do not
    /// fit the signature.
    ///
    /// ```
    /// # use cara_std::{Served, Parameters, ParametersView, ServiceError};
    /// fn go_to(call: &Served, parameters: &mut ParametersView) -> Result<(), ServiceError> {
    ///     let mut left = Parameters::new();
    ///     left.add_int("left", 1)?;
    ///     for metres in (0..10).rev() {
    ///         if call.is_cancelled() {
    ///             return Err(ServiceError::Failed(1));
    ///         }
    ///         left.set_value("left", metres)?;
    ///         call.progress(&left)?;
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn progress(&self, values: &ParametersView) -> Result<(), Error> {
        self.serving.notify(values)
    }

    /// Whether the caller has given the call up, waits no longer, or is gone. What the handler returns then reaches
    /// nothing, unless the caller wants it all the same. For handlers that are futures there is `given_up`.
    pub fn is_cancelled(&self) -> bool {
        self.serving.is_cancelled()
    }

    /// Completes when what the call started may no longer continue, for whatever reason; never for a service without a lease.
    /// [`LeaseWatch::wait_until_ended`] is the form that blocks.
    pub fn lease_ended(&self) -> LeaseEnded {
        LeaseEnded { watch: self.lease.clone() }
    }
}

type Reader<T> = dyn Fn(&State<T>, &Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
type Free = dyn Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
type Method<T> = dyn Fn(&mut T, &Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
/// The rest of a handler that is a future: its results.
#[cfg(feature = "async")]
pub(crate) type Work = Pin<Box<dyn Future<Output = Result<Box<ParametersView>, ServiceError>> + Send>>;
/// Begins a handler that is a future. The results may lie where its arguments lay.
#[cfg(feature = "async")]
pub(crate) type Begin = dyn Fn(Served, Box<ParametersView>) -> Work + Send + Sync;
/// Makes safe what a service has started.
pub(crate) type Safe = dyn Fn() + Send + Sync;
/// Runs after something has ended.
pub(crate) type Hook<T> = dyn Fn(&mut T) + Send + Sync;

/// How a handler is run.
pub(crate) enum Run<T> {
    /// Without the application's state; calls run side by side.
    Free(Arc<Free>),
    /// With it, one at a time, in the order in which they began.
    Method(Arc<Method<T>>),
    /// As a method, but beside others that read.
    Reader(Arc<Reader<T>>),
    /// As a task, which holds neither the state nor a thread while it waits.
    #[cfg(feature = "async")]
    Task(Arc<Begin>),
}

impl<T> Clone for Run<T> {
    fn clone(&self) -> Self {
        match self {
            Self::Free(run) => Self::Free(run.clone()),
            Self::Method(run) => Self::Method(run.clone()),
            Self::Reader(run) => Self::Reader(run.clone()),
            #[cfg(feature = "async")]
            Self::Task(begin) => Self::Task(begin.clone()),
        }
    }
}

impl<T> Run<T> {
    /// For what it waits for the application's state, if it does.
    pub(crate) const fn access(&self) -> Option<Access> {
        match self {
            Self::Method(_) => Some(Access::Change),
            Self::Reader(_) => Some(Access::Read),
            _ => None,
        }
    }

    /// It may have to wait before it begins: for the state, or for an executor.
    pub(crate) const fn waits(&self) -> bool {
        !matches!(self, Self::Free(_))
    }
}

/// A service as the list of functions holds it.
pub(crate) struct Handler<T> {
    /// Its own, in the whole process.
    pub(crate) number: u64,
    pub(crate) run: Run<T>,
    /// What it moves, or what it alone stops or resets.
    pub(crate) actuator: Option<Actuator>,
    /// It moves it.
    pub(crate) moves: bool,
    /// It has held the state for long, which has been warned about.
    pub(crate) held_long: AtomicBool,
    /// Where its emergencies run, if it is a service for those.
    pub(crate) executor: Option<Arc<Executor>>,
    /// One that is a future is told that its call is given up, and not dropped.
    #[cfg(feature = "async")]
    pub(crate) to_its_end: bool,
    /// Its newest value, of a stream.
    pub(crate) stream: Option<Arc<OwnStream>>,
}

impl<T> Handler<T> {
    /// For the next one.
    pub(crate) fn next_number() -> u64 {
        static NUMBERS: AtomicU64 = AtomicU64::new(1);
        NUMBERS.fetch_add(1, Ordering::Relaxed)
    }
}

impl<T: 'static> Service for Handler<T> {
    fn lease(&self) -> Option<&Lease> {
        self.actuator.as_ref().map(Actuator::word)
    }

    fn stream(&self) -> Option<&dyn Source> {
        self.stream.as_deref().map(|stream| stream as &dyn Source)
    }

    fn begin_lease(&self, _: Instant, end: Instant, claim: &Claim) -> Result<Option<Order>, Error> {
        self.actuator.as_ref().map(|actuator| actuator.safe.begin(end, claim, self.number)).transpose()
    }

    fn inhibit(&self, now: Instant, latch: Latch) {
        if let Some(actuator) = &self.actuator {
            actuator.inhibit_at(now, latch);
        }
    }

    fn reset(&self, now: Instant, made: Instant) {
        if let Some(actuator) = &self.actuator {
            actuator.reset_at(now, made);
        }
    }

    fn renew_lease(&self, order: Order, end: Instant) -> bool {
        self.actuator.as_ref().is_none_or(|actuator| actuator.safe.renew(order, end))
    }

    fn cut_lease(&self, order: Order) {
        if let Some(actuator) = &self.actuator {
            actuator.safe.cut(order);
        }
    }

    fn finish_lease(&self, now: Instant, order: Order) -> bool {
        self.actuator.as_ref().is_some_and(|actuator| actuator.safe.finish(now, order))
    }

    fn expire_lease(&self, now: Instant, order: Order, how: LeaseEnd) -> bool {
        self.actuator.as_ref().is_none_or(|actuator| actuator.safe.expire(now, order, how))
    }

    fn state(&self) -> ActuatorState {
        self.actuator.as_ref().map(|actuator| actuator.safe.state()).unwrap_or_default()
    }
}

impl<T> Drop for Handler<T> {
    fn drop(&mut self) {
        if let Some(actuator) = self.actuator.as_ref().filter(|_| self.moves) {
            actuator.safe.clear(self.number);
            actuator.lease.wake();
        }
    }
}

/// How a service wants to be called, and what makes it safe.
pub struct ServiceOptions<T> {
    pub(crate) attributes: Attributes,
    pub(crate) actuator: Option<Actuator>,
    pub(crate) safe: Option<Arc<Safe>>,
    pub(crate) then: Option<Arc<Hook<T>>>,
    #[cfg(feature = "async")]
    pub(crate) to_its_end: bool,
}

impl<T> fmt::Debug for ServiceOptions<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServiceOptions").field("attributes", &self.attributes).finish_non_exhaustive()
    }
}

impl<T> Default for ServiceOptions<T> {
    fn default() -> Self {
        Self {
            attributes: Attributes::default(),
            actuator: None,
            safe: None,
            then: None,
            #[cfg(feature = "async")]
            to_its_end: false,
        }
    }
}

impl<T> ServiceOptions<T> {
    /// Normal priority, no lease.
    pub fn new() -> Self {
        Self::default()
    }

    /// The class of calls that name none. A service of the class [`Priority::Emergency`] has a thread of its own, and
    /// takes a handler without the application's state that is no future: see [`Error::EmergencyWaits`](cara_core::error::Error).
    pub fn priority(mut self, priority: Priority) -> Self {
        self.attributes.priority = priority;
        self
    }

    /// What the service starts goes on for this long after the caller's last sign that it wants it, 20 ms at least; then
    /// `safe` runs, once, and the next order of the service comes after it.
    ///
    /// The hook has a thread of its own and waits for nothing: not for the application's state, which it does not get, nor
    /// for other hooks, nor for any handler. It owns what it switches off (a pin, a descriptor, an atomic that the motor's
    /// loop reads). It must be short: while it runs for more than 100 ms, its service answers
    /// [`ServiceError::NotReady`], and it is counted (`HooksLate`). What needs the state belongs in [`then`](Self::then).
    ///
    /// ```
    /// # use std::{sync::{Arc, atomic::{AtomicBool, Ordering}}, time::Duration};
    /// # use cara_std::ServiceOptions;
    /// let power = Arc::new(AtomicBool::new(false));
    /// let off = power.clone();
    /// let options = ServiceOptions::<()>::new().lease(Duration::from_millis(400), move || off.store(false, Ordering::SeqCst));
    /// ```
    ///
    /// A hook that takes the state does not compile:
    ///
    /// ```compile_fail
    /// # use std::time::Duration;
    /// # use cara_std::ServiceOptions;
    /// struct Agv { speed: i64 }
    /// let options = ServiceOptions::<Agv>::new().lease(Duration::from_millis(400), |agv: &mut Agv| agv.speed = 0);
    /// ```
    pub fn lease(mut self, length: impl Into<Duration>, safe: impl Fn() + Send + Sync + 'static) -> Self {
        self.attributes.lease = Some(length.into());
        self.safe = Some(Arc::new(safe));
        self
    }

    /// As [`lease`](Self::lease), for what several services move: an order of one of them takes the place of any other's, and
    /// the hook is the actuator's.
    pub fn moves(mut self, actuator: &Actuator, length: impl Into<Duration>) -> Self {
        self.attributes.lease = Some(length.into());
        self.actuator = Some(actuator.clone());
        self
    }

    /// Before the handler runs, the order that moves this ends and its hook starts, whichever caller has it. No order begins until a
    /// reset, and none that was asked for before the stop ever does. Not a substitute for a certified emergency stop.
    pub fn stops(mut self, actuator: &Actuator) -> Self {
        self.actuator = Some(actuator.clone());
        self.stops_all()
    }

    /// As [`stops`](Self::stops), for all that the unit moves.
    pub const fn stops_all(mut self) -> Self {
        self.attributes.stop = true;
        self
    }

    /// When the handler has returned results, orders of this actuator may begin again, unless it was stopped meanwhile. A
    /// handler that finds it unsafe answers with an error.
    pub fn resets(mut self, actuator: &Actuator) -> Self {
        self.actuator = Some(actuator.clone());
        self.resets_all()
    }

    /// As [`resets`](Self::resets), for all that the unit moves.
    pub const fn resets_all(mut self) -> Self {
        self.attributes.reset = true;
        self
    }

    /// Runs each time after the safe hook, with the application's state, for which it may have to wait: nothing that makes
    /// safe belongs here.
    pub fn then(mut self, hook: impl Fn(&mut T) + Send + Sync + 'static) -> Self {
        self.then = Some(Arc::new(hook));
        self
    }

    /// Running it twice is as good as running it once.
    pub fn idempotent(mut self) -> Self {
        self.attributes.idempotent = true;
        self
    }

    /// All attributes at once, except for the lease, which [`lease`](Self::lease) takes together with its hook.
    pub fn attributes(mut self, attributes: Attributes) -> Self {
        self.attributes = Attributes { lease: self.attributes.lease, ..attributes };
        self
    }
}

/// What can be a service. `Form` tells the forms apart and is inferred.
///
/// | form | example |
/// |---|---|
/// | the paper's, free | `fn(Parameters) -> Parameters` |
/// | the paper's, method | `fn(&mut T, Parameters) -> Parameters` |
/// | in place, free | `fn(&Served, &mut ParametersView) -> Result<(), ServiceError>` |
/// | in place, method | `fn(&mut T, &Served, &mut ParametersView) -> Result<(), ServiceError>` |
/// | the paper's, future | `async fn(Parameters) -> Parameters` |
/// | future | `async fn(Served, Parameters) -> Result<Parameters, ServiceError>` |
/// | future of any size | `async fn(Served, Box<ParametersView>) -> Result<Box<ParametersView>, ServiceError>` |
///
/// `Parameters` may be of any size (`Parameters<2048>`), or [`GrowingParameters`](crate::GrowingParameters).
///
/// Futures need the feature `async`. One holds no thread of the unit while it waits, and not the state: it asks for that with
/// `with_state_async`. When its call is given up (the caller's deadline has passed, its link has ended, or the order of
/// the call has) it is dropped at its next `await`, or told: `ServiceOptions::runs_to_its_end`. What it started stops with
/// the order in either case.
pub trait IntoHandler<T, Form> {
    #[doc(hidden)]
    fn into_run(self) -> RunOf<T>;
}

/// A handler's form, erased.
#[doc(hidden)]
pub struct RunOf<T>(pub(crate) Run<T>);

impl<T> fmt::Debug for RunOf<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RunOf").finish_non_exhaustive()
    }
}

impl<T, F, P: HandlerParameters> IntoHandler<T, fn(P) -> P> for F
where
    F: Fn(P) -> P + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Free(Arc::new(move |_, view| by_value(view, &self))))
    }
}

impl<T, F, P: HandlerParameters> IntoHandler<T, fn(&mut T, P) -> P> for F
where
    F: Fn(&mut T, P) -> P + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Method(Arc::new(move |state, _, view| by_value(view, |parameters| self(state, parameters)))))
    }
}

impl<T, F> IntoHandler<T, fn(&Served, &mut ParametersView) -> Result<(), ServiceError>> for F
where
    F: Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Free(Arc::new(self)))
    }
}

impl<T, F> IntoHandler<T, fn(&mut T, &Served, &mut ParametersView) -> Result<(), ServiceError>> for F
where
    F: Fn(&mut T, &Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Method(Arc::new(self)))
    }
}

/// A method of an interface that reads the state.
pub(crate) struct Reads<T: 'static>(pub(crate) &'static cara_core::typed::Reader<T, Served>);

impl<T: Send + Sync> IntoHandler<T, Reads<T>> for Reads<T> {
    fn into_run(self) -> RunOf<T> {
        let run = move |state: &State<T>, call: &Served, parameters: &mut ParametersView| {
            state.read(|state| self.0(state, call, parameters)).unwrap_or(Err(ServiceError::NotReady))
        };
        RunOf(Run::Reader(Arc::new(run)))
    }
}

/// Runs a service of the paper's form on the parameters of a call.
fn by_value<P: HandlerParameters>(view: &mut ParametersView, service: impl FnOnce(P) -> P) -> Result<(), ServiceError> {
    let mut arguments = P::empty();
    arguments.fill(view).map_err(|_| ServiceError::BadResults)?;
    let mut results = service(arguments);
    view.copy_from(results.view_mut()).map_err(|_| ServiceError::BadResults)
}
