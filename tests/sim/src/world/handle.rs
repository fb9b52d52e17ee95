//! What tests and services do with a unit: the same words as on the real ports.

use std::future::Future;
use std::net::SocketAddr;
use std::rc::{Rc, Weak};

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::function::Definition;
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::Ticket;
use cara_core::services::requests::CallId;
use cara_core::services::unit::{RequestOptions, Session};
use cara_core::time::{Duration, Instant};

use super::links::{Link, Links};
use super::replies::{Promise, Waiting};
use super::service::{BoxedParameters, Handler, Service, boxed_parameters};
use super::state::{Machine, UnitState};
use super::tasks::Owner;
use super::{Inner, Shared, UnitEvent};
use crate::event::{HostId, StreamId};
use crate::network::Network;

/// Names a peer: by its name alone, or by all of its identity.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Peer {
    /// The first connected node of this name.
    Named(String),
    /// The node of this identity.
    Is(Identity),
}

impl From<&str> for Peer {
    fn from(name: &str) -> Self {
        Self::Named(name.to_owned())
    }
}

impl From<&Identity> for Peer {
    fn from(identity: &Identity) -> Self {
        Self::Is(identity.clone())
    }
}

impl From<&UnitHandle> for Peer {
    fn from(unit: &UnitHandle) -> Self {
        Self::Is(unit.identity())
    }
}

impl From<&Self> for Peer {
    fn from(peer: &Self) -> Self {
        peer.clone()
    }
}

impl Peer {
    fn is(&self, identity: &Identity) -> bool {
        match self {
            Self::Named(name) => identity.name() == name,
            Self::Is(wanted) => identity == wanted,
        }
    }
}

/// A unit of the world, in whichever life it is. Copies of a handle are the same unit.
///
/// While the unit is down, what needs a living unit answers [`Error::NotRunning`], or is empty.
///
/// # Panics
/// When it is used after its world.
#[derive(Clone)]
pub struct UnitHandle {
    shared: Weak<Shared>,
    host: HostId,
}

impl UnitHandle {
    pub(super) fn new(shared: Weak<Shared>, host: HostId) -> Self {
        Self { shared, host }
    }

    /// Its host in the network.
    pub fn host(&self) -> HostId {
        self.host
    }

    /// Its name, id and role.
    pub fn identity(&self) -> Identity {
        self.with(|inner| inner.units[self.host.index()].settings.identity.clone())
    }

    /// Its address and UDP port.
    pub fn address(&self) -> SocketAddr {
        self.with(|inner| inner.network.address(self.host))
    }

    /// The virtual time.
    pub fn now(&self) -> Instant {
        self.with(|inner| inner.network.now())
    }

    /// Whether it lives.
    pub fn is_running(&self) -> bool {
        self.with(|inner| inner.units[self.host.index()].machine.is_some())
    }

    // --- its own functions

    /// Adds a service, which nobody sees before it is published. The signature is in the text form, as in
    /// `pos_info() -> (position: int[2])`.
    ///
    /// # Panics
    /// For a signature that cannot be read.
    pub fn add_function(&self, signature: &str, service: Service) -> Result<(), Error> {
        let definition = definition(signature);
        let attributes = service.attributes;
        self.machine(|machine, _| {
            machine.links.functions.add_function(&definition, attributes, Handler(Rc::new(service))).map(|_| ())
        })?
    }

    /// Puts another service in the place of one of the same name; whoever knew the old one is told when this one is
    /// published.
    ///
    /// # Panics
    /// For a signature that cannot be read.
    pub fn replace_function(&self, signature: &str, service: Service) -> Result<(), Error> {
        let definition = definition(signature);
        let attributes = service.attributes;
        self.machine(|machine, _| {
            machine.links.functions.replace(&definition, attributes, Handler(Rc::new(service))).map(|_| ())
        })?
    }

    /// Removes a service; peers that saw it are told.
    pub fn remove_function(&self, name: &str) -> Result<(), Error> {
        let slot = self.machine(|machine, _| machine.links.functions.remove(name).map(|(slot, _)| slot))??;
        self.machine(|machine, _| machine.publications.withdraw(slot))?;
        self.each_live_link(|links, network, index| {
            links.with(network, index, |session, cx| session.withdraw(cx, slot));
        });
        Ok(())
    }

