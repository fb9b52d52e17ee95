//! Scenarios on sockets of this machine, over loopback.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream, UdpSocket};
use std::ops::ControlFlow;
use std::rc::Rc;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::thread;

use cara_core::config::{Constraints, Mode, PLAIN_PORT};
use cara_core::counters::Counter;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::function::Definition;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::services::access::Rule;
use cara_core::services::call::{Caller, Detail};
use cara_core::services::lease::Ended;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_sim::Sample;
use cara_std::access::AccessTable;
use cara_std::{
    BuildError, Builder, CallError, Capacities, CommunicationSystem, Interfaces, LeaseWatch, MyFunctionList, Peer,
    Served, ServiceOptions, Unit as SUnit, UnitEvent,
};
use tempfile::TempDir;

use super::keys::Keys;
use super::relay::{Relay, Way};
use crate::run::Report;
use crate::{
    Asked, Fault, Heart, Need, Node, Pending, PendingAll, Port, Seen, Service, Spec, SpecRole, Unit, UnknownClient,
    Unsupported, Watched, World, boxed, number,
};

/// How often a waiting scenario looks.
const LOOK: std::time::Duration = std::time::Duration::from_millis(1);

/// How long an unknown client waits for an answer.
const ANSWER: std::time::Duration = std::time::Duration::from_secs(5);

pub(super) struct LinuxWorld {
    start: std::time::Instant,
    fleet: u32,
    units: Vec<Arc<LinuxNode>>,
    /// None for scenarios with unknown clients, which speak plain.
    keys: Option<Arc<Mutex<Keys>>>,
    /// AGVs dial through relays.
    relayed: bool,
    /// The relay of a unit, by its number.
    relays: BTreeMap<usize, Relay>,
    /// Connections on which nothing is said.
    silent: Vec<TcpStream>,
    report: Report,
}

enum Machine {
    Manager(CommunicationSystem),
    Agv(SUnit),
}

/// What threads share of a unit.
struct LinuxNode {
    start: std::time::Instant,
    fleet: u32,
    /// The manager's address, for one that is to dial a relay.
    dials: Option<SocketAddr>,
    spec: Spec,
    /// Of the scenario's fleets; plain mode without.
    keys: Option<Arc<Mutex<Keys>>>,
    machine: Mutex<Option<Arc<Machine>>>,
    receiver: Mutex<Option<Receiver<UnitEvent>>>,
    events: Mutex<Vec<(Instant, Seen)>>,
    losses: Arc<Mutex<Vec<Instant>>>,
    leases: Mutex<BTreeMap<String, LeaseWatch>>,
    /// Of the calls of each service.
    orders: Mutex<BTreeMap<String, Vec<LeaseWatch>>>,
    readings: Mutex<Readings>,
    /// Where a manager keeps its claim from one life to the next. Without it, the vehicles that obeyed the last one fence every
    /// second life for seconds.
    state: TempDir,
}

/// By peer and stream.
type Readings = BTreeMap<(String, String), Arc<Mutex<Reading>>>;

/// A stream of a peer that a thread reads.
#[derive(Default)]
struct Reading {
    samples: Vec<Sample>,
    refused: Option<Error>,
    over: bool,
}

struct Handle {
    number: usize,
    node: Arc<LinuxNode>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn since(start: std::time::Instant) -> Instant {
    Instant::from_micros(start.elapsed().as_micros() as u64)
}

impl LinuxWorld {
    pub(super) fn new(relayed: bool, mode: Mode) -> Self {
        Self {
            start: std::time::Instant::now(),
            fleet: RandomState::new().build_hasher().finish() as u32,
            units: Vec::new(),
            keys: (mode == Mode::Secured).then(Arc::default),
            relayed,
            relays: BTreeMap::new(),
            silent: Vec::new(),
            report: Report::default(),
        }
    }

    /// The relay through which a new unit dials its manager.
    fn relay(&mut self, spec: &Spec) -> Option<SocketAddr> {
        let SpecRole::Agv(manager, _) = &spec.role else { return None };
        let manager = self.units.iter().find(|unit| unit.spec.name == *manager).filter(|_| self.relayed)?;
        let relay = Relay::to(manager.tcp_port()?);
        let address = relay.address();
        self.relays.insert(self.units.len(), relay);
        Some(address)
    }

