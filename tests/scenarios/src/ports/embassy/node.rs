//! One unit on its board, in all its lives.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::access::Rule;
use cara_core::services::call::Caller;
use cara_core::services::heart::{self, Renew};
use cara_core::services::lease::Lease;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_embassy::{Config, Handle, LeaseWatch, Peer};
use cara_embassy_host::{Bench, Board, Wire, now, security};
use embassy_time::with_timeout;

use super::super::lent;
use super::memory;
use super::services;
use crate::{Heart, Node, Pending, PendingAll, Seen, Service, Spec, SpecRole, boxed};

pub(super) struct BoardNode {
    number: usize,
    bench: Bench,
    mode: Mode,
    spec: Spec,
    /// In place of a network; the unit's number is its end.
    wire: Option<Wire>,
    board: RefCell<Board>,
    unit: RefCell<Option<Handle>>,
    /// Services of this life, with their leases.
    services: RefCell<BTreeMap<String, (Service, &'static Lease)>>,
    /// Of the calls of each service.
    orders: RefCell<BTreeMap<String, Vec<LeaseWatch>>>,
    events: Rc<RefCell<Vec<(Instant, Seen)>>>,
    losses: Rc<RefCell<Vec<Instant>>>,
    /// The claim of the last life, which a manager stores.
    claim: Cell<Claim>,
}

impl BoardNode {
    pub(super) fn new(number: usize, bench: &Bench, mode: Mode, wire: Option<Wire>, spec: Spec) -> Rc<Self> {
        let node = Rc::new(Self {
            number,
            bench: bench.clone(),
            mode,
            spec,
            wire,
            board: RefCell::new(bench.board()),
            unit: RefCell::new(None),
            services: RefCell::default(),
            orders: RefCell::default(),
            events: Rc::default(),
            losses: Rc::default(),
            claim: Cell::default(),
        });
        node.begin();
        node
    }

    pub(super) fn board(&self) -> Board {
        self.board.borrow().clone()
    }

    pub(super) fn unit(&self) -> Result<Handle, Error> {
        (*self.unit.borrow()).ok_or(Error::NotRunning)
    }

    pub(super) fn cut_power(&self) {
        self.unit.take();
        self.board().cut_power();
    }

    /// Begins another life.
    pub(super) fn boot(self: &Rc<Self>) {
        let board = self.board().reboot();
        self.board.replace(board);
        self.services.take();
        self.begin();
    }

    /// Notes a service; whether one of its name was there.
    pub(super) fn keep(&self, service: &Service, lease: &'static Lease) -> bool {
        self.services.borrow_mut().insert(service.name().to_owned(), (service.clone(), lease)).is_some()
    }

    /// A call of a service has begun.
    pub(super) fn begins(&self, name: &str, order: Option<LeaseWatch>) {
        self.orders.borrow_mut().entry(name.to_owned()).or_default().extend(order);
    }

    pub(super) fn service(&self, name: &str) -> Option<Service> {
        self.services.borrow().get(name).map(|(service, _)| service.clone())
    }

    fn begin(self: &Rc<Self>) {
        let board = self.board();
        let made = self.config().and_then(|config| match &self.wire {
            Some(wire) => {
                memory::on_line(&self.spec, wire.line(self.number, &board, self.bench.random(u64::MAX)), config)
            }
            None => memory::on_network(&self.spec, board.network(), config),
        });
        let (unit, mut runner) = made.expect("a unit can be made");
        self.unit.replace(Some(unit));
        let losses = Rc::clone(&self.losses);
        unit.on_manager_lost(Box::leak(Box::new(move |_: &mut ()| losses.borrow_mut().push(now()))));
        for service in &self.spec.services {
            services::put(self, service, false).expect("a unit has room for its services");
        }
        if self.spec.published {
            unit.publish_my_function_list().expect("what was added can be published");
        }
        let events = Rc::clone(&self.events);
        board.spawn(async move {
            loop {
                let seen = Seen::of(unit.next_event().await, Option::is_some);
                events.borrow_mut().extend(seen.map(|seen| (now(), seen)));
            }
        });
        board.spawn(async move { runner.run().await });
    }

