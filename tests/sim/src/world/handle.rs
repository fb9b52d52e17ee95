//! What tests and services do with a unit: the same words as on the real ports.

use std::fmt;
use std::future::Future;
use std::net::SocketAddr;
use std::rc::{Rc, Weak};

use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::host::mailman::LinkId;
use cara_core::services::Ticket;
use cara_core::time::{Duration, Instant};

use super::functions::MyFunctionList;
use super::links::{Link, Links, SimSession};
use super::replies::{CallError, Promise};
use super::service::BoxedParameters;
use super::state::Machine;
use super::tasks::Owner;
use super::{Inner, Shared};
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
    pub(super) fn is(&self, identity: &Identity) -> bool {
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
    pub(super) shared: Weak<Shared>,
    host: HostId,
}

impl fmt::Debug for UnitHandle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "UnitHandle({:?})", self.host)
    }
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

    /// What its own clock shows: the virtual time, unless it was [set ahead](super::NewUnit::clock).
    pub fn clock(&self) -> Instant {
        self.with(|inner| inner.network.clock(self.host))
    }

    /// Whether it lives.
    pub fn is_running(&self) -> bool {
        self.with(|inner| inner.units[self.host.index()].machine.is_some())
    }

    // --- its keys

    /// It has no key for units of this name any more, in this life.
    pub fn forget_key_of(&self, name: &str) -> Result<(), Error> {
        self.machine(|machine, _| machine.links.keys.forget(name))
    }

    /// It has the keys of this generation in this life, and those of the other one beside them. The first is 1.
    pub fn change_keys(&self, generation: u32, other: Option<u32>) -> Result<(), Error> {
        self.machine(|machine, _| machine.links.keys.change(generation, other))
    }

    // --- its own functions

    /// The functions that it offers.
    pub fn my_function_list(&self) -> MyFunctionList<'_> {
        MyFunctionList { unit: self }
    }

    /// Publishes all of its functions to all nodes, those that come later among them.
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.publish_waiting().map(drop)
    }

    /// As [`Self::publish_my_function_list`], and returns when every connected node has read the list; names those that have not.
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
    pub fn publish_my_function_list_to(&self, peer: impl Into<Peer>) -> Result<(), Error> {
        let peer = peer.into();
        let index = self.link_to(&peer)?;
        self.machine(|machine, network| {
            let links = &mut machine.links;
            let identity =
                links.link(index).and_then(|link| link.session.peer()).cloned().ok_or(Error::NotConnected)?;
            for function in links.functions.iter() {
                links.hub.publications.publish_to(&identity, function.slot)?;
            }
            links.with(network, index, |session, cx| session.publish(cx));
            Ok::<_, Error>(())
        })??;
        self.work(index);
        Ok(())
    }

    // --- peers

    /// Looks for nodes now.
    pub fn broadcast(&self) -> Result<(), Error> {
        self.machine(|machine, network| machine.links.hub.node.broadcast(network.clock(self.host)))?;
        self.with_shared(|inner, shared| inner.work_node(shared, self.host));
        Ok(())
    }

    /// The connected nodes, in the order of their links.
    pub fn peers(&self) -> Vec<Identity> {
        let peers = self
            .machine(|machine, _| machine.links.iter().filter_map(|(_, link)| link.session.peer().cloned()).collect());
        peers.unwrap_or_default()
    }

    /// The connected s_units.
    pub fn s_units(&self) -> Vec<Identity> {
        self.peers().into_iter().filter(|peer| peer.role() == Role::SUnit).collect()
    }

    /// How many s_units are connected and have published their lists.
    pub fn number_of_s_units(&self) -> usize {
        let s_unit = |link: &Link| link.session.peer().is_some_and(|peer| peer.role() == Role::SUnit);
        let counts = |link: &Link| link.session.is_listed() && s_unit(link);
        self.machine(|machine, _| machine.links.iter().filter(|(_, link)| counts(link)).count()).unwrap_or_default()
    }

    /// The s_units that have joined this life of the unit, connected or not.
    pub fn roster(&self) -> Vec<Identity> {
        let joined =
            self.machine(|machine, _| machine.links.hub.node.s_units().map(|known| known.identity.clone()).collect());
        joined.unwrap_or_default()
    }

    /// The s_units that this life of the unit has known, in the order in which they became known, and whether each is
    /// connected. One that has left keeps its place.
    pub fn s_units_ever(&self) -> Vec<(Identity, bool)> {
        let known = self.machine(|machine, _| {
            let s_units = machine.links.hub.node.nodes().filter(|known| known.identity.role() == Role::SUnit);
            s_units.map(|known| (known.identity.clone(), known.is_joined())).collect()
        });
        known.unwrap_or_default()
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
            let offering = machine.links.iter().filter(|(_, link)| offers(link));
            offering.filter_map(|(_, link)| link.session.peer().cloned()).collect()
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
            inner.sleep_until(self.host, at)
        });
        promise.await;
    }

    /// Whether it is an m_unit that stands by.
    pub fn is_standby(&self) -> bool {
        let machine =
            |inner: &mut Inner| Some(inner.units[self.host.index()].machine.as_ref()?.links.hub.node.is_standby());
        self.with(machine).unwrap_or(false)
    }

    /// The claim of an m_unit, or the highest that an s_unit has obeyed; while it is down, the one that an m_unit has stored.
    pub fn claim(&self) -> Claim {
        self.with(|inner| {
            let unit = &inner.units[self.host.index()];
            unit.machine.as_ref().map_or(unit.claims.own, |machine| machine.links.hub.node.claim())
        })
    }

    /// The claim of an m_unit with its tag, as it announces it.
    pub fn tagged_claim(&self) -> TaggedClaim {
        let claim = self.with(|inner| {
            let machine = inner.units[self.host.index()].machine.as_mut()?;
            machine.links.hub.node.hello(Instant::START, LinkId(u16::MAX), 0).claim
        });
        claim.map_or(TaggedClaim::NONE, |report| report.tagged)
    }

    /// Its term.
    pub fn term(&self) -> u64 {
        self.claim().term
    }

    /// The claim of its manager that it has stored.
    pub fn stored_claim(&self) -> Option<TaggedClaim> {
        self.with(|inner| inner.units[self.host.index()].claims.obeyed.values().next().copied())
    }

    /// Replaces what an m_unit has stored, for its next life: as where it is lost, or wrong.
    pub fn keep_term(&self, term: u64) {
        self.with(|inner| inner.units[self.host.index()].claims.own = Claim { term, claimant: 0 });
    }

    /// Stops it in an orderly way: peers are told.
    pub fn stop(&self) {
        self.each_link(|links, network, index| {
            links.with(network, index, |session, cx| session.close(cx, cara_core::error::CloseReason::StoppedHere));
        });
        self.with(|inner| inner.network.stop(self.host));
    }

    /// Begins another life after [`Self::stop`].
    pub fn start(&self) {
        self.with(|inner| inner.network.restart(self.host));
    }

    // --- helpers

    pub(super) fn progress(&self, stream: StreamId, ticket: Ticket, values: &ParametersView) -> Result<(), Error> {
        let reported = self.machine(|machine, network| {
            let index = machine.links.of_stream(stream)?;
            Some((index, machine.links.progress(network, index, ticket, values)))
        })?;
        let Some((index, reported)) = reported else { return Ok(()) };
        self.work(index);
        reported
    }

    pub(super) fn is_cancelled(&self, stream: StreamId, ticket: Ticket) -> bool {
        let cancelled = self.machine(|machine, _| {
            let link = machine.links.of_stream(stream).and_then(|index| machine.links.link(index));
            link.is_none_or(|link| link.session.is_cancelled(ticket))
        });
        cancelled.unwrap_or(true)
    }

    pub(super) fn answer(&self, stream: StreamId, ticket: Ticket, outcome: Result<BoxedParameters, Box<CallError>>) {
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
            slots.into_iter().try_for_each(|slot| machine.links.hub.publications.publish_to_all(slot))
        })??;
        let mut waiting = Vec::new();
        for index in self.live_links() {
            let published = self.machine(|machine, network| {
                let links = &mut machine.links;
                let identity = links.link(index)?.session.peer()?.clone();
                let serial = links.with(network, index, |session, cx| session.publish(cx))?;
                Some((identity, links.await_acknowledgement(index, serial)))
            });
            waiting.extend(published?);
            self.work(index);
        }
        Ok(waiting)
    }

    pub(super) fn session<R>(&self, peer: impl Into<Peer>, look: impl FnOnce(&SimSession) -> R) -> Result<R, Error> {
        let index = self.link_to(&peer.into())?;
        self.machine(|machine, _| machine.links.link(index).map(|link| look(&link.session)))?.ok_or(Error::NotConnected)
    }

    pub(super) fn link_to(&self, peer: &Peer) -> Result<u16, Error> {
        self.machine(|machine, _| {
            let is = |link: &Link| link.session.is_live() && link.session.peer().is_some_and(|other| peer.is(other));
            machine.links.iter().find(|(_, link)| is(link)).map(|(index, _)| index)
        })?
        .ok_or(Error::NotConnected)
    }

    pub(super) fn live_links(&self) -> Vec<u16> {
        let live = self.machine(|machine, _| {
            machine.links.iter().filter(|(_, link)| link.session.is_live()).map(|(index, _)| index).collect()
        });
        live.unwrap_or_default()
    }

    /// Does something on each link; one that is not live yet may have told its list.
    pub(super) fn each_link(&self, mut act: impl FnMut(&mut Links, &mut Network, u16)) {
        let all = self.machine(|machine, _| machine.links.indices());
        for index in all.unwrap_or_default() {
            let _ = self.machine(|machine, network| act(&mut machine.links, network, index));
            self.work(index);
        }
    }

    pub(super) fn work(&self, index: u16) {
        self.with_shared(|inner, shared| inner.work(shared, self.host, index));
    }

    /// Whether its world does: what drops later has nothing to do there.
    pub(super) fn exists(&self) -> bool {
        self.shared.strong_count() > 0
    }

    pub(super) fn machine<R>(&self, act: impl FnOnce(&mut Machine, &mut Network) -> R) -> Result<R, Error> {
        self.with(|inner| {
            let Inner { units, network, .. } = inner;
            let machine = units[self.host.index()].machine.as_mut().ok_or(Error::NotRunning)?;
            Ok(act(machine, network))
        })
    }

    pub(super) fn with<R>(&self, act: impl FnOnce(&mut Inner) -> R) -> R {
        self.with_shared(|inner, _| act(inner))
    }

    pub(super) fn with_shared<R>(&self, act: impl FnOnce(&mut Inner, &Rc<Shared>) -> R) -> R {
        let shared = self.shared.upgrade().expect("a unit is not used after its world");
        shared.with(|inner| act(inner, &shared))
    }
}