    /// What happens to the stream between two units, one of which dials through a relay.
    fn on_relay(&self, from: &Unit, to: &Unit, act: impl FnOnce(&Relay, Way), need: Need) -> Result<(), Unsupported> {
        let down = self.relays.get(&to.number()).map(|relay| (relay, Way::Down));
        let up = self.relays.get(&from.number()).map(|relay| (relay, Way::Up));
        let (relay, way) = down.or(up).ok_or(Unsupported(need))?;
        act(relay, way);
        Ok(())
    }

    fn unknown_client(&mut self, unit: &Unit, client: UnknownClient) {
        let node = Arc::clone(&self.units[unit.number()]);
        let manager = (Ipv4Addr::LOCALHOST, node.tcp_port().expect("a manager runs"));
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
        socket.set_broadcast(true).expect("it may broadcast");
        for datagram in client.datagrams(node.fleet) {
            socket.send_to(&datagram, (Ipv4Addr::new(127, 255, 255, 255), PLAIN_PORT)).expect("loopback is up");
        }
        let mut heard = Vec::new();
        for visit in client.visits(&unit.identity(), node.fleet) {
            let mut stream = TcpStream::connect(manager).expect("the manager listens");
            stream.set_read_timeout(Some(ANSWER)).expect("a span above zero");
            // The unit may close the connection while garbage is still being written.
            let _ = stream.write_all(&visit.says);
            if visit.closes {
                let _ = stream.read(&mut [0; 512]);
            } else {
                let _ = stream.read_to_end(&mut heard);
            }
        }
        if client.is_reported().is_some_and(|reported| heard.ends_with(&reported)) {
            self.reached("client was told");
        }
        if let UnknownClient::Silent(count) = client {
            for _ in 0..count {
                self.silent.push(TcpStream::connect(manager).expect("the manager listens"));
            }
        }
    }
}

impl Drop for LinuxWorld {
    fn drop(&mut self) {
        for unit in &self.units {
            unit.stop();
        }
    }
}

impl World for LinuxWorld {
    fn port(&self) -> Port {
        Port::Linux
    }

    fn now(&self) -> Instant {
        since(self.start)
    }

    fn add(&mut self, spec: Spec) -> Unit {
        let node = Arc::new(LinuxNode {
            start: self.start,
            dials: self.relay(&spec),
            fleet: self.fleet.wrapping_add(spec.fleet),
            spec,
            keys: self.keys.clone(),
            machine: Mutex::new(None),
            receiver: Mutex::new(None),
            events: Mutex::default(),
            losses: Arc::default(),
            leases: Mutex::default(),
            orders: Mutex::default(),
            readings: Mutex::default(),
            state: tempfile::tempdir().expect("a folder can be made"),
        });
        node.start();
        self.units.push(Arc::clone(&node));
        Rc::new(Handle { number: self.units.len() - 1, node })
    }

    fn run_until(&mut self, condition: &dyn Fn() -> bool, limit: Duration) -> bool {
        let end = self.now() + limit;
        loop {
            self.units.iter().for_each(|unit| unit.drain());
            if condition() {
                return true;
            }
            if self.now() >= end {
                return false;
            }
            thread::sleep(LOOK);
        }
    }

    fn inject(&mut self, fault: Fault<'_>) -> Result<(), Unsupported> {
        Err(Unsupported(match fault {
            Fault::FreezeStreams(from, to, span) => {
                return self.on_relay(from, to, |relay, way| relay.freeze(way, span.into()), Need::Freeze);
            }
            Fault::SlowReader(from, to, pace) => {
                return self.on_relay(from, to, |relay, way| relay.slow_down(way, pace), Need::SlowReader);
            }
            Fault::Reset(unit) => return self.on_relay(unit, unit, |relay, _| relay.reset(), Need::Reset),
            Fault::UnknownClient(unit, client) => {
                self.unknown_client(unit, client);
                return Ok(());
            }
            Fault::PowerCut(_) | Fault::Kill(_) | Fault::Restart(_) => Need::Crash,
            Fault::Cut(..) | Fault::CutOneWay(..) | Fault::Heal => Need::Partition,
            Fault::FreezeLink(..) => Need::FreezeLink,
            Fault::Path(..) => Need::Path,
            Fault::ChangeAddress(_) => Need::AddressChange,
            Fault::Suspend(..) => Need::Suspend,
            Fault::Unplug(_) | Fault::Plug(_) => Need::Interface,
        }))
    }