    fn config(&self) -> Result<Config, Error> {
        let Spec { role, name, id, fleet, mut constraints, same_seed, .. } = self.spec.clone();
        let seed = if same_seed { 4 } else { self.bench.random(u64::MAX) };
        let links = if self.wire.is_some() { 1 } else { memory::links(&self.spec) };
        constraints.maximum_nodes = constraints.maximum_nodes.min(links);
        let security = security(self.mode, &self.spec.identity(), fleet, seed);
        let config = match role {
            SpecRole::Manager => Config::m_unit(&name, id, security)?,
            SpecRole::Agv(manager, manager_id) => Config::s_unit(&name, id, &manager, manager_id, security)?,
        };
        let above = if self.spec.takes_over { 1 } else { 0 };
        let last = self.claim.get().max(Claim { term: above, claimant: 0 });
        self.claim.set(last.raised(self.bench.random(u64::MAX)));
        let config = config.claim(self.claim.get(), |_| true);
        let epoch = self.bench.random(u64::MAX);
        Ok(config.fleet(fleet).constraints(constraints).epoch(epoch))
    }

    fn peer(&self, name: &str) -> Result<Peer, Error> {
        self.unit()?.peer(name)
    }

    fn connected(&self) -> Vec<Peer> {
        self.unit().map(|unit| unit.peers().collect()).unwrap_or_default()
    }

    fn asked_with_all(&self, function: &str) -> Vec<Peer> {
        let mut asked: Vec<Peer> = self.unit().map(|unit| unit.roster().collect()).unwrap_or_default();
        asked.extend(self.offering(function).into_iter().filter(|peer| peer.identity().role() == Role::MUnit));
        asked
    }

    fn offering(&self, function: &str) -> Vec<Peer> {
        self.unit().map(|unit| unit.nodes_offering(function).collect()).unwrap_or_default()
    }
}

impl Node for Rc<BoardNode> {
    fn identity(&self) -> Identity {
        self.spec.identity()
    }

    fn broadcast(&self) {
        if let Ok(unit) = self.unit() {
            unit.broadcast();
        }
    }

    fn stop(&self) {
        if let Some(unit) = self.unit.take() {
            unit.stop();
        }
    }

    fn start(&self) {
        self.boot();
    }

    fn add_service(&self, service: &Service) -> Result<(), Error> {
        services::put(self, service, false)
    }

    fn replace_service(&self, service: &Service) -> Result<(), Error> {
        services::put(self, service, true)
    }

    fn remove_service(&self, name: &str) -> Result<(), Error> {
        self.unit()?.my_function_list().remove(name)?;
        self.services.borrow_mut().remove(name);
        Ok(())
    }

    fn publish(&self) -> Result<(), Error> {
        self.unit()?.publish_my_function_list()
    }

    fn publish_to(&self, peer: &str) -> Result<(), Error> {
        self.peer(peer)?.publish_my_function_list()
    }

    fn begin_publish(&self) -> Pending<Vec<Identity>> {
        let pending = Pending::new();
        let (unit, reported) = (self.unit(), pending.share());
        self.board().spawn(async move {
            let result = match unit {
                Ok(unit) => with_timeout(embassy_time::Duration::from_secs(10), unit.publish_and_wait()).await,
                Err(error) => Ok(Err(error)),
            };
            reported.end(result.unwrap_or(Err(Error::TimedOut)).map(|()| Vec::new()), now());
        });
        pending
    }

    fn my_function_list(&self) -> String {
        self.unit().map(|unit| unit.my_function_list().to_string()).unwrap_or_default()
    }

    fn s_units(&self) -> Vec<(Identity, bool)> {
        let Ok(unit) = self.unit() else { return Vec::new() };
        unit.roster().map(|peer| (peer.identity().clone(), peer.is_connected())).collect()
    }

