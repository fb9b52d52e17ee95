//! Scenarios on the virtual network.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::rc::Rc;

use cara_core::config::{Constraints, Mode};
use cara_core::counters::Counter;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::random::Random;
use cara_core::services::access::Rule;
use cara_core::services::lease::Ended;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_sim::{Action, Chance, Crash, Direction, HostId, LeaseWatch, Path, Sample, StreamId, UnitEvent, UnitHandle};

use super::lent;
use crate::run::Report;
use crate::{
    Asked, Fault, FaultProfile, Heart, Node, Pending, PendingAll, Port, Seen, Service, Spec, SpecRole, Unit,
    UnknownClient, Unsupported, Watched, World, boxed, millis, number, secs,
};

/// How long the fault profile of a run lasts: longer than any run.
const ALWAYS: Duration = Duration::from_secs(24 * 3_600);
/// How a service calls its caller back.
const PATIENT: RequestOptions = RequestOptions { timeout: Some(Duration::from_secs(8)), ..RequestOptions::new() };
/// Where simulated m_units listen.
const M_UNIT_PORT: u16 = 7_000;
/// How long the beginning of a run is worse than the rest, under the rough profile.
const BEGINNING: Duration = Duration::from_millis(300);
/// Short partitions per unit that joins a world under the rough profile.
const PARTITIONS: u64 = 2;

pub(super) struct SimWorld {
    world: cara_sim::World,
    mode: Mode,
    units: Vec<Rc<SimNode>>,
    profile: FaultProfile,
    /// How often secured links are rekeyed, instead of every 12 h: in every other run.
    renews_every: Option<Duration>,
    random: Random,
    report: Report,
}

struct SimNode {
    number: usize,
    handle: UnitHandle,
    losses: Rc<RefCell<Vec<Instant>>>,
    orders: Orders,
}

/// Of the calls of each service.
type Orders = Rc<RefCell<BTreeMap<String, Vec<LeaseWatch>>>>;

impl SimWorld {
    pub(super) fn new(seed: u64, profile: FaultProfile, mode: Mode) -> Self {
        let world = cara_sim::World::of_mode(seed, mode);
        let mut random = Random::new(seed ^ 0x005C_E7A2_105E_ED00);
        if profile != FaultProfile::Own {
            let path = path(&mut random, profile);
            world.network(|network| {
                network.set_fault_profile(path, ALWAYS);
                if profile == FaultProfile::Rough {
                    // Discovery has to get through worse, and is over soon.
                    let worse = path.loss_percent(random.below(20) as f64);
                    network.set_fault_profile(worse, BEGINNING);
                    let now = network.now();
                    network.schedule(now + BEGINNING, Action::FaultProfile { path, span: ALWAYS });
                }
                network.split_reads(Chance::percent(random.below(40) as f64));
            });
        }
        let renews = mode == Mode::Secured && !seed.is_multiple_of(2);
        let renews_every = renews.then(|| secs(1) + random.jitter(secs(2)));
        Self { world, mode, units: Vec::new(), profile, renews_every, random, report: Report::default() }
    }

    fn host(&self, unit: &Unit) -> HostId {
        self.node(unit).handle.host()
    }

    fn node(&self, unit: &Unit) -> &SimNode {
        &self.units[unit.number()]
    }

    /// Cuts a new unit off from all others, a few times and never long enough to be lost.
    fn schedule_partitions(&mut self, host: HostId) {
        let now = self.world.now();
        for _ in 0..PARTITIONS {
            let at = now + self.random.jitter(secs(4));
            let span = millis(20) + self.random.jitter(millis(180));
            self.world.network(|network| {
                let second = network.hosts().filter(|other| *other != host).collect();
                let cut = Action::Partition { first: vec![host], second, direction: Direction::Both, span };
                network.schedule(at, cut);
            });
        }
    }

    fn counters(&self) -> BTreeMap<&'static str, u64> {
        let mut sums = BTreeMap::new();
        for unit in &self.units {
            for counter in LinkCounter::ALL {
                *sums.entry(counter.name()).or_default() += unit.handle.counted(*counter);
            }
            for counter in NodeCounter::ALL {
                *sums.entry(counter.name()).or_default() += unit.handle.node_counted(*counter);
            }
        }
        sums
    }
}