    fn random(&mut self, bound: u64) -> u64 {
        RandomState::new().build_hasher().finish().checked_rem(bound).unwrap_or(0)
    }

    fn reached(&mut self, state: &'static str) {
        *self.report.states.entry(state.to_owned()).or_default() += 1;
    }

    fn measured(&mut self, what: &'static str, span: Duration) {
        self.report.measured.entry(what).or_default().push(span);
    }

    fn units(&self) -> Vec<Unit> {
        let handle =
            |(number, node): (usize, &Arc<LinuxNode>)| Rc::new(Handle { number, node: Arc::clone(node) }) as Unit;
        self.units.iter().enumerate().map(handle).collect()
    }

    fn report(&self) -> Report {
        self.report.clone()
    }
}

impl LinuxNode {
    fn now(&self) -> Instant {
        since(self.start)
    }

    fn machine(&self) -> Result<Arc<Machine>, Error> {
        lock(&self.machine).clone().ok_or(Error::NotRunning)
    }

    fn start(self: &Arc<Self>) {
        let machine = Arc::new(self.build().expect("a unit can be made"));
        let receiver = match &*machine {
            Machine::Manager(system) => system.events(),
            Machine::Agv(unit) => unit.events(),
        };
        *lock(&self.receiver) = Some(receiver);
        *lock(&self.machine) = Some(Arc::clone(&machine));
        for service in &self.spec.services {
            self.add(service, false).expect("a unit has room for its services");
        }
        for stream in &self.spec.streams {
            let stream = Definition::stream(stream).expect("it is a stream");
            machine.functions().add_stream(&stream, Duration::ZERO).expect("a unit has room for its streams");
        }
        if self.spec.published {
            machine.publish().expect("what was added can be published");
        }
        match &*machine {
            Machine::Manager(system) => system.start(),
            Machine::Agv(unit) => unit.start(),
        }
        .expect("a unit can be started");
    }

    fn tcp_port(&self) -> Option<u16> {
        match &*self.machine().ok()? {
            Machine::Manager(system) => Some(system.tcp_port()),
            Machine::Agv(_) => None,
        }
    }

    fn build(&self) -> Result<Machine, BuildError> {
        let Spec { role, name, id, .. } = &self.spec;
        match role {
            SpecRole::Manager => {
                let builder = self.with_spec(CommunicationSystem::builder(name, *id)?);
                let builder = if self.spec.beside_another { builder.beside_another() } else { builder };
                let builder = builder.take_over(self.spec.takes_over).state_folder(self.state.path());
                let builder = match &self.spec.m_units {
                    Some(m_units) => builder.m_units(m_units.iter().copied())?,
                    None => builder,
                };
                Ok(Machine::Manager(builder.build()?))
            }
            SpecRole::Agv(manager, manager_id) => {
                let builder = self.with_spec(SUnit::builder(name, *id, manager, *manager_id)?);
                let builder = match self.dials {
                    Some(address) => builder.manager_address(address),
                    None => builder,
                };
                let unit = builder.build()?;
                let (losses, start) = (Arc::clone(&self.losses), self.start);
                unit.on_manager_lost(move |()| lock(&losses).push(since(start)))?;
                Ok(Machine::Agv(unit))
            }
        }
    }