    /// Its own functions in the text form, one in a line.
    pub fn my_function_list(&self) -> String {
        let shown = self.machine(|machine, _| machine.links.functions.show_functions().to_string());
        shown.unwrap_or_default()
    }

    /// Publishes all of its functions to all nodes, those that come later among them.
    #[doc(alias = "publish_my_function_list")]
    pub fn publish(&self) -> Result<(), Error> {
        self.publish_waiting().map(drop)
    }

    /// As [`Self::publish`], and returns when every connected node has read the list; names those that have not.
    pub async fn publish_and_wait(&self) -> Result<Vec<Identity>, Error> {
        let mut missing = Vec::new();
        for (peer, acknowledged) in self.publish_waiting()? {
            if !acknowledged.await {
                missing.push(peer);
            }
        }
        Ok(missing)
    }

    /// Publishes all of its functions to one node only, also after that node reconnects.
    pub fn publish_to(&self, peer: impl Into<Peer>) -> Result<(), Error> {
        let peer = peer.into();
        let index = self.link_to(&peer)?;
        self.machine(|machine, network| {
            let Machine { links, publications, .. } = machine;
            let identity = links.link(index).and_then(|link| link.peer.clone()).ok_or(Error::NotConnected)?;
            let slots: Vec<Slot> = links.functions.iter().map(|function| function.slot).collect();
            for slot in slots {
                publications.publish_to(&identity, slot)?;
            }
            links.with(network, index, |session, cx| session.publish(cx, publications.visible_to(&identity)));
            Ok::<_, Error>(())
        })??;
        self.work(index);
        Ok(())
    }

    // --- peers

    /// Looks for nodes now.
    pub fn broadcast(&self) -> Result<(), Error> {
        self.machine(|machine, network| machine.node.broadcast(network.now()))?;
        self.with_shared(|inner, shared| inner.work_node(shared, self.host));
        Ok(())
    }

    /// The connected nodes, in the order of their links.
    pub fn peers(&self) -> Vec<Identity> {
        let peers = self.machine(|machine, _| machine.links.iter().filter_map(|(_, link)| link.peer.clone()).collect());
        peers.unwrap_or_default()
    }

    /// The connected s_units.
    pub fn s_units(&self) -> Vec<Identity> {
        self.peers().into_iter().filter(|peer| peer.role() == Role::SUnit).collect()
    }

    /// The connected m_units.
    pub fn m_units(&self) -> Vec<Identity> {
        self.peers().into_iter().filter(|peer| peer.role() == Role::MUnit).collect()
    }

    /// Whether a peer is connected.
    pub fn is_connected(&self, peer: impl Into<Peer>) -> bool {
        self.link_to(&peer.into()).is_ok()
    }

    /// The connected nodes that offer a function.
    pub fn nodes_offering(&self, function: &str) -> Vec<Identity> {
        let offers = |link: &Link| link.session.their_function_list().find(function).is_some();
        let nodes = self.machine(|machine, _| {
            machine.links.iter().filter(|(_, link)| offers(link)).filter_map(|(_, link)| link.peer.clone()).collect()
        });
        nodes.unwrap_or_default()
    }

    /// What a peer has published to this unit, one function in a line.
    pub fn their_function_list(&self, peer: impl Into<Peer>) -> Result<String, Error> {
        self.session(peer, |session| session.their_function_list().show_functions().to_string())
    }

    /// Whether a peer has published a function of this name to this unit.
    pub fn knows(&self, peer: impl Into<Peer>, function: &str) -> bool {
        self.session(peer, |session| session.their_function_list().find(function).is_some()).unwrap_or(false)
    }

    // --- requests

    /// The paper's asynchronous request: returns at once, and leaves the parameters as they are.
    pub fn request(&self, peer: impl Into<Peer>, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.request_with(peer, function, parameters, RequestOptions::default())
    }