fn path(random: &mut Random, profile: FaultProfile) -> Path {
    let mut percent = |limit: u64| random.below(limit * 100) as f64 / 100.0;
    let loss = if profile == FaultProfile::Rough { percent(2) } else { 0.0 };
    let path = Path::LAN.loss_percent(loss).duplicate_percent(percent(12)).reorder_percent(percent(12));
    path.delay(Duration::from_micros(250) + random.jitter(millis(5))).jitter(random.jitter(millis(5)))
}

impl World for SimWorld {
    fn port(&self) -> Port {
        match self.mode {
            Mode::Plain => Port::Simulator,
            Mode::Secured => Port::Secured,
        }
    }

    fn now(&self) -> Instant {
        self.world.now()
    }

    fn add(&mut self, spec: Spec) -> Unit {
        let Spec { role, name, id, fleet, constraints, services, streams, .. } = spec;
        let Spec { published, their_functions, message_buffers, .. } = spec;
        let new = match role {
            SpecRole::Manager => self.world.m_unit(&name, id),
            SpecRole::Agv(manager, manager_id) => self.world.s_unit(&name, id).joins(&manager, manager_id),
        };
        let new = if spec.takes_over { new.kept_term(1).takes_over() } else { new };
        let new = if spec.same_seed { new.boot_seed(4) } else { new };
        let new = spec.m_units.iter().fold(new, |new, m_units| new.m_units(m_units));
        let new = new.fleet(fleet).constraints(constraints).functions(their_functions).message_buffers(message_buffers);
        let new = if spec.one_call_at_a_time { new.calls_running(1) } else { new };
        let new = match self.renews_every {
            Some(span) => new.renews_every(span),
            None => new,
        };
        let orders = Orders::default();
        let started = Rc::clone(&orders);
        let program = move |unit: &UnitHandle| {
            // Of this life alone.
            started.borrow_mut().clear();
            for service in &services {
                unit.my_function_list()
                    .add_service(&service.signature, simulated(service, &started))
                    .expect("a unit has room for its services");
            }
            for stream in &streams {
                unit.add_stream(stream, Duration::ZERO).expect("a unit has room for its streams");
            }
            if published {
                unit.publish_my_function_list().expect("what was added can be published");
            }
        };
        let handle = new.program(program).start();
        let losses = Rc::new(RefCell::new(Vec::new()));
        let recorded = Rc::clone(&losses);
        handle.on_event(move |unit, event| {
            if matches!(event, UnitEvent::Left { .. }) {
                recorded.borrow_mut().push(unit.now());
            }
        });
        if self.profile == FaultProfile::Rough {
            self.schedule_partitions(handle.host());
        }
        let node = Rc::new(SimNode { number: self.units.len(), handle, losses, orders });
        self.units.push(Rc::clone(&node));
        node
    }

    fn run_until(&mut self, condition: &dyn Fn() -> bool, limit: Duration) -> bool {
        self.world.run_until(|_| condition(), limit)
    }

    fn inject(&mut self, fault: Fault<'_>) -> Result<(), Unsupported> {
        match fault {
            Fault::PowerCut(unit) => {
                let handle = self.node(unit).handle.clone();
                self.world.crash(&handle, Crash::PowerCut);
            }
            Fault::Kill(unit) => {
                let handle = self.node(unit).handle.clone();
                self.world.crash(&handle, Crash::Process);
            }
            Fault::Restart(unit) => {
                let handle = self.node(unit).handle.clone();
                self.world.restart(&handle);
            }
            Fault::Suspend(unit, span) => {
                let host = self.host(unit);
                self.world.network(|network| network.suspend(host, span));
            }
            Fault::UnknownClient(unit, client) => self.unknown_client(unit, client),
            fault => self.inject_into_network(fault),
        }
        Ok(())
    }

    fn random(&mut self, bound: u64) -> u64 {
        self.random.below(bound)
    }

    fn reached(&mut self, state: &'static str) {
        *self.report.states.entry(state.to_owned()).or_default() += 1;
    }

    fn measured(&mut self, what: &'static str, span: Duration) {
        self.report.measured.entry(what).or_default().push(span);
    }

    fn units(&self) -> Vec<Unit> {
        self.units.iter().map(|unit| Rc::clone(unit) as Unit).collect()
    }

