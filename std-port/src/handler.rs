//! What runs a service: functions and methods, in the paper's form (`Parameters` in, `Parameters` out) and in place.

use std::sync::Arc;

use cara_core::config::Priority;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::ServiceError;
use cara_core::services::lease::{Lease, Service};
use cara_core::time::{Duration, Instant};

use crate::lease::LeaseWatch;

/// What a handler is told about the call that it serves.
#[derive(Clone, Debug)]
pub struct Call {
    /// Who calls.
    pub caller: Identity,
    /// The call's class.
    pub priority: Priority,
    /// After this nobody waits for the answer; on the unit's clock.
    pub deadline: Instant,
    /// Whether the caller waits.
    pub wants_reply: bool,
    /// The service's lease, if it has one: what the call starts may go on while it is live.
    pub lease: Option<LeaseWatch>,
}

type Free = dyn Fn(&Call, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
type Method<T> = dyn Fn(&mut T, &Call, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
/// Runs when something was lost.
pub(crate) type Hook<T> = dyn Fn(&mut T) + Send + Sync;

/// How a handler is run.
pub(crate) enum Run<T> {
    /// Without the application's state; calls run side by side.
    Free(Arc<Free>),
    /// With it, under its lock.
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

/// A service as the list of functions holds it.
pub(crate) struct Handler<T> {
    pub(crate) run: Run<T>,
    pub(crate) lease: Option<Arc<Lease>>,
    pub(crate) safe: Option<Arc<Hook<T>>>,
    pub(crate) detached: bool,
}

impl<T: 'static> Service for Handler<T> {
    fn lease(&self) -> Option<&Lease> {
        self.lease.as_deref()
    }
}

/// How a service wants to be called, and what makes it safe.
pub struct ServiceOptions<T> {
    pub(crate) priority: Priority,
    pub(crate) lease: Option<Duration>,
    pub(crate) idempotent: bool,
    pub(crate) detached: bool,
    pub(crate) safe: Option<Arc<Hook<T>>>,
}

impl<T> Default for ServiceOptions<T> {
    fn default() -> Self {
        Self { priority: Priority::Normal, lease: None, idempotent: false, detached: false, safe: None }
    }
}

impl<T> ServiceOptions<T> {
    /// Normal priority, no lease.
    pub fn new() -> Self {
        Self::default()
    }

    /// The class of calls that name none.
    pub fn priority(mut self, priority: Priority) -> Self {
        self.priority = priority;
        self
    }

    /// What the service starts goes on for this long after the caller's last sign that it wants it; then `safe` runs,
    /// once, before any other work. It must be short: other leases wait for it.
    pub fn lease(mut self, length: impl Into<Duration>, safe: impl Fn(&mut T) + Send + Sync + 'static) -> Self {
        self.lease = Some(length.into());
        self.safe = Some(Arc::new(safe));
        self
    }

    /// It takes long: the caller's next call of the same class begins while it runs, in a thread of its own.
    pub fn detached(mut self) -> Self {
        self.detached = true;
        self
    }

    /// Running it twice is as good as running it once.
    pub fn idempotent(mut self) -> Self {
        self.idempotent = true;
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
