//! What a scenario can do, whatever the port.

use cara_core::services::heart::Renew;
use std::fmt::Debug;
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};

use cara_core::config::Constraints;
use cara_core::counters::Counter;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error};
use cara_core::host::connections::LinkCounter;
use cara_core::services::access::Rule;
use cara_core::services::event::UnitEvent;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_sim::{BoxedParameters, CallError, Path, Sample};

use crate::{Need, Service, Spec, UnknownClient, boxed, secs};

/// Events of each unit that a failure shows.
const LAST_EVENTS: usize = 12;

/// A unit of a world.
pub type Unit = Rc<dyn Node>;

/// Where a scenario runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Port {
    /// Virtual network and time.
    Simulator,
    /// The same with secured units.
    Secured,
    /// Sockets of this machine, over loopback.
    Linux,
    /// Boards with embassy-net, on a switch in memory and in virtual time.
    Embassy,
    /// Two boards on a serial line without IP, in virtual time.
    Line,
}

/// A fault that a port cannot inject.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unsupported(pub Need);

/// What is done to a fleet.
pub enum Fault<'u> {
    /// The unit loses power: nothing is said.
    PowerCut(&'u Unit),
    /// Its process is killed: its machine closes the streams.
    Kill(&'u Unit),
    /// It begins another life.
    Restart(&'u Unit),
    /// Nothing passes between the two until [`Fault::Heal`].
    Cut(&'u Unit, &'u Unit),
    /// Nothing passes from the first to the second until [`Fault::Heal`].
    CutOneWay(&'u Unit, &'u Unit),
    /// All cuts end.
    Heal,
    /// What the streams from the first to the second carry is held for this long; datagrams pass.
    FreezeStreams(&'u Unit, &'u Unit, Duration),
    /// All that goes from the first to the second is held for this long.
    FreezeLink(&'u Unit, &'u Unit, Duration),
    /// All streams of the unit are reset.
    Reset(&'u Unit),
    /// The paths between the two have this quality.
    Path(&'u Unit, &'u Unit, Path),
    /// The unit gets another address.
    ChangeAddress(&'u Unit),
    /// The unit's machine sleeps for this long; what arrives waits.
    Suspend(&'u Unit, Duration),
    /// What the first sends in streams is read at so many bytes a second by the second.
    SlowReader(&'u Unit, &'u Unit, usize),
    /// A client that is no unit, or a misbehaving one, connects to the manager.
    UnknownClient(&'u Unit, UnknownClient),
    /// The unit's only interface goes down.
    Unplug(&'u Unit),
    /// It comes back up.
    Plug(&'u Unit),
}

/// Something that a unit saw happen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Seen {
    /// A peer is connected.
    Joined(Identity),
    /// A peer is no longer.
    Left(Identity, CloseReason),
    /// A link ended before its peer had joined.
    NotJoined(CloseReason),
    /// The unit's interface has come, or gone.
    InterfaceChanged(bool),
    /// A peer's list was read again.
    ListChanged(Identity),
    /// An asynchronous request was not run, or failed.
    Failed(CallId, Error),
    /// A service of the unit stopped because its lease was not renewed.
    LeaseExpired(String),
    /// A lease that the unit held ended at the peer.
    LeaseEnded(String, LeaseEnd),
    /// A manager with a claim of this term commands, and this one has stepped down.
    Fenced(u64),
}

impl Seen {
    /// What a scenario sees of what a port tells. `is_up`: whether the network that it names can be used.
    pub(crate) fn of<F: ToString + Debug, N: Debug, E: Debug>(
        event: UnitEvent<F, N, E>,
        is_up: impl FnOnce(&N) -> bool,
    ) -> Option<Self> {
        Some(match event {
            UnitEvent::Joined { peer } => Self::Joined(peer),
            UnitEvent::Left { peer, reason } => Self::Left(peer, reason),
            UnitEvent::NotJoined { reason, .. } => Self::NotJoined(reason),
            UnitEvent::NetworkChanged { up } => Self::InterfaceChanged(is_up(&up)),
            UnitEvent::ListChanged { peer } => Self::ListChanged(peer),
            UnitEvent::RequestFailed { call, error, .. } => Self::Failed(call, error),
            UnitEvent::LeaseExpired { function, .. } => Self::LeaseExpired(function.to_string()),
            UnitEvent::LeaseEnded { function, why, .. } => Self::LeaseEnded(function.to_string(), why),
            UnitEvent::Fenced { claim } => Self::Fenced(claim.term),
            // Not every port tells of a latch before it is asked for.
            UnitEvent::FunctionsSkipped { .. } | UnitEvent::Inhibited { .. } => return None,
            // A scenario that did not see it would pass for the wrong reason.
            other => panic!("no scenario knows {other:?}"),
        })
    }
}

/// How a call ended, and when.
#[derive(Clone)]
pub struct Pending<T = BoxedParameters>(Arc<Mutex<Option<Ended<T>>>>);

/// A result, and when it came.
type Ended<T> = (Result<T, Error>, Instant);

/// How a call to many nodes ended.
pub type PendingAll = Pending<Vec<(Identity, Result<(), Error>)>>;

impl<T> Pending<T> {
    pub(crate) fn new() -> Self {
        Self(Arc::new(Mutex::new(None)))
    }

    pub(crate) fn share(&self) -> Self {
        Self(Arc::clone(&self.0))
    }

    pub(crate) fn end(&self, result: Result<T, Error>, at: Instant) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some((result, at));
    }

    /// Whether it has ended.
    pub fn is_over(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// When it ended.
    pub fn ended_at(&self) -> Option<Instant> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).as_ref().map(|(_, at)| *at)
    }

    /// The error that it ended with; `None` while it has not ended, `Some(Ok)` without one.
    pub fn outcome(&self) -> Option<Result<(), Error>> {
        let ended = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        ended.as_ref().map(|(result, _)| result.as_ref().map(drop).map_err(|error| *error))
    }

    fn take(&self) -> Option<Result<T, Error>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take().map(|(result, _)| result)
    }
}

/// What the caller of a call that was watched has learned.
#[derive(Debug)]
pub struct Watched {
    /// The values of its progress `left`, as they came.
    pub reported: Vec<i64>,
    /// How it ended.
    pub outcome: Result<(), CallError>,
}

/// A heart of a loop, as its port has it.
pub struct Heart {
    renew: Renew,
    beat: Box<dyn FnMut()>,
}

impl Heart {
    pub(crate) fn new(renew: Renew, beat: impl FnMut() + 'static) -> Self {
        Self { renew, beat: Box::new(beat) }
    }

    /// The loop has come round.
    pub fn beat(&mut self) {
        (self.beat)();
    }

    /// For the calls of the loop.
    pub fn renew(&self) -> Renew {
        self.renew
    }
}

/// One unit, in the words of both ports. Peers are named by their names.
pub trait Node {
    /// Its name, id and role.
    fn identity(&self) -> Identity;
    /// Looks for nodes now.
    fn broadcast(&self);
    /// Ends its life in an orderly way.
    fn stop(&self);
    /// Begins another life, with the services of its [`Spec`].
    fn start(&self);
    /// Adds a service, which is invisible to peers before it is published.
    fn add_service(&self, service: &Service) -> Result<(), Error>;
    /// Puts a service in the place of the one of the same name.
    fn replace_service(&self, service: &Service) -> Result<(), Error>;
    /// Removes a service.
    fn remove_service(&self, name: &str) -> Result<(), Error>;
    /// Publishes all services to all nodes.
    fn publish(&self) -> Result<(), Error>;
    /// Publishes all services to one node.
    fn publish_to(&self, peer: &str) -> Result<(), Error>;
    /// Publishes all services to all nodes, and ends when they have read the list, with those that have not.
    fn begin_publish(&self) -> Pending<Vec<Identity>>;
    /// Its own functions in the text form.
    fn my_function_list(&self) -> String;

    /// The s_units that ever joined in the order of joining, and whether each is connected.
    fn s_units(&self) -> Vec<(Identity, bool)>;
    /// How many s_units count.
    fn number_of_s_units(&self) -> usize;
    /// The connected nodes.
    fn peers(&self) -> Vec<Identity>;
    /// The connected nodes that offer a function to this unit.
    fn nodes_offering(&self, function: &str) -> Vec<Identity>;
    /// What a peer has published to this unit, one function in a line.
    fn their_function_list(&self, peer: &str) -> String;

    /// The asynchronous request.
    fn request_with(
        &self,
        peer: &str,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<CallId, Error>;
    /// The asynchronous request to all: each s_unit that has joined, connected or not, and each m_unit that offers it.
    fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Identity, Result<CallId, Error>)>;
    /// The synchronous request, made in a task of its own.
    fn begin(&self, peer: &str, function: &str, parameters: &ParametersView, options: RequestOptions) -> Pending;
    /// The synchronous request to all, likewise, in a task of its own.
    fn begin_all(&self, function: &str, parameters: &ParametersView) -> PendingAll;
    /// The synchronous request, made in a task of its own that watches it, and gives it up once its progress has reached
    /// `enough`.
    fn watch(
        &self,
        _peer: &str,
        _function: &str,
        _parameters: &ParametersView,
        _options: RequestOptions,
        _enough: i64,
    ) -> Pending<Watched> {
        let pending = Pending::new();
        pending.end(Err(Error::Unsupported), Instant::START);
        pending
    }
    /// Publishes a new value of a stream.
    fn put(&self, _stream: &str, _values: &ParametersView) -> Result<(), Error> {
        Err(Error::Unsupported)
    }
    /// Reads a stream of a peer from now on.
    fn subscribe(&self, _peer: &str, _stream: &str, _interval: Duration) -> Result<(), Error> {
        Err(Error::Unsupported)
    }
    /// Reads it no more.
    fn unsubscribe(&self, _peer: &str, _stream: &str) -> Result<(), Error> {
        Err(Error::Unsupported)
    }
    /// The values of a stream that have come.
    fn samples(&self, _peer: &str, _stream: &str) -> Vec<Sample> {
        Vec::new()
    }
    /// Why there is no subscription, if it was refused.
    fn subscription_refused(&self, _peer: &str, _stream: &str) -> Option<Error> {
        None
    }
    /// Gives up the lease on a function of a peer.
    fn release(&self, peer: &str, function: &str) -> Result<(), Error>;
    /// A heart for one loop of the unit.
    fn heart(&self, period: Duration) -> Heart;
    /// What a call of a leased service started is finished; calls of all services of this name are counted, from 0. Whether
    /// it was live.
    fn end_order(&self, function: &str, call: usize) -> bool;
    /// Whether a service's lease is live.
    fn lease_is_live(&self, function: &str) -> bool;

    /// Another access table for this life, or none.
    fn set_access(&self, table: Option<&'static [Rule]>) -> Result<(), Error>;

    /// The constraints in force.
    fn constraints(&self) -> Constraints;
    /// Changes them.
    fn set_constraints(&self, constraints: Constraints) -> Result<(), Error>;
    /// A counter of its links.
    fn counted(&self, counter: LinkCounter) -> u64;
    /// A counter of discovery and membership.
    fn node_counted(&self, counter: NodeCounter) -> u64;
    /// What happened to it, in all its lives.
    fn events(&self) -> Vec<(Instant, Seen)>;
    /// When the hook for a lost manager ran.
    fn manager_losses(&self) -> Vec<Instant>;
    /// For the port that made it.
    fn number(&self) -> usize;
}

impl dyn Node {
    /// The asynchronous request with defaults.
    pub fn request(&self, peer: &str, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.request_with(peer, function, parameters, RequestOptions::renewing(Renew::Process))
    }

    /// Whether a peer of this name is connected.
    pub fn is_connected(&self, peer: &str) -> bool {
        self.peers().iter().any(|identity| identity.name() == peer)
    }

    /// Whether a peer of this name offers a function to this unit.
    pub fn knows(&self, peer: &str, function: &str) -> bool {
        self.nodes_offering(function).iter().any(|identity| identity.name() == peer)
    }

    /// How many events match.
    pub fn count(&self, matches: impl Fn(&Seen) -> bool) -> usize {
        self.events().iter().filter(|(_, event)| matches(event)).count()
    }

    /// When the first event that matches happened.
    pub fn when(&self, matches: impl Fn(&Seen) -> bool) -> Option<Instant> {
        self.events().iter().find(|(_, event)| matches(event)).map(|(at, _)| *at)
    }

    /// Changes some of its constraints.
    pub fn change(&self, change: impl FnOnce(&mut Constraints)) {
        let mut constraints = self.constraints();
        change(&mut constraints);
        self.set_constraints(constraints).expect("the constraints are sound");
    }
}

/// A fleet on some port, and its time.
pub trait World {
    /// Which port.
    fn port(&self) -> Port;
    /// The time since the world began.
    fn now(&self) -> Instant;
    /// Adds a unit and starts it.
    fn add(&mut self, spec: Spec) -> Unit;
    /// Lets time pass until `condition` holds, at most `limit`; whether it held.
    fn run_until(&mut self, condition: &dyn Fn() -> bool, limit: Duration) -> bool;
    /// Injects a fault.
    fn inject(&mut self, fault: Fault<'_>) -> Result<(), Unsupported>;
    /// A random number below `bound`, from the seed where there is one.
    fn random(&mut self, bound: u64) -> u64;
    /// Notes that the scenario reached a state, for the report.
    fn reached(&mut self, state: &'static str);
    /// Notes a measured span under a name, for the report.
    fn measured(&mut self, what: &'static str, span: Duration);
    /// What was injected, reached and measured.
    fn report(&self) -> crate::run::Report;
    /// All units.
    fn units(&self) -> Vec<Unit>;
}

impl dyn World + '_ {
    /// Lets a span of time pass.
    pub fn run_for(&mut self, span: Duration) {
        let _ = self.run_until(&|| false, span);
    }

    /// Lets time pass until `condition` holds.
    ///
    /// # Panics
    /// When it does not within `limit`.
    pub fn wait(&mut self, what: &str, condition: impl Fn() -> bool, limit: Duration) {
        let came = self.run_until(&condition, limit);
        assert!(came, "not within {} ms: {what}{}", limit.as_millis(), self.story());
    }

    /// What the units saw happen, for a failure's text: the last events of each, and what was counted.
    pub(crate) fn story(&self) -> String {
        let mut story = format!("; now {:?}", self.now());
        for unit in self.units() {
            let events = unit.events();
            let last = events.len().saturating_sub(LAST_EVENTS);
            story += &format!("\n  {:?} after {last} more: {:?}", unit.identity(), &events[last..]);
            let counted = LinkCounter::ALL.iter().map(|counter| (counter.name(), unit.counted(*counter)));
            let counted: Vec<_> = counted.filter(|(_, count)| *count > 0).collect();
            story += &format!("\n    {counted:?}");
        }
        story
    }

    /// Injects a fault of which the scenario's needs say that the port can.
    ///
    /// # Panics
    /// When it cannot.
    pub fn fault(&mut self, fault: Fault<'_>) {
        if let Err(unsupported) = self.inject(fault) {
            panic!("the scenario does not say that it needs {unsupported:?}");
        }
    }

    /// The synchronous request, with ten seconds to pass through whatever the network does.
    pub fn ask(
        &mut self,
        unit: &Unit,
        peer: &str,
        function: &str,
        parameters: &mut ParametersView,
    ) -> Result<(), Error> {
        let options = RequestOptions { timeout: Some(secs(10)), ..RequestOptions::renewing(Renew::Process) };
        self.ask_with(unit, peer, function, parameters, options)
    }

    /// The synchronous request with options.
    ///
    /// # Panics
    /// When it ends neither with a reply nor with an error.
    pub fn ask_with(
        &mut self,
        unit: &Unit,
        peer: &str,
        function: &str,
        parameters: &mut ParametersView,
        options: RequestOptions,
    ) -> Result<(), Error> {
        let pending = unit.begin(peer, function, &boxed(parameters), options);
        self.wait("every call ends", || pending.is_over(), secs(60));
        let results = pending.take().expect("it is over")?;
        parameters.copy_from(&results)
    }

    /// Lets time pass until a call has ended; how it ended.
    ///
    /// # Panics
    /// When it does not end.
    pub fn finish<T>(&mut self, pending: &Pending<T>) -> Result<T, Error> {
        self.wait("every call ends", || pending.is_over(), secs(60));
        pending.take().expect("it is over")
    }
}