    fn report(&self) -> Report {
        let mut report = self.report.clone();
        for (name, count) in self.world.counts().iter().filter(|(_, count)| *count > 0) {
            *report.faults.entry(name).or_default() += count;
        }
        for (name, count) in self.counters().into_iter().filter(|(_, count)| *count > 0) {
            *report.states.entry(name.to_owned()).or_default() += count;
        }
        report.trace = self.world.trace_hash();
        report
    }
}

impl SimWorld {
    fn unknown_client(&mut self, unit: &Unit, client: UnknownClient) {
        let (manager, mut to) = (unit.identity(), self.node(unit).handle.address());
        let host = self.world.network(|network| network.add_host());
        for datagram in client.datagrams(0) {
            let datagram = UnknownClient::in_mode(self.mode, datagram);
            self.world.network(|network| network.send_to(host, to, &datagram));
        }
        to.set_port(M_UNIT_PORT);
        let mut heard = Vec::new();
        for visit in client.visits(&manager, 0) {
            let stream = self.world.network(|network| network.connect(host, to));
            self.say(stream, &UnknownClient::in_mode(self.mode, visit.says));
            if visit.closes {
                self.world.run_for(millis(200));
                self.world.network(|network| network.close(stream));
            } else {
                self.world.run_for(secs(5));
                self.hear(stream, &mut heard);
            }
        }
        if client.is_reported().is_some_and(|reported| heard.ends_with(&reported)) {
            self.reached("client was told");
        }
        if let UnknownClient::Silent(count) = client {
            for _ in 0..count {
                self.world.network(|network| network.connect(host, to));
            }
        }
    }

    /// Writes as the network takes it, which may have closed meanwhile.
    fn say(&mut self, stream: StreamId, says: &[u8]) {
        let mut written = 0;
        for _ in 0..1_000 {
            self.world.run_for(millis(10));
            written += self.world.network(|network| network.write(stream, &[&says[written..]])).unwrap_or(0);
            if written == says.len() {
                return;
            }
        }
    }

    fn hear(&mut self, stream: StreamId, heard: &mut Vec<u8>) {
        for _ in 0..64 {
            self.world.network(|network| {
                network.read(stream, |bytes| {
                    heard.extend_from_slice(bytes);
                    bytes.len()
                });
            });
        }
    }

    fn inject_into_network(&mut self, fault: Fault<'_>) {
        let host = |unit: &Unit| self.host(unit);
        match fault {
            Fault::Cut(one, other) => {
                let (one, other) = (host(one), host(other));
                self.world.network(|network| network.partition(&[one], &[other], Direction::Both));
            }
            Fault::CutOneWay(from, to) => {
                let (from, to) = (host(from), host(to));
                self.world.network(|network| network.partition(&[from], &[to], Direction::FirstToSecond));
            }
            Fault::Heal => self.world.network(|network| network.heal_all()),
            Fault::FreezeStreams(from, to, span) => {
                let action = Action::FreezeStreams { from: host(from), to: host(to), span };
                self.world.network(|network| network.inject(action));
            }
            Fault::FreezeLink(from, to, span) => {
                let (from, to) = (host(from), host(to));
                self.world.network(|network| network.freeze_link(from, to, span));
            }
            Fault::Reset(unit) => {
                let action = Action::ResetStreams { host: host(unit) };
                self.world.network(|network| network.inject(action));
            }
            Fault::Path(one, other, path) => {
                let (one, other) = (host(one), host(other));
                self.world.network(|network| network.set_paths_between(one, other, path));
            }
            Fault::SlowReader(from, to, pace) => {
                let (from, to) = (host(from), host(to));
                let path = Path::LAN.bits_per_second(8 * pace as u64);
                self.world.network(|network| network.set_path(from, to, path));
            }
            Fault::Unplug(unit) => {
                let host = host(unit);
                self.world.network(|network| network.plug(host, false));
            }
            Fault::Plug(unit) => {
                let host = host(unit);
                self.world.network(|network| network.plug(host, true));
            }
            Fault::ChangeAddress(unit) => {
                let host = host(unit);
                self.world.network(|network| network.change_address(host, Ipv4Addr::new(10, 77, 0, 7)));
            }
            _ => unreachable!("the rest is done by the world"),
        }
    }
}

