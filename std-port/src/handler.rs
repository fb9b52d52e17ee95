//! What runs a service: functions and methods, in the paper's form (`Parameters` in, `Parameters` out) and in place.

use std::fmt;
use std::sync::Arc;

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::{Lease, Order, Service};
use cara_core::time::{Duration, Instant};

use crate::executor::Executor;
use crate::lease::{LeaseEnded, LeaseWatch, ServiceLease};
use crate::safe_hook::SafeHook;

/// What a handler is told about the call that it serves.
#[derive(Clone, Debug)]
pub struct Call {
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
}

impl Call {
    /// Ends when what the call starts may go on no longer, for whatever reason; never for a service without a lease.
    /// [`LeaseWatch::wait_until_ended`] is the form that blocks.
    pub fn lease_ended(&self) -> LeaseEnded {
        LeaseEnded { watch: self.lease.clone() }
    }
}

type Free = dyn Fn(&Call, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
type Method<T> = dyn Fn(&mut T, &Call, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
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
}

impl<T> Clone for Run<T> {
    fn clone(&self) -> Self {
        match self {
            Self::Free(run) => Self::Free(run.clone()),
            Self::Method(run) => Self::Method(run.clone()),
        }
    }
}

impl<T> Run<T> {
    /// It waits for the application's state.
    pub(crate) const fn takes_state(&self) -> bool {
        matches!(self, Self::Method(_))
    }
}

/// A service as the list of functions holds it.
pub(crate) struct Handler<T> {
    pub(crate) run: Run<T>,
    /// To be read; a service has it together with the hook, which writes it.
    pub(crate) lease: Option<Arc<ServiceLease>>,
    pub(crate) safe: Option<Arc<SafeHook>>,
    /// Where its emergencies run, if it is a service for those.
    pub(crate) executor: Option<Arc<Executor>>,
}

impl<T: 'static> Service for Handler<T> {
    fn lease(&self) -> Option<&Lease> {
        self.lease.as_ref().map(|service| &service.lease)
    }

    fn begin_lease(&self, now: Instant, end: Instant) -> Result<Option<Order>, Error> {
        let Some(safe) = &self.safe else { return Ok(None) };
        safe.begin(now, end).map(Some).ok_or(Error::Busy)
    }

    fn renew_lease(&self, order: Order, end: Instant) -> bool {
        self.safe.as_ref().is_none_or(|safe| safe.renew(order, end))
    }

    fn cut_lease(&self, order: Order) {
        if let Some(safe) = &self.safe {
            safe.cut(order);
        }
    }

    fn finish_lease(&self, order: Order) -> bool {
        self.safe.as_ref().is_none_or(|safe| safe.finish(order))
    }

    fn expire_lease(&self, order: Order) -> bool {
        self.safe.as_ref().is_none_or(|safe| safe.expire(order))
    }
}

impl<T> Drop for Handler<T> {
    fn drop(&mut self) {
        if let Some(safe) = &self.safe {
            safe.clear();
        }
        if let Some(lease) = &self.lease {
            lease.wake();
        }
    }
}

/// How a service wants to be called, and what makes it safe.
pub struct ServiceOptions<T> {
    pub(crate) attributes: Attributes,
    pub(crate) safe: Option<Arc<Safe>>,
    pub(crate) then: Option<Arc<Hook<T>>>,
}

impl<T> fmt::Debug for ServiceOptions<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServiceOptions").field("attributes", &self.attributes).finish_non_exhaustive()
    }
}

impl<T> Default for ServiceOptions<T> {
    fn default() -> Self {
        Self { attributes: Attributes::default(), safe: None, then: None }
    }
}

impl<T> ServiceOptions<T> {
    /// Normal priority, no lease.
    pub fn new() -> Self {
        Self::default()
    }

    /// The class of calls that name none. A service of the class [`Priority::Emergency`] has a thread of its own, and
    /// takes a handler without the application's state: see [`Error::EmergencyWaits`](cara_core::error::Error).
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
/// | in place, free | `fn(&Call, &mut ParametersView) -> Result<(), ServiceError>` |
/// | in place, method | `fn(&mut T, &Call, &mut ParametersView) -> Result<(), ServiceError>` |
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

impl<T, F, const BYTES: usize> IntoHandler<T, fn(Parameters<BYTES>) -> Parameters<BYTES>> for F
where
    F: Fn(Parameters<BYTES>) -> Parameters<BYTES> + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Free(Arc::new(move |_, view| by_value(view, &self))))
    }
}

impl<T, F, const BYTES: usize> IntoHandler<T, fn(&mut T, Parameters<BYTES>) -> Parameters<BYTES>> for F
where
    F: Fn(&mut T, Parameters<BYTES>) -> Parameters<BYTES> + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Method(Arc::new(move |state, _, view| by_value(view, |parameters| self(state, parameters)))))
    }
}

impl<T, F> IntoHandler<T, fn(&Call, &mut ParametersView) -> Result<(), ServiceError>> for F
where
    F: Fn(&Call, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Free(Arc::new(self)))
    }
}

impl<T, F> IntoHandler<T, fn(&mut T, &Call, &mut ParametersView) -> Result<(), ServiceError>> for F
where
    F: Fn(&mut T, &Call, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Method(Arc::new(self)))
    }
}

/// Runs a service of the paper's form on the parameters of a call.
fn by_value<const BYTES: usize>(
    view: &mut ParametersView,
    service: impl FnOnce(Parameters<BYTES>) -> Parameters<BYTES>,
) -> Result<(), ServiceError> {
    let mut arguments = Parameters::<BYTES>::sized();
    arguments.copy_from(view).map_err(|_| ServiceError::BadResults)?;
    let results = service(arguments);
    view.copy_from(&results).map_err(|_| ServiceError::BadResults)
}