    /// As [`Self::request`], with options.
    pub fn request_with(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<CallId, Error> {
        let index = self.link_to(&peer.into())?;
        let requested = self
            .machine(|machine, network| machine.links.request(network, index, function, parameters, &options, None))?;
        self.work(index);
        requested
    }

    /// The asynchronous request to every connected node, with an outcome for each.
    pub fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Identity, Result<CallId, Error>)> {
        self.peers().into_iter().map(|peer| (peer.clone(), self.request(&peer, function, parameters))).collect()
    }

    /// The paper's synchronous request: waits for the reply, which updates the parameters; on an error they are
    /// unchanged. Waits inside the deadline for the minimum interval to pass.
    pub async fn block_request(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &mut ParametersView,
    ) -> Result<(), Error> {
        self.block_request_with(peer, function, parameters, RequestOptions::default()).await
    }

    /// As [`Self::block_request`], with options.
    pub async fn block_request_with(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &mut ParametersView,
        options: RequestOptions,
    ) -> Result<(), Error> {
        let peer = peer.into();
        let timeout = options.timeout.unwrap_or(self.constraints()?.request_timeout);
        let deadline = self.now() + timeout;
        loop {
            let options = RequestOptions { timeout: Some(deadline.since(self.now())), ..options };
            match self.call(&peer, function, parameters, &options) {
                Ok(call) => {
                    let results = call.promise.clone().await?;
                    return parameters.copy_from(&results);
                }
                Err(Error::TooSoon { wait }) if self.now() + wait < deadline => self.sleep(wait).await,
                Err(error) => return Err(error),
            }
        }
    }

    /// The synchronous request to every connected node at the same time, with an outcome for each.
    pub async fn block_request_all(
        &self,
        function: &str,
        parameters: &ParametersView,
    ) -> Vec<(Identity, Result<BoxedParameters, Error>)> {
        let options = RequestOptions::default();
        let calls: Vec<_> = self
            .peers()
            .into_iter()
            .map(|peer| (peer.clone(), self.call(&Peer::Is(peer), function, parameters, &options)))
            .collect();
        let mut outcomes = Vec::new();
        for (peer, call) in calls {
            outcomes.push((
                peer,
                match call {
                    Ok(call) => call.promise.clone().await,
                    Err(error) => Err(error),
                },
            ));
        }
        outcomes
    }

    /// Gives up the lease that it holds on a function of a peer, which stops what that started.
    pub fn release(&self, peer: impl Into<Peer>, function: &str) -> Result<(), Error> {
        let index = self.link_to(&peer.into())?;
        self.machine(|machine, network| {
            let released = machine.links.with(network, index, |session, cx| {
                let slot = session.their_function_list().find(function).ok_or(Error::UnknownFunction)?;
                session.release(cx, slot);
                Ok(())
            });
            released.unwrap_or(Err(Error::NotConnected))
        })??;
        self.work(index);
        Ok(())
    }

    /// What a leased service of this unit started is finished: its lease ends, and no safe hook runs.
    pub fn end_lease(&self, function: &str) -> Result<(), Error> {
        let slot = self.machine(|machine, _| machine.links.functions.find(function))?.ok_or(Error::UnknownFunction)?;
        self.each_live_link(|links, network, index| {
            links.with(network, index, |session, cx| session.end_lease(cx, slot));
        });
        Ok(())
    }

    /// Whether the lease of one of its own services is live now; false for one without a lease.
    pub fn lease_is_live(&self, function: &str) -> bool {
        let live = self.machine(|machine, network| {
            let functions = &machine.links.functions;
            let function = functions.find(function).and_then(|slot| functions.function(slot))?;
            function.handler.0.lease_is_live(network.now())
        });
        matches!(live, Ok(Some(true)))
    }

    // --- constraints, counters, log

    /// Its constraints.
    pub fn constraints(&self) -> Result<Constraints, Error> {
        self.machine(|machine, _| machine.constraints)
    }

