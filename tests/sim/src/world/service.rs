//! Services of simulated units: a closure that runs at one virtual instant, or a future that lives through many.

use std::cell::RefCell;
use std::fmt;
use std::future::Future;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::rc::Rc;

use cara_core::config::Priority;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::services::Ticket;
use cara_core::services::lease::{Ended, Latch, Lease, Order};
use cara_core::time::{Duration, Instant};

use super::actuator::Actuator;
use super::handle::UnitHandle;
use super::replies::Promise;
use super::streams::Values;
use crate::event::StreamId;

/// Parameters of any size on the heap.
pub type BoxedParameters = Box<ParametersView>;

/// How a service's run ends: the parameters with its results, or an error for the caller.
pub type Outcome = Result<BoxedParameters, ServiceError>;

type Running = Pin<Box<dyn Future<Output = Outcome>>>;

type Begun = dyn Fn(&Served, &ParametersView);

type AtOnce = dyn FnMut(&Served, &mut ParametersView) -> Result<(), ServiceError>;

enum Body {
    AtOnce(Box<RefCell<AtOnce>>),
    Future(Box<dyn Fn(Served, BoxedParameters) -> Running>),
}

/// What a handler is told about the call that it serves.
#[derive(Clone, Debug)]
pub struct Served {
    /// The caller.
    pub caller: Identity,
    /// The call's class.
    pub priority: Priority,
    /// After this the caller no longer waits; in virtual time.
    pub deadline: Instant,
    /// Whether the caller waits.
    pub wants_reply: bool,
    /// The call's hold of the service's lease, if there is one: what the call starts may go on while it is live.
    pub lease: Option<LeaseWatch>,
    /// The unit that serves, which can request from any other, the caller among them.
    pub unit: UnitHandle,
    pub(super) running: Rc<Serving>,
}

impl Served {
    /// What the handler is to return for this failure, whose text and values go to the caller.
    pub fn fail(&self, failure: Failure) -> ServiceError {
        let error = failure.error();
        *self.running.failure.borrow_mut() = Some(failure);
        error
    }

    /// Tells the caller how far the call is, if it wants to know. Of values that cannot be sent at once the newest ones are.
    pub fn progress(&self, values: &ParametersView) -> Result<(), Error> {
        self.unit.progress(self.running.stream, self.running.ticket, values)
    }

    /// Whether the caller has given the call up, or is gone.
    pub fn is_cancelled(&self) -> bool {
        self.unit.is_cancelled(self.running.stream, self.running.ticket)
    }

    /// Ends when the caller gives the call up, or goes.
    pub async fn cancelled(&self) {
        if !self.is_cancelled() {
            self.running.cancelled.clone().await;
        }
    }

    /// Does what the call wants to change, unless its order has ended; always for a service without a lease.
    pub fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        match &self.lease {
            Some(lease) => lease.commit(change),
            None => Ok(change()),
        }
    }
}

/// A call that runs, as its unit knows it.
pub(super) struct Serving {
    pub(super) stream: StreamId,
    pub(super) ticket: Ticket,
    /// What its handler has said of its failure.
    pub(super) failure: RefCell<Option<Failure>>,
    /// Kept when its caller has given it up.
    pub(super) cancelled: Promise<()>,
}

impl fmt::Debug for Serving {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.ticket)
    }
}

/// The lease of one call. Once dead it is dead for ever, whatever call comes next.
#[derive(Clone)]
pub struct LeaseWatch {
    actuator: Actuator,
    order: Order,
    unit: UnitHandle,
}

impl LeaseWatch {
    /// A call's hold of the lease of its service.
    pub(super) fn new(service: &Rc<Service>, order: Option<Order>, unit: &UnitHandle) -> Option<Self> {
        Some(Self { actuator: service.actuator.clone()?, order: order?, unit: unit.clone() })
    }

    pub(super) fn word(&self) -> &Lease {
        self.actuator.word()
    }

    pub(super) const fn order(&self) -> Order {
        self.order
    }

