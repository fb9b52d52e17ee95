//! Services that both ports can run, and the log of what they did.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cara_core::config::Priority;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::ServiceError;
use cara_core::services::lease::Ended;
use cara_core::time::{Duration, Instant};

/// What a service's body is told.
pub struct Asked {
    /// The caller.
    pub caller: Identity,
    /// When it runs, on the world's clock.
    pub at: Instant,
}

type Body = dyn Fn(&Asked, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;

/// A service with its attributes; copies of it share one log.
#[derive(Clone)]
pub struct Service {
    pub(crate) signature: String,
    pub(crate) body: Arc<Body>,
    pub(crate) takes: Duration,
    pub(crate) moves_every: Option<Duration>,
    pub(crate) calls_back: Option<String>,
    pub(crate) priority: Priority,
    pub(crate) lease: Option<Duration>,
    pub(crate) stops_all: bool,
    pub(crate) resets_all: bool,
    pub(crate) in_turns: bool,
    pub(crate) commits: bool,
    gate: Option<Arc<AtomicBool>>,
    pub(crate) reports: i64,
    pub(crate) failure: Option<Failure>,
    log: Arc<CallLog>,
}

impl Service {
    /// A service that leaves its arguments as they are. The signature is in the text form.
    pub fn new(signature: &str) -> Self {
        Self {
            signature: signature.to_owned(),
            body: Arc::new(|_, _| Ok(())),
            takes: Duration::ZERO,
            moves_every: None,
            calls_back: None,
            priority: Priority::Normal,
            lease: None,
            stops_all: false,
            resets_all: false,
            in_turns: false,
            commits: false,
            gate: None,
            reports: 0,
            failure: None,
            log: Arc::new(CallLog::default()),
        }
    }

    /// What it does.
    pub fn does(
        self,
        body: impl Fn(&Asked, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static,
    ) -> Self {
        Self { body: Arc::new(body), ..self }
    }

    /// How long it takes to answer.
    pub fn takes(self, span: Duration) -> Self {
        Self { takes: span, ..self }
    }

    /// Its handler moves once in each `span` for as long as its call is wanted, and answers then. The log notes the call's
    /// int `n` at each move.
    pub fn moves_every(self, span: Duration) -> Self {
        Self { moves_every: Some(span), ..self }
    }

    /// Before it does anything, it calls this function of its caller with the same parameters.
    pub fn calls_back(self, function: &str) -> Self {
        Self { calls_back: Some(function.to_owned()), ..self }
    }

    /// The class that requests for it have.
    pub fn priority(self, priority: Priority) -> Self {
        Self { priority, ..self }
    }

    /// What it starts may go on only this long after the last renewal; then its safe hook notes the stop.
    pub fn lease(self, length: Duration) -> Self {
        Self { lease: Some(length), ..self }
    }

    /// Its calls run one after the other, in the order in which they began: on Linux they take the application's state, on a
    /// board one task takes them. The handlers of other services run side by side where a unit has threads.
    pub fn in_turns(self) -> Self {
        Self { in_turns: true, ..self }
    }

    /// Before its handler runs, all that the unit moves stops, and nothing begins until it is reset.
    pub fn stops_all(self) -> Self {
        Self { stops_all: true, ..self }
    }

    /// When its handler has returned results, what was stopped may begin again.
    pub fn resets_all(self) -> Self {
        Self { resets_all: true, ..self }
    }

    /// Its handler waits until the gate is open.
    pub fn waits_at(self, gate: &Gate) -> Self {
        Self { gate: Some(Arc::clone(&gate.0)), ..self }
    }

    /// At its end it changes something, by the commit of its call's order. The log notes the call's int `n` if it did.
    pub fn commits(self) -> Self {
        Self { commits: true, ..self }
    }

    /// Before it answers it tells so many values of its progress `left`, from 1 on, one in each millisecond, for as long as its
    /// call is not given up. The log notes how many.
    pub fn reports(self, count: i64) -> Self {
        Self { reports: count, ..self }
    }

    /// It fails, and says why.
    pub fn fails(self, failure: Failure) -> Self {
        Self { failure: Some(failure), ..self }
    }

    /// Whether its handler waits for anything, so that one that must not wait cannot serve it.
    pub(crate) fn awaits(&self) -> bool {
        let waits = self.takes > Duration::ZERO || self.calls_back.is_some() || self.gate.is_some();
        waits || self.moves_every.is_some() || self.reports > 0 || self.commits
    }

    /// Moves once, if the call of these parameters is wanted; the pause until the next move.
    pub(crate) fn moves_on(&self, is_wanted: bool, parameters: &ParametersView) -> Option<Duration> {
        let pause = self.moves_every.filter(|_| is_wanted)?;
        self.log.note(parameters.variable("n").ok()?);
        Some(pause)
    }

    /// Whether its handler is to wait, and to ask again.
    pub(crate) fn is_held(&self) -> bool {
        self.gate.as_ref().is_some_and(|is_open| !is_open.load(Ordering::SeqCst))
    }

    /// Changes what its call wants to change, by `commit` of the call's order.
    pub(crate) fn commit(
        &self,
        parameters: &ParametersView,
        commit: impl FnOnce(&dyn Fn()) -> Result<(), Ended>,
    ) -> Result<(), ServiceError> {
        if !self.commits {
            return Ok(());
        }
        let n = parameters.variable("n").map_err(|_| ServiceError::BadResults)?;
        Ok(commit(&|| self.log.note(n))?)
    }

    /// What it did so far, in all copies.
    pub fn log(&self) -> Arc<CallLog> {
        Arc::clone(&self.log)
    }

    /// The function's name.
    pub fn name(&self) -> &str {
        self.signature.split('(').next().unwrap_or_default()
    }
}

/// Where handlers wait until the scenario lets them go on, or is over; closed at first.
#[derive(Default)]
pub struct Gate(Arc<AtomicBool>);

impl Gate {
    /// Lets all handlers through.
    pub fn open(&self) {
        self.0.store(true, Ordering::SeqCst);
    }

    /// Lets no handler through from here on.
    pub fn close(&self) {
        self.0.store(false, Ordering::SeqCst);
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        self.open();
    }
}

/// What a service did, and when.
#[derive(Default)]
pub struct CallLog(Mutex<Entries>);

#[derive(Default)]
struct Entries {
    began: Vec<Instant>,
    ended: Vec<Instant>,
    stops: Vec<Instant>,
    values: Vec<i64>,
}

impl CallLog {
    fn entries(&self) -> MutexGuard<'_, Entries> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How often its handler began.
    pub fn runs(&self) -> usize {
        self.entries().began.len()
    }

    /// When its handler began.
    pub fn began(&self) -> Vec<Instant> {
        self.entries().began.clone()
    }

    /// When its handler ended.
    pub fn ended(&self) -> Vec<Instant> {
        self.entries().ended.clone()
    }

    /// When its safe hook ran.
    pub fn stops(&self) -> Vec<Instant> {
        self.entries().stops.clone()
    }

    /// The first int of the variable `n` of each run, as noted by a body that calls [`Self::note`].
    pub fn values(&self) -> Vec<i64> {
        self.entries().values.clone()
    }

    /// Notes a value.
    pub fn note(&self, value: i64) {
        self.entries().values.push(value);
    }

    pub(crate) fn begin(&self, at: Instant) {
        self.entries().began.push(at);
    }

    pub(crate) fn end(&self, at: Instant) {
        self.entries().ended.push(at);
    }

    pub(crate) fn stop(&self, at: Instant) {
        self.entries().stops.push(at);
    }
}

impl Service {
    /// A service with one int `n`, which its log notes at each run.
    pub fn numbered(name: &str) -> Self {
        let service = Self::new(&format!("{name}(n: int[1]) -> (n: int[1])"));
        let log = service.log();
        service.does(move |_, parameters| {
            log.note(parameters.variable::<i64>("n").map_err(|_| ServiceError::BadResults)?);
            Ok(())
        })
    }
}