    /// Changes its constraints while it runs; peers are told.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.with(|inner| {
            let UnitState { machine, settings, .. } = &mut inner.units[self.host.index()];
            let machine = machine.as_mut().ok_or(Error::NotRunning)?;
            let fits = constraints.message_size <= settings.constraints.message_size
                && usize::from(constraints.maximum_nodes) <= settings.links;
            if !fits {
                return Err(Error::BadConstraint);
            }
            machine.constraints = constraints;
            machine.node.set_constraints(constraints);
            Ok(())
        })?;
        self.each_live_link(|links, network, index| {
            links.with(network, index, |session, cx| session.set_constraints(cx, constraints));
        });
        Ok(())
    }

    /// A counter of all links of all its lives.
    pub fn link_counter(&self, counter: LinkCounter) -> u64 {
        self.with(|inner| {
            let unit = &inner.units[self.host.index()];
            let live = unit.machine.iter().flat_map(|machine| machine.links.iter());
            live.map(|(_, link)| link.session.counters().value(counter)).sum::<u64>() + unit.counters.value(counter)
        })
    }

    /// A counter of discovery and membership, of this life.
    pub fn node_counter(&self, counter: NodeCounter) -> u64 {
        self.machine(|machine, _| machine.node.counters.value(counter)).unwrap_or(0)
    }

    /// Message buffers that are free now.
    pub fn free_buffers(&self) -> usize {
        self.machine(|machine, _| machine.links.buffers.free()).unwrap_or(0)
    }

    /// Calls of this unit to all peers that wait for a reply.
    pub fn calls_in_flight(&self) -> usize {
        self.sum_of_sessions(|session| session.calls_in_flight())
    }

    /// Calls of all peers that run or wait here.
    pub fn calls_held(&self) -> usize {
        self.sum_of_sessions(|session| usize::from(session.calls_held()))
    }

    /// Everything that happened to it, in all its lives.
    pub fn log(&self) -> Vec<(Instant, UnitEvent)> {
        self.with(|inner| inner.units[self.host.index()].log.clone())
    }

    /// How many events of its log match.
    pub fn count(&self, matches: impl Fn(&UnitEvent) -> bool) -> usize {
        self.with(|inner| inner.units[self.host.index()].log.iter().filter(|(_, event)| matches(event)).count())
    }

    /// Runs at each event from now on, in all its lives.
    pub fn on_event(&self, hook: impl Fn(&Self, &UnitEvent) + 'static) {
        self.with(|inner| inner.units[self.host.index()].hooks.push(Rc::new(hook)));
    }

    // --- time

    /// Runs a future in this life of the unit, beside everything else.
    pub fn spawn(&self, future: impl Future<Output = ()> + 'static) {
        self.with(|inner| {
            let owner = Owner { host: self.host, life: inner.units[self.host.index()].life };
            inner.spawned.push((owner, Box::pin(future)));
        });
    }

    /// Waits for a span of virtual time.
    pub async fn sleep(&self, span: Duration) {
        let promise = self.with(|inner| {
            let at = inner.network.now() + span;
            inner.sleep_until(at)
        });
        promise.await;
    }

    /// Stops it in an orderly way: peers are told.
    pub fn stop(&self) {
        self.each_live_link(|links, network, index| {
            links.with(network, index, |session, cx| session.close(cx, cara_core::error::CloseReason::Stopped));
        });
        self.with(|inner| inner.network.stop(self.host));
    }

    /// Begins another life after [`Self::stop`].
    pub fn start(&self) {
        self.with(|inner| inner.network.restart(self.host));
    }

    // --- helpers

    pub(super) fn answer(&self, stream: StreamId, ticket: Ticket, outcome: Result<BoxedParameters, Error>) {
        let answered = self.machine(|machine, network| {
            let index = machine.links.of_stream(stream)?;
            machine.links.answer(network, index, ticket, outcome);
            Some(index)
        });
        if let Ok(Some(index)) = answered {
            self.work(index);
        }
    }

    fn publish_waiting(&self) -> Result<Vec<(Identity, Promise<bool>)>, Error> {
        self.machine(|machine, _| {
            let slots: Vec<Slot> = machine.links.functions.iter().map(|function| function.slot).collect();
            slots.into_iter().try_for_each(|slot| machine.publications.publish_to_all(slot))
        })??;
        let mut waiting = Vec::new();
        for index in self.live_links() {
            let published = self.machine(|machine, network| {
                let Machine { links, publications, .. } = machine;
                let identity = links.link(index)?.peer.clone()?;
                let visible = publications.visible_to(&identity);
                let serial = links.with(network, index, |session, cx| session.publish(cx, visible))?;
                Some((identity.clone(), links.await_acknowledgement(index, serial)))
            });
            waiting.extend(published?);
            self.work(index);
        }
        Ok(waiting)
    }

    /// Sends a call whose end the promise tells; giving up the returned value gives up the call.
    fn call(
        &self,
        peer: &Peer,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<InFlight, Error> {
        let index = self.link_to(peer)?;
        let mut copy = boxed_parameters(size_of_val(parameters));
        copy.copy_from(parameters)?;
        let promise = Promise::new();
        let waiting = Waiting { parameters: copy, promise: promise.clone() };
        let requested = self.machine(|machine, network| {
            let stream = machine.links.link(index).map(|link| link.stream).ok_or(Error::NotConnected)?;
            let id = machine.links.request(network, index, function, parameters, options, Some(waiting))?;
            Ok((stream, id))
        })?;
        self.work(index);
        requested.map(|(stream, id)| InFlight { unit: self.clone(), stream, id, promise })
    }

    fn session<R>(
        &self,
        peer: impl Into<Peer>,
        look: impl FnOnce(&Session<crate::Boxed, cara_core::host::secure::Plain>) -> R,
    ) -> Result<R, Error> {
        let index = self.link_to(&peer.into())?;
        self.machine(|machine, _| machine.links.link(index).map(|link| look(&link.session)))?.ok_or(Error::NotConnected)
    }

    fn sum_of_sessions(
        &self,
        count: impl Fn(&Session<crate::Boxed, cara_core::host::secure::Plain>) -> usize,
    ) -> usize {
        self.machine(|machine, _| machine.links.iter().map(|(_, link)| count(&link.session)).sum()).unwrap_or(0)
    }

    fn link_to(&self, peer: &Peer) -> Result<u16, Error> {
        self.machine(|machine, _| {
            let is = |link: &Link| link.session.is_live() && link.peer.as_ref().is_some_and(|other| peer.is(other));
            machine.links.iter().find(|(_, link)| is(link)).map(|(index, _)| index)
        })?
        .ok_or(Error::NotConnected)
    }

    fn live_links(&self) -> Vec<u16> {
        let live = self.machine(|machine, _| {
            machine.links.iter().filter(|(_, link)| link.session.is_live()).map(|(index, _)| index).collect()
        });
        live.unwrap_or_default()
    }

    fn each_live_link(&self, mut act: impl FnMut(&mut Links, &mut Network, u16)) {
        for index in self.live_links() {
            let _ = self.machine(|machine, network| act(&mut machine.links, network, index));
            self.work(index);
        }
    }

    fn work(&self, index: u16) {
        self.with_shared(|inner, shared| inner.work(shared, self.host, index));
    }

    fn machine<R>(&self, act: impl FnOnce(&mut Machine, &mut Network) -> R) -> Result<R, Error> {
        self.with(|inner| {
            let Inner { units, network, .. } = inner;
            let machine = units[self.host.index()].machine.as_mut().ok_or(Error::NotRunning)?;
            Ok(act(machine, network))
        })
    }

    fn with<R>(&self, act: impl FnOnce(&mut Inner) -> R) -> R {
        self.with_shared(|inner, _| act(inner))
    }

    fn with_shared<R>(&self, act: impl FnOnce(&mut Inner, &Rc<Shared>) -> R) -> R {
        let shared = self.shared.upgrade().expect("a unit is not used after its world");
        shared.with(|inner| act(inner, &shared))
    }
}

/// A call in flight, which is given up when this is dropped.
struct InFlight {
    unit: UnitHandle,
    stream: StreamId,
    id: CallId,
    promise: Promise<Result<BoxedParameters, Error>>,
}

impl Drop for InFlight {
    fn drop(&mut self) {
        if self.unit.shared.strong_count() == 0 {
            return;
        }
        let _ = self.unit.machine(|machine, _| {
            if let Some(index) = machine.links.of_stream(self.stream) {
                machine.links.cancel(index, self.id);
            }
        });
    }
}

fn definition(signature: &str) -> Definition {
    match Definition::parse(signature) {
        Ok(definition) => definition,
        Err(error) => panic!("`{signature}` is no signature: {error:?}"),
    }
}