    fn with_spec<R>(&self, builder: Builder<(), R>) -> Builder<(), R> {
        let Spec { constraints, their_functions, message_buffers, .. } = &self.spec;
        let capacities = Capacities {
            their_functions: *their_functions,
            message_buffers: *message_buffers,
            calls_running: if self.spec.one_call_at_a_time { 1 } else { Capacities::default().calls_running },
            ..Capacities::default()
        };
        let builder = builder.fleet(self.fleet).constraints(*constraints).capacities(capacities);
        let builder = builder.interfaces(Interfaces::Loopback);
        match &self.keys {
            Some(keys) => builder.keys(lock(keys).ring(self.fleet, &self.spec.identity())),
            None => builder.insecure(),
        }
    }

    fn stop(&self) {
        let machine = lock(&self.machine).take();
        match machine.as_deref() {
            Some(Machine::Manager(system)) => system.stop(),
            Some(Machine::Agv(unit)) => unit.stop(),
            None => {}
        }
        self.drain();
    }

    fn drain(&self) {
        let receiver = lock(&self.receiver);
        let Some(receiver) = receiver.as_ref() else { return };
        let now = self.now();
        lock(&self.events)
            .extend(receiver.try_iter().filter_map(|event| Some((now, Seen::of(event, |up| !up.is_empty())?))));
    }

    fn peer(&self, name: &str) -> Result<Peer, Error> {
        let peers = self.machine()?.peers();
        let named = peers.into_iter().filter(|peer| peer.name() == name);
        named.max_by_key(Peer::is_connected).ok_or(Error::NotConnected)
    }

    fn add(self: &Arc<Self>, service: &Service, replace: bool) -> Result<(), Error> {
        let definition = Definition::parse(&service.signature).map_err(|_| Error::BadName)?;
        let log = service.log();
        let start = self.start;
        let mut options = ServiceOptions::new().priority(service.priority);
        if service.stops_all {
            options = options.stops_all();
        }
        if service.resets_all {
            options = options.resets_all();
        }
        if let Some(length) = service.lease {
            options = options.lease(length, move || log.stop(since(start)));
        }
        let (kept, node) = (service.clone(), Arc::downgrade(self));
        let in_turns = service.in_turns;
        let free = move |call: &Served, parameters: &mut ParametersView| serve(&kept, &node, call, parameters);
        let machine = self.machine()?;
        let list = machine.functions();
        let watch = match (in_turns, replace) {
            (true, true) => list.replace(&definition, options, with_state(free)),
            (true, false) => list.add_service(&definition, options, with_state(free)),
            (false, true) => list.replace(&definition, options, free),
            (false, false) => list.add_service(&definition, options, free),
        }?;
        lock(&self.leases).insert(service.name().to_owned(), watch);
        Ok(())
    }
}

/// The form of a handler that takes the application's state.
fn with_state(
    free: impl Fn(&Served, &mut ParametersView) -> Result<(), ServiceError>,
) -> impl Fn(&mut (), &Served, &mut ParametersView) -> Result<(), ServiceError> {
    move |(), call, parameters| free(call, parameters)
}

fn serve(
    service: &Service,
    node: &Weak<LinuxNode>,
    call: &Served,
    parameters: &mut ParametersView,
) -> Result<(), ServiceError> {
    let node = node.upgrade().ok_or(ServiceError::NotReady)?;
    service.log().begin(node.now());
    lock(&node.orders).entry(service.name().to_owned()).or_default().extend(call.lease.clone());
    if let Some(function) = &service.calls_back {
        let peer = node.peer(call.caller.name()).map_err(|_| ServiceError::NotReady)?;
        peer.block_request(function, parameters).map_err(|_| ServiceError::NotReady)?;
    }
    (service.body)(&Asked { caller: call.caller.clone(), at: node.now() }, parameters)?;
    while let Some(pause) = service.moves_on(call.lease.as_ref().is_some_and(LeaseWatch::is_live), parameters) {
        thread::sleep(pause.into());
    }
    if service.reports > 0 {
        let mut reported = 0;
        while reported < service.reports && !call.is_cancelled() {
            reported += 1;
            call.progress(&number("left", reported)).map_err(|_| ServiceError::BadResults)?;
            thread::sleep(LOOK);
        }
        service.log().note(reported);
    }
    if service.takes > Duration::ZERO {
        thread::sleep(service.takes.into());
    }
    while service.is_held() {
        thread::sleep(LOOK);
    }
    service.commit(parameters, |change| call.lease.as_ref().map_or(Err(Ended), |order| order.commit(change)))?;
    if let Some(failure) = &service.failure {
        return Err(call.fail(failure.clone()));
    }
    service.log().end(node.now());
    Ok(())
}

impl Machine {
    fn functions(&self) -> MyFunctionList<'_, ()> {
        match self {
            Self::Manager(system) => system.my_function_list(),
            Self::Agv(unit) => unit.my_function_list(),
        }
    }