/// A service of the scenario as the simulator runs it.
fn simulated(service: &Service, orders: &Orders) -> cara_sim::Service {
    let log = service.log();
    let (orders, name) = (Rc::clone(orders), service.name().to_owned());
    let begins = move |call: &cara_sim::Served| {
        orders.borrow_mut().entry(name.clone()).or_default().extend(call.lease.clone());
    };
    let kept = service.clone();
    let plain = !service.awaits();
    let made = if plain {
        cara_sim::Service::new(move |call, parameters| {
            kept.log().begin(call.unit.now());
            begins(call);
            let result = (kept.body)(&Asked { caller: call.caller.clone(), at: call.unit.now() }, parameters);
            if let Some(failure) = &kept.failure {
                return Err(call.fail(failure.clone()));
            }
            kept.log().end(call.unit.now());
            result
        })
        .survives_panics()
    } else {
        let kept = Rc::new(kept);
        cara_sim::Service::future(move |call, mut parameters| {
            let kept = Rc::clone(&kept);
            begins(&call);
            async move {
                kept.log().begin(call.unit.now());
                if let Some(function) = &kept.calls_back {
                    let called = call.unit.block_request_with(&call.caller, function, &mut parameters, PATIENT).await;
                    called.map_err(|_| ServiceError::NotReady)?;
                }
                (kept.body)(&Asked { caller: call.caller.clone(), at: call.unit.now() }, &mut parameters)?;
                while let Some(pause) = kept.moves_on(call.lease.as_ref().is_none_or(LeaseWatch::is_live), &parameters)
                {
                    call.unit.sleep(pause).await;
                }
                if kept.reports > 0 {
                    let mut reported = 0;
                    while reported < kept.reports && !call.is_cancelled() {
                        reported += 1;
                        call.progress(&number("left", reported)).map_err(|_| ServiceError::BadResults)?;
                        call.unit.sleep(millis(1)).await;
                    }
                    kept.log().note(reported);
                }
                call.unit.sleep(kept.takes).await;
                while kept.is_held() {
                    call.unit.sleep(millis(1)).await;
                }
                kept.commit(&parameters, |change| {
                    call.lease.as_ref().map_or(Err(Ended), |order| order.commit(change))
                })?;
                if let Some(failure) = &kept.failure {
                    return Err(call.fail(failure.clone()));
                }
                kept.log().end(call.unit.now());
                Ok(parameters)
            }
        })
    };
    let made = made.priority(service.priority);
    let made = if service.stops_all { made.stops_all() } else { made };
    let made = if service.resets_all { made.resets_all() } else { made };
    match service.lease {
        Some(length) => made.lease(length, move |unit| log.stop(unit.now())),
        None => made,
    }
}

impl Node for SimNode {
    fn identity(&self) -> Identity {
        self.handle.identity()
    }

    fn broadcast(&self) {
        let _ = self.handle.broadcast();
    }

    fn stop(&self) {
        self.handle.stop();
    }

    fn start(&self) {
        self.handle.start();
    }

    fn add_service(&self, service: &Service) -> Result<(), Error> {
        self.handle.my_function_list().add_service(&service.signature, simulated(service, &self.orders))
    }

    fn replace_service(&self, service: &Service) -> Result<(), Error> {
        self.handle.my_function_list().replace(&service.signature, simulated(service, &self.orders))
    }

    fn remove_service(&self, name: &str) -> Result<(), Error> {
        self.handle.my_function_list().remove(name)
    }

    fn publish(&self) -> Result<(), Error> {
        self.handle.publish_my_function_list()
    }

    fn publish_to(&self, peer: &str) -> Result<(), Error> {
        self.handle.publish_my_function_list_to(peer)
    }

    fn begin_publish(&self) -> Pending<Vec<Identity>> {
        let pending = Pending::new();
        let (unit, reported) = (self.handle.clone(), pending.share());
        self.handle.spawn(async move { reported.end(unit.publish_and_wait().await, unit.now()) });
        pending
    }

    fn my_function_list(&self) -> String {
        self.handle.my_function_list().show_functions()
    }

    fn s_units(&self) -> Vec<(Identity, bool)> {
        self.handle.s_units_ever()
    }

    fn number_of_s_units(&self) -> usize {
        self.handle.number_of_s_units()
    }

    fn peers(&self) -> Vec<Identity> {
        self.handle.peers()
    }

    fn nodes_offering(&self, function: &str) -> Vec<Identity> {
        self.handle.nodes_offering(function)
    }