    /// Whether the caller still wants what this call started.
    pub fn is_live(&self) -> bool {
        self.word().is_live_for(self.order, self.unit.clock())
    }

    /// Does what the order wants, or nothing once it has ended.
    pub fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        if self.is_live() { Ok(change()) } else { Err(Ended) }
    }
}

impl fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LeaseWatch(live: {})", self.is_live())
    }
}

/// A service with its attributes.
///
/// ```
/// use cara_core::time::Duration;
/// use cara_sim::Service;
/// let slow = Service::new(|_, _| Ok(())).takes(Duration::from_millis(300));
/// let walking = Service::future(|call, parameters| async move {
///     while call.lease.as_ref().is_some_and(|lease| lease.is_live()) {
///         call.unit.sleep(Duration::from_millis(10)).await;
///     }
///     Ok(parameters)
/// });
/// # drop((slow, walking));
/// ```
pub struct Service {
    body: Body,
    takes: Duration,
    survives_panics: bool,
    pub(super) attributes: Attributes,
    /// What it moves, or what it alone stops or resets.
    pub(super) actuator: Option<Actuator>,
    /// What hears of its orders.
    pub(super) begun: Option<Box<Begun>>,
    /// The newest value, of a stream.
    pub(super) values: Option<Values>,
}

impl Service {
    /// A service in place: arguments come in the parameters, results go there.
    pub fn new(body: impl FnMut(&Served, &mut ParametersView) -> Result<(), ServiceError> + 'static) -> Self {
        Self::with(Body::AtOnce(Box::new(RefCell::new(body))))
    }

    /// A service in the paper's form: it takes parameters and returns them.
    pub fn returning<const BYTES: usize>(
        mut body: impl FnMut(Parameters<BYTES>) -> Parameters<BYTES> + 'static,
    ) -> Self {
        Self::new(move |_, parameters| {
            let mut arguments = Parameters::sized();
            arguments.copy_from(parameters).map_err(|_| ServiceError::BadResults)?;
            parameters.copy_from(&body(arguments)).map_err(|_| ServiceError::BadResults)
        })
    }