    fn publish(&self) -> Result<(), Error> {
        match self {
            Self::Manager(system) => system.publish_my_function_list(),
            Self::Agv(unit) => unit.publish_my_function_list(),
        }
    }

    fn peers(&self) -> Vec<Peer> {
        match self {
            Self::Manager(system) => system.s_units().into_iter().chain(system.m_units()).collect(),
            Self::Agv(unit) => unit.manager().into_iter().collect(),
        }
    }

    fn node_counters(&self) -> Vec<(&'static str, u64)> {
        match self {
            Self::Manager(system) => system.counters(),
            Self::Agv(unit) => unit.counters(),
        }
    }
}

fn value(counters: &[(&'static str, u64)], name: &str) -> u64 {
    counters.iter().filter(|(known, _)| *known == name).map(|(_, count)| count).sum()
}

impl Handle {
    fn connected(&self) -> Vec<Peer> {
        let peers = self.node.machine().map(|machine| machine.peers()).unwrap_or_default();
        peers.into_iter().filter(Peer::is_connected).collect()
    }

    /// The unit as an m_unit.
    fn system(&self) -> Result<CommunicationSystem, Error> {
        match &*self.node.machine()? {
            Machine::Manager(system) => Ok(system.clone()),
            Machine::Agv(_) => Err(Error::NotConnected),
        }
    }
}

impl Node for Handle {
    fn identity(&self) -> Identity {
        let Spec { role, name, id, .. } = &self.node.spec;
        let identity = match role {
            SpecRole::Manager => Identity::m_unit(name, *id),
            SpecRole::Agv(..) => Identity::s_unit(name, *id),
        };
        identity.expect("a unit was made of it")
    }

    fn broadcast(&self) {
        match self.node.machine().as_deref() {
            Ok(Machine::Manager(system)) => system.broadcast(),
            Ok(Machine::Agv(unit)) => unit.broadcast(),
            Err(_) => {}
        }
    }

    fn stop(&self) {
        self.node.stop();
    }

    fn start(&self) {
        self.node.start();
    }

    fn add_service(&self, service: &Service) -> Result<(), Error> {
        self.node.add(service, false)
    }

    fn replace_service(&self, service: &Service) -> Result<(), Error> {
        self.node.add(service, true)
    }

    fn remove_service(&self, name: &str) -> Result<(), Error> {
        self.node.machine()?.functions().remove(name)
    }

    fn publish(&self) -> Result<(), Error> {
        self.node.machine()?.publish()
    }

    fn publish_to(&self, peer: &str) -> Result<(), Error> {
        self.node.peer(peer)?.publish_my_function_list()
    }

    fn begin_publish(&self) -> Pending<Vec<Identity>> {
        let pending = Pending::new();
        let (node, reported) = (Arc::clone(&self.node), pending.share());
        thread::spawn(move || {
            let missing = match node.machine().as_deref() {
                Ok(Machine::Manager(system)) => system.publish_and_wait(Duration::from_secs(10)),
                Ok(Machine::Agv(unit)) => unit.publish_my_function_list().map(|()| Vec::new()),
                Err(error) => Err(*error),
            };
            reported.end(missing, node.now());
        });
        pending
    }

    fn my_function_list(&self) -> String {
        self.node.machine().map(|machine| machine.functions().show_functions()).unwrap_or_default()
    }

    fn s_units(&self) -> Vec<(Identity, bool)> {
        let peers = self.system().map(|system| system.s_units()).unwrap_or_default();
        peers.iter().map(|peer| (peer.identity().clone(), peer.is_connected())).collect()
    }

    fn number_of_s_units(&self) -> usize {
        self.system().map(|system| system.number_of_s_units()).unwrap_or_default()
    }

    fn peers(&self) -> Vec<Identity> {
        self.connected().iter().map(|peer| peer.identity().clone()).collect()
    }

    fn nodes_offering(&self, function: &str) -> Vec<Identity> {
        let connected = self.connected().into_iter();
        let offering = connected.filter(|peer| peer.their_function_list().contains(function));
        offering.map(|peer| peer.identity().clone()).collect()
    }

    fn their_function_list(&self, peer: &str) -> String {
        let list = self.node.peer(peer).map(|peer| peer.their_function_list()).unwrap_or_default();
        list.show_functions().to_string()
    }

    fn request_with(
        &self,
        peer: &str,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<CallId, Error> {
        Ok(self.node.peer(peer)?.send(function.into(), parameters, &options)?)
    }

    fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Identity, Result<CallId, Error>)> {
        let system = self.system().inspect(retire_unknown_clients);
        let requested = system.map(|system| system.call_all(function, parameters).send()).unwrap_or_default();
        let short =
            |(peer, result): (Peer, Result<_, CallError>)| (peer.identity().clone(), result.map_err(Error::from));
        requested.into_iter().map(short).collect()
    }

    fn begin(&self, peer: &str, function: &str, parameters: &ParametersView, options: RequestOptions) -> Pending {
        let pending = Pending::new();
        let (node, reported, mut parameters) = (Arc::clone(&self.node), pending.share(), boxed(parameters));
        let (peer, function) = (peer.to_owned(), function.to_owned());
        thread::spawn(move || {
            let asked = node.peer(&peer);
            let result = asked.and_then(|peer| Ok(peer.call(&function, &mut parameters).with(options).wait()?));
            reported.end(result.map(|()| parameters), node.now());
        });
        pending
    }

    fn begin_all(&self, function: &str, parameters: &ParametersView) -> PendingAll {
        let pending = Pending::new();
        let (node, reported, function) = (Arc::clone(&self.node), pending.share(), function.to_owned());
        let mut copy = Parameters::<512>::sized();
        copy.copy_from(parameters).expect("what is asked of all is short");
        let system = self.system();
        thread::spawn(move || {
            let system = system.inspect(retire_unknown_clients);
            let outcomes = system.map(|system| system.call_all(&function, &copy).wait());
            let short = |(peer, outcome): (Peer, Result<_, CallError>)| {
                (peer.identity().clone(), outcome.map(drop).map_err(Error::from))
            };
            reported.end(outcomes.map(|outcomes| outcomes.into_iter().map(short).collect()), node.now());
        });
        pending
    }

    fn watch(
        &self,
        peer: &str,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
        enough: i64,
    ) -> Pending<Watched> {
        let pending = Pending::new();
        let (node, ended, mut parameters) = (Arc::clone(&self.node), pending.share(), boxed(parameters));
        let (peer, function) = (peer.to_owned(), function.to_owned());
        thread::spawn(move || {
            let mut reported = Vec::new();
            let mut listen = |progress: &ParametersView| {
                let left = progress.variable("left").expect("it is declared so");
                reported.push(left);
                if left < enough { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
            };
            let call = |peer: Peer| peer.call(&function, &mut parameters).with(options).watch(&mut listen).wait();
            let outcome = node.peer(&peer).map_err(CallError::from).and_then(call);
            let kept = |failed: CallError| {
                let failure = failed.failure().cloned();
                cara_sim::CallError::new(failed.error, failure.map(Detail::Service))
            };
            ended.end(Ok(Watched { reported, outcome: outcome.map_err(kept) }), node.now());
        });
        pending
    }

    fn put(&self, stream: &str, values: &ParametersView) -> Result<(), Error> {
        let own = match &*self.node.machine()? {
            Machine::Manager(system) => system.stream(stream),
            Machine::Agv(unit) => unit.stream(stream),
        };
        own.ok_or(Error::UnknownFunction)?.publish(values)
    }

    fn subscribe(&self, peer: &str, stream: &str, interval: Duration) -> Result<(), Error> {
        let mut subscription = self.node.peer(peer)?.stream(stream)?.subscribe(interval);
        let (node, reading) = (Arc::clone(&self.node), Arc::<Mutex<Reading>>::default());
        lock(&self.node.readings).insert((peer.to_owned(), stream.to_owned()), Arc::clone(&reading));
        thread::spawn(move || {
            while !lock(&reading).over {
                let next = subscription.next(Duration::from_millis(20));
                let mut reading = lock(&reading);
                match next {
                    Ok(sample) => {
                        let (at, age, values) = (node.now(), sample.age(), sample.values().into());
                        reading.samples.push(Sample { at, age, values });
                    }
                    Err(Error::TimedOut) => reading.refused = None,
                    Err(Error::NotRunning) => return,
                    Err(error) => {
                        reading.refused = Some(error);
                        drop(reading);
                        thread::sleep(LOOK);
                    }
                }
            }
        });
        Ok(())
    }

    fn unsubscribe(&self, peer: &str, stream: &str) -> Result<(), Error> {
        if let Some(reading) = lock(&self.node.readings).get(&(peer.to_owned(), stream.to_owned())) {
            lock(reading).over = true;
        }
        Ok(())
    }

    fn samples(&self, peer: &str, stream: &str) -> Vec<Sample> {
        let readings = lock(&self.node.readings);
        let reading = readings.get(&(peer.to_owned(), stream.to_owned()));
        reading.map(|reading| lock(reading).samples.clone()).unwrap_or_default()
    }

    fn subscription_refused(&self, peer: &str, stream: &str) -> Option<Error> {
        let readings = lock(&self.node.readings);
        readings.get(&(peer.to_owned(), stream.to_owned())).and_then(|reading| lock(reading).refused)
    }

    fn release(&self, peer: &str, function: &str) -> Result<(), Error> {
        self.node.peer(peer)?.release(function)
    }

    fn heart(&self, period: Duration) -> Heart {
        let mut heart = self.system().expect("it is an m_unit that runs").heart(period);
        Heart::new(heart.renew(), move || heart.beat())
    }

    fn end_order(&self, function: &str, call: usize) -> bool {
        let order = lock(&self.node.orders)[function][call].clone();
        match &*self.node.machine().expect("the unit runs") {
            Machine::Manager(system) => system.end_order(&order),
            Machine::Agv(unit) => unit.end_order(&order),
        }
    }

    fn lease_is_live(&self, function: &str) -> bool {
        lock(&self.node.leases).get(function).is_some_and(LeaseWatch::is_live)
    }

    fn constraints(&self) -> Constraints {
        match &*self.node.machine().expect("the unit runs") {
            Machine::Manager(system) => system.constraints(),
            Machine::Agv(unit) => unit.constraints(),
        }
    }

    fn set_access(&self, table: Option<&'static [Rule]>) -> Result<(), Error> {
        let table = table.map(AccessTable::from);
        match &*self.node.machine()? {
            Machine::Manager(system) => system.set_access(table),
            Machine::Agv(unit) => unit.set_access(table),
        }
        Ok(())
    }

    fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        match &*self.node.machine()? {
            Machine::Manager(system) => system.set_constraints(constraints),
            Machine::Agv(unit) => unit.set_constraints(constraints),
        }
    }

    fn counted(&self, counter: LinkCounter) -> u64 {
        self.connected().iter().map(|peer| value(&peer.counters(), counter.name())).sum()
    }

    fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.node.machine().map_or(0, |machine| value(&machine.node_counters(), counter.name()))
    }

    fn events(&self) -> Vec<(Instant, Seen)> {
        self.node.drain();
        lock(&self.node.events).clone()
    }

    fn manager_losses(&self) -> Vec<Instant> {
        lock(&self.node.losses).clone()
    }

    fn number(&self) -> usize {
        self.number
    }
}

/// All units of all scenarios have keys: those that this one has not started are not missed.
fn retire_unknown_clients(system: &CommunicationSystem) {
    let never_joined = |peer: &&Peer| !peer.is_connected() && peer.left().is_none();
    system.roster().iter().filter(never_joined).for_each(|client| assert!(client.retire()));
}