    fn their_function_list(&self, peer: &str) -> String {
        self.handle.their_function_list(peer).unwrap_or_default()
    }

    fn request_with(
        &self,
        peer: &str,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<CallId, Error> {
        self.handle.request_with(peer, function, parameters, options)
    }

    fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Identity, Result<CallId, Error>)> {
        self.handle.request_all(function, parameters)
    }

    fn begin(&self, peer: &str, function: &str, parameters: &ParametersView, options: RequestOptions) -> Pending {
        let pending = Pending::new();
        let (unit, reported, mut parameters) = (self.handle.clone(), pending.share(), boxed(parameters));
        let (peer, function) = (peer.to_owned(), function.to_owned());
        self.handle.spawn(async move {
            let result = unit.block_request_with(peer.as_str(), &function, &mut parameters, options).await;
            reported.end(result.map(|()| parameters), unit.now());
        });
        pending
    }

    fn begin_all(&self, function: &str, parameters: &ParametersView) -> PendingAll {
        let pending = Pending::new();
        let (unit, reported, parameters) = (self.handle.clone(), pending.share(), boxed(parameters));
        let function = function.to_owned();
        self.handle.spawn(async move {
            let outcomes = unit.block_request_all(&function, &parameters).await;
            let outcomes = outcomes.into_iter().map(|(peer, outcome)| (peer, outcome.map(drop))).collect();
            reported.end(Ok(outcomes), unit.now());
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
        let (unit, ended) = (self.handle.clone(), pending.share());
        let call = match unit.watch(peer, function, parameters, options) {
            Ok(call) => call,
            Err(error) => {
                pending.end(Err(error), unit.now());
                return pending;
            }
        };
        self.handle.spawn(async move {
            let (mut call, mut reported) = (call, Vec::new());
            let mut is_enough = false;
            while !is_enough && let Some(progress) = call.progress().await {
                let left = progress.variable("left").expect("it is declared so");
                reported.push(left);
                is_enough = left >= enough;
            }
            let outcome = if is_enough {
                drop(call);
                Err(Error::Cancelled.into())
            } else {
                call.results().await.map(drop).map_err(|failed| *failed)
            };
            ended.end(Ok(Watched { reported, outcome }), unit.now());
        });
        pending
    }

    fn put(&self, stream: &str, values: &ParametersView) -> Result<(), Error> {
        self.handle.put(stream, values)
    }

    fn subscribe(&self, peer: &str, stream: &str, interval: Duration) -> Result<(), Error> {
        self.handle.subscribe(peer, stream, interval)
    }

    fn unsubscribe(&self, peer: &str, stream: &str) -> Result<(), Error> {
        self.handle.unsubscribe(peer, stream)
    }

    fn samples(&self, peer: &str, stream: &str) -> Vec<Sample> {
        self.handle.samples(peer, stream)
    }

    fn subscription_refused(&self, peer: &str, stream: &str) -> Option<Error> {
        self.handle.subscription_refused(peer, stream)
    }

    fn release(&self, peer: &str, function: &str) -> Result<(), Error> {
        self.handle.release(peer, function)
    }

    fn heart(&self, period: Duration) -> Heart {
        let mut heart = self.handle.heart(period);
        Heart::new(heart.renew(), move || heart.beat())
    }

    fn end_order(&self, function: &str, call: usize) -> bool {
        let order = self.orders.borrow()[function][call].clone();
        self.handle.end_order(&order)
    }

    fn lease_is_live(&self, function: &str) -> bool {
        self.handle.lease_is_live(function)
    }

    fn constraints(&self) -> Constraints {
        self.handle.constraints().expect("the unit runs")
    }

    fn set_access(&self, table: Option<&'static [Rule]>) -> Result<(), Error> {
        self.handle.set_access(lent(table))
    }

    fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.handle.set_constraints(constraints)
    }

    fn counted(&self, counter: LinkCounter) -> u64 {
        self.handle.counted(counter)
    }

    fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.handle.node_counted(counter)
    }

    fn events(&self) -> Vec<(Instant, Seen)> {
        self.handle
            .log()
            .into_iter()
            .filter_map(|(at, event)| Some((at, Seen::of(event.reported()?.clone(), |up| *up)?)))
            .collect()
    }

    fn manager_losses(&self) -> Vec<Instant> {
        self.losses.borrow().clone()
    }

    fn number(&self) -> usize {
        self.number
    }
}