    /// A service that lives through virtual time: it may sleep and call others, while its unit goes on serving.
    pub fn future<F>(body: impl Fn(Served, BoxedParameters) -> F + 'static) -> Self
    where
        F: Future<Output = Outcome> + 'static,
    {
        Self::with(Body::Future(Box::new(move |call, parameters| Box::pin(body(call, parameters)))))
    }

    /// What a call of it started is made safe when the service goes.
    pub(super) fn goes(&self, unit: &UnitHandle) {
        if let Some(actuator) = self.actuator.as_ref().filter(|_| self.attributes.lease.is_some())
            && actuator.word().clear(unit.clock())
        {
            actuator.make_safe(unit);
        }
    }

    /// A stream, which is not called.
    pub(super) fn stream(values: Values) -> Self {
        Self { values: Some(values), ..Self::new(|_, _| Err(ServiceError::NotReady)) }
    }

    fn with(body: Body) -> Self {
        let attributes = Attributes::default();
        Self {
            body,
            takes: Duration::ZERO,
            survives_panics: false,
            attributes,
            actuator: None,
            begun: None,
            values: None,
        }
    }

    /// It answers this much later; the unit goes on with everything else meanwhile.
    pub fn takes(self, span: Duration) -> Self {
        Self { takes: span, ..self }
    }

    /// The class of calls that name none.
    pub fn priority(self, priority: Priority) -> Self {
        Self { attributes: Attributes { priority, ..self.attributes }, ..self }
    }

    /// What it starts goes on for this long after the caller's last sign that it wants it; then `safe` runs, once, before
    /// anything else the unit does.
    pub fn lease(self, length: Duration, safe: impl Fn(&UnitHandle) + 'static) -> Self {
        self.moves(&Actuator::new(safe), length)
    }

    /// As [`lease`](Self::lease), for what several services move: an order of one of them takes the place of any other's, and
    /// the hook is the actuator's.
    pub fn moves(self, actuator: &Actuator, length: Duration) -> Self {
        let attributes = Attributes { lease: Some(length), ..self.attributes };
        Self { attributes, actuator: Some(actuator.clone()), ..self }
    }

    /// `begun` hears of each order that begins, before its handler and in turn with the safe hooks of the orders before and behind
    /// it: also of one that ends at once, whose handler never runs.
    pub fn on_order(self, begun: impl Fn(&Served, &ParametersView) + 'static) -> Self {
        Self { begun: Some(Box::new(begun)), ..self }
    }

    /// Before its handler runs, whichever order moves this ends, and none begins until it is reset.
    pub fn stops(self, actuator: &Actuator) -> Self {
        Self { actuator: Some(actuator.clone()), ..self.stops_all() }
    }

    /// As [`stops`](Self::stops), for all that the unit moves.
    pub fn stops_all(self) -> Self {
        Self { attributes: Attributes { stop: true, ..self.attributes }, ..self }
    }

    /// When its handler has returned results, orders of this actuator may begin again, unless it was stopped meanwhile.
    pub fn resets(self, actuator: &Actuator) -> Self {
        Self { actuator: Some(actuator.clone()), ..self.resets_all() }
    }

    /// As [`resets`](Self::resets), for all that the unit moves.
    pub fn resets_all(self) -> Self {
        Self { attributes: Attributes { reset: true, ..self.attributes }, ..self }
    }

    /// Running it twice is as good as running it once.
    pub fn idempotent(self) -> Self {
        Self { attributes: Attributes { idempotent: true, ..self.attributes }, ..self }
    }

    /// A panic is answered to the caller as [`ServiceError::Panicked`], as on Linux. Otherwise it ends the test.
    pub fn survives_panics(self) -> Self {
        Self { survives_panics: true, ..self }
    }

    /// Whether its lease is live at `now`; `None` without one.
    pub(super) fn lease_is_live(&self, now: Instant) -> Option<bool> {
        self.actuator.as_ref().map(|actuator| actuator.word().is_live(now))
    }

    /// Tells what hears of its orders.
    pub(super) fn order_begun(&self, call: &Served, arguments: &ParametersView) {
        if let Some(begun) = &self.begun {
            begun(call, arguments);
        }
    }

    pub(super) async fn run(self: Rc<Self>, call: Served, mut parameters: BoxedParameters) -> Outcome {
        let unit = call.unit.clone();
        let outcome = match &self.body {
            Body::Future(start) => start(call, parameters).await,
            Body::AtOnce(body) => {
                let mut run = || (*body.borrow_mut())(&call, &mut parameters);
                let result = if self.survives_panics { catch_unwind(AssertUnwindSafe(run)) } else { Ok(run()) };
                result.unwrap_or(Err(ServiceError::Panicked)).map(|()| parameters)
            }
        };
        if self.takes > Duration::ZERO {
            unit.sleep(self.takes).await;
        }
        outcome
    }
}

impl cara_core::services::lease::Service for Handler {
    fn lease(&self) -> Option<&Lease> {
        self.0.actuator.as_ref().map(Actuator::word)
    }

    fn stream(&self) -> Option<&dyn cara_core::services::stream::Source> {
        self.0.values.as_ref().map(|values| values as &dyn cara_core::services::stream::Source)
    }

    fn inhibit(&self, now: Instant, latch: Latch) {
        if let Some(actuator) = &self.0.actuator {
            actuator.stop(now, latch);
        }
    }
}

/// What the core keeps of a service.
pub(super) struct Handler(pub(super) Rc<Service>);

/// Empty parameters with room for at least `bytes` bytes of names and values.
pub fn boxed_parameters(bytes: usize) -> BoxedParameters {
    match bytes {
        0..=512 => Box::new(Parameters::<512>::sized()),
        513..=2_048 => Box::new(Parameters::<2_048>::sized()),
        2_049..=8_192 => Box::new(Parameters::<8_192>::sized()),
        8_193..=40_960 => Box::new(Parameters::<40_960>::sized()),
        _ => Box::new(Parameters::<163_840>::sized()),
    }
}