    fn number_of_s_units(&self) -> usize {
        self.unit().map(|unit| unit.number_of_s_units()).unwrap_or_default()
    }

    fn peers(&self) -> Vec<Identity> {
        self.connected().iter().map(|peer| peer.identity().clone()).collect()
    }

    fn nodes_offering(&self, function: &str) -> Vec<Identity> {
        self.offering(function).iter().map(|peer| peer.identity().clone()).collect()
    }

    fn their_function_list(&self, peer: &str) -> String {
        self.peer(peer).map(|peer| peer.their_function_list().show_functions().to_string()).unwrap_or_default()
    }

    fn request_with(
        &self,
        peer: &str,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<CallId, Error> {
        Ok(self.peer(peer)?.send(function.into(), parameters, &options)?)
    }

    fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Identity, Result<CallId, Error>)> {
        let asked = self.asked_with_all(function).into_iter();
        asked.map(|peer| (peer.identity().clone(), peer.request(function, parameters))).collect()
    }

    fn begin(&self, peer: &str, function: &str, parameters: &ParametersView, options: RequestOptions) -> Pending {
        let pending = Pending::new();
        let (asked, reported, mut parameters) = (self.peer(peer), pending.share(), boxed(parameters));
        let function = function.to_owned();
        self.board().spawn(async move {
            let result = match asked {
                Ok(peer) => peer.call(&function, &mut parameters).with(options).await.map_err(Error::from),
                Err(error) => Err(error),
            };
            reported.end(result.map(|()| parameters), now());
        });
        pending
    }

    fn begin_all(&self, function: &str, parameters: &ParametersView) -> PendingAll {
        let pending = Pending::new();
        let peers = self.asked_with_all(function);
        let (count, outcomes) = (peers.len(), Rc::new(RefCell::new(Vec::new())));
        for peer in peers {
            let (reported, outcomes) = (pending.share(), Rc::clone(&outcomes));
            let (function, mut parameters) = (function.to_owned(), boxed(parameters));
            self.board().spawn(async move {
                let outcome = peer.block_request(&function, &mut parameters).await;
                outcomes.borrow_mut().push((peer.identity().clone(), outcome));
                if outcomes.borrow().len() == count {
                    reported.end(Ok(outcomes.take()), now());
                }
            });
        }
        if count == 0 {
            pending.end(Ok(Vec::new()), now());
        }
        pending
    }

    fn release(&self, peer: &str, function: &str) -> Result<(), Error> {
        self.peer(peer)?.release(function)
    }

    fn heart(&self, period: Duration) -> Heart {
        let heart: &'static heart::Heart = Box::leak(Box::new(heart::Heart::new(period)));
        Heart::new(Renew::Heart(heart.beats()), move || heart.beat(now()))
    }

    fn end_order(&self, function: &str, call: usize) -> bool {
        let order = self.orders.borrow()[function][call];
        self.unit().expect("the unit runs").end_order(&order)
    }

    fn lease_is_live(&self, function: &str) -> bool {
        self.services.borrow().get(function).is_some_and(|(_, lease)| lease.is_live(now()))
    }

    fn constraints(&self) -> Constraints {
        self.unit().expect("the unit runs").constraints()
    }

    fn set_access(&self, table: Option<&'static [Rule]>) -> Result<(), Error> {
        self.unit()?.set_access(lent(table));
        Ok(())
    }

    fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.unit()?.set_constraints(constraints)
    }

    fn counted(&self, counter: LinkCounter) -> u64 {
        self.unit().map_or(0, |unit| unit.counted(counter))
    }

    fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.unit().map_or(0, |unit| unit.node_counted(counter))
    }

    fn events(&self) -> Vec<(Instant, Seen)> {
        self.events.borrow().clone()
    }

    fn manager_losses(&self) -> Vec<Instant> {
        match self.identity().role() {
            Role::SUnit => self.losses.borrow().clone(),
            Role::MUnit => Vec::new(),
        }
    }

    fn number(&self) -> usize {
        self.number
    }
}
