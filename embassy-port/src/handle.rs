//! What tasks do with a unit, in the words of the Linux port.

use core::fmt;
use core::future::poll_fn;
use core::net::SocketAddrV4;
use core::task::Poll;

use cara_core::config::Constraints;
use cara_core::counters::Counter;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::{Finding, NodeCounter};
use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::access::Access;
use cara_core::services::requests::CallId;
use cara_core::time::Duration;

use crate::config::Table;
use crate::event::UnitEvent;
use crate::handler::Hook;
use crate::machine::{Machine, Shared};
use crate::peer::Peer;

/// A unit, for any task of the executor that its runner runs on. Copies are the same unit.
pub struct Handle<T: 'static = ()> {
    pub(crate) shared: &'static Shared<T>,
}

impl<T> Clone for Handle<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Handle<T> {}

impl<T> fmt::Debug for Handle<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.identity())
    }
}

impl<T> Handle<T> {
    /// Changes the unit, and has the runner look again.
    pub(crate) fn act<R>(&self, act: impl FnOnce(&mut Machine<T>) -> R) -> R {
        let mut machine = self.shared.machine.borrow_mut();
        let result = act(&mut machine);
        machine.wake_runner();
        result
    }

    pub(crate) fn look<R>(&self, look: impl FnOnce(&Machine<T>) -> R) -> R {
        look(&self.shared.machine.borrow())
    }

    /// This unit's identity.
    pub fn identity(&self) -> Identity {
        self.look(|machine| machine.hub.node.identity().clone())
    }

    /// Searches for nodes, or for the manager, now (paper, listing line 6).
    pub fn broadcast(&self) {
        self.act(|machine| machine.hub.node.broadcast(crate::now()));
    }

    /// Ends every link in an orderly way, and stops searching. The unit starts again only with a restart of the board.
    pub fn stop(&self) {
        self.act(Machine::stop);
    }

    /// The claim of an m_unit, or the highest that an s_unit has obeyed.
    pub fn claim(&self) -> Claim {
        self.look(|machine| machine.hub.node.claim())
    }

    // --- peers

    /// The manager of an s_unit, while it is known.
    pub fn manager(&self) -> Option<Peer<T>> {
        let manager = self.look(|machine| machine.hub.node.m_units().next().map(|known| known.identity.clone()));
        manager.map(|identity| Peer { unit: *self, identity })
    }

    /// The node of this name among those that have joined, connected or not. [`Error::NotConnected`] where there is none,
    /// [`Error::Ambiguous`] where there are several: take [`Self::node`] then.
    pub fn peer(&self, name: &str) -> Result<Peer<T>, Error> {
        let identity = self.look(|machine| machine.hub.node.find(name).map(|known| known.identity.clone()));
        identity.map(|identity| Peer { unit: *self, identity })
    }

    /// The s_unit of this name, likewise.
    pub fn s_unit(&self, name: &str) -> Result<Peer<T>, Error> {
        self.only(Role::SUnit, name)
    }

    /// The m_unit of this name, likewise.
    pub fn m_unit(&self, name: &str) -> Result<Peer<T>, Error> {
        self.only(Role::MUnit, name)
    }

    fn only(&self, role: Role, name: &str) -> Result<Peer<T>, Error> {
        let mut same = self.of_role(role).filter(|peer| peer.identity.name() == name);
        match (same.next(), same.next()) {
            (None, _) => Err(Error::NotConnected),
            (Some(only), None) => Ok(only),
            (Some(first), Some(second)) => Err(Error::Ambiguous { ids: [first.identity.id(), second.identity.id()] }),
        }
    }

    /// The node of an identity, connected or not: `None` if it has never joined, or has been forgotten for others.
    pub fn node(&self, identity: &Identity) -> Option<Peer<T>> {
        let known = self.look(|machine| machine.hub.node.node(identity).is_some());
        known.then(|| Peer { unit: *self, identity: identity.clone() })
    }

    /// The s_units that have joined since the board's start, connected or not, in the order of joining (paper, listing
    /// line 8). One that has left keeps its place, so that an index goes on to mean the same node.
    pub fn s_units(&self) -> impl Iterator<Item = Peer<T>> + use<T> {
        self.of_role(Role::SUnit)
    }

    /// The m_units, likewise.
    pub fn m_units(&self) -> impl Iterator<Item = Peer<T>> + use<T> {
        self.of_role(Role::MUnit)
    }

    fn of_role(&self, role: Role) -> impl Iterator<Item = Peer<T>> + use<T> {
        let unit = *self;
        (0..).map_while(move |index| {
            let identity = unit.look(|machine| {
                let known = match role {
                    Role::SUnit => machine.hub.node.s_unit(index),
                    Role::MUnit => machine.hub.node.m_unit(index),
                };
                known.map(|known| known.identity.clone())
            })?;
            Some(Peer { unit, identity })
        })
    }

    /// The s_units that this manager is to have: those that have joined since the board's start, connected or not.
    pub fn roster(&self) -> impl Iterator<Item = Peer<T>> + use<T> {
        self.s_units()
    }

    /// The connected node at a place of the unit's table of links, of which there are [`Self::links`].
    pub fn peer_at(&self, link: u16) -> Option<Peer<T>> {
        let identity = self.look(|machine| machine.link(link).and_then(|link| link.peer().cloned()));
        identity.map(|identity| Peer { unit: *self, identity })
    }

    /// How many links the unit has room for.
    pub fn links(&self) -> u16 {
        self.look(|machine| machine.indices().end)
    }

    /// The connected nodes, in the order of their links.
    pub fn peers(&self) -> impl Iterator<Item = Peer<T>> + use<T> {
        let unit = *self;
        (0..self.links()).filter_map(move |link| unit.peer_at(link))
    }

    /// The connected nodes that offer a function to this unit.
    pub fn nodes_offering<'n>(&self, function: &'n str) -> impl Iterator<Item = Peer<T>> + use<'n, T> {
        self.peers().filter(move |peer| peer.their_function_list().contains(function))
    }

    /// How many s_units are connected (paper, listing line 4).
    pub fn number_of_s_units(&self) -> usize {
        self.number_of(Role::SUnit)
    }

    /// How many m_units are connected.
    pub fn number_of_m_units(&self) -> usize {
        self.number_of(Role::MUnit)
    }

    fn number_of(&self, role: Role) -> usize {
        self.peers().filter(|peer| peer.identity().role() == role).count()
    }

    /// Whether any node, such as the manager, is connected.
    pub fn is_connected(&self) -> bool {
        self.peers().next().is_some()
    }

    /// Waits until `done` holds of the unit, looking whenever a peer comes, goes or changes its list. Cancelling loses
    /// nothing.
    pub async fn wait_until(&self, mut done: impl FnMut(&Self) -> bool) {
        poll_fn(|cx| {
            if done(self) {
                return Poll::Ready(());
            }
            self.shared.machine.borrow_mut().wakers.news.register(cx.waker());
            Poll::Pending
        })
        .await;
    }

    // --- requests to the manager

    /// Calls a function of the manager and waits for its results; see [`Peer::block_request`] for what cancelling
    /// loses.
    #[doc(alias = "block_request_their_function")]
    pub async fn block_request(&self, function: &str, parameters: &mut ParametersView) -> Result<(), Error> {
        self.manager().ok_or(Error::NotConnected)?.block_request(function, parameters).await
    }

    /// Calls a function of the manager without waiting.
    #[doc(alias = "request_their_function")]
    pub fn request(&self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.manager().ok_or(Error::NotConnected)?.request(function, parameters)
    }

    // --- the unit itself

    /// Runs `act` with the application's state. [`Error::WouldDeadlock`] inside of a service that has it already.
    pub fn with_state<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        let mut state = self.shared.state.try_borrow_mut().map_err(|_| Error::WouldDeadlock)?;
        Ok(act(&mut state))
    }

    /// Runs `hook` each time a peer, such as the manager, is lost, once, before anything else is done about it. It must
    /// be short.
    pub fn on_manager_lost(&self, hook: &'static Hook<T>) {
        self.act(|machine| machine.lost_hook = Some(hook));
    }

    /// What no call returns: joined, left, failed. One task reads them; when it does not keep up, new ones are lost and
    /// counted in [`Self::events_lost`]. Cancelling loses nothing.
    pub async fn next_event(&self) -> UnitEvent {
        poll_fn(|cx| {
            let mut machine = self.shared.machine.borrow_mut();
            match machine.events.take() {
                Some(event) => Poll::Ready(event),
                None => {
                    machine.wakers.events.register(cx.waker());
                    Poll::Pending
                }
            }
        })
        .await
    }

    /// Events that were lost because they were not read in time.
    pub fn events_lost(&self) -> u32 {
        self.look(|machine| machine.events.lost)
    }

    /// The constraints in force.
    pub fn constraints(&self) -> Constraints {
        self.look(|machine| *machine.hub.node.constraints())
    }

    /// Changes the constraints; peers are told. [`Error::DoesNotFit`] for what the memory cannot hold.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.act(|machine| {
            machine.limits.fit(&constraints)?;
            machine.hub.node.set_constraints(constraints);
            machine.each_link(|session, cx| session.set_constraints(cx, constraints));
            Ok(())
        })
    }

    /// Another access table, or none: in force when this returns.
    pub fn set_access(&self, table: Option<&'static dyn Access>) {
        self.act(|machine| {
            machine.access = Table(table);
            machine.each_link(|session, cx| {
                session.access_changed(cx);
            });
        });
    }

    /// The keys of links that this unit opens from here on are made anew this often, instead of every 12 h, so that a test
    /// need not wait for so long.
    #[doc(hidden)]
    pub fn renew_keys_every(&self, span: Duration) {
        self.act(|machine| machine.renews_every = span);
    }

    /// What happened on all links, also on those that have ended.
    pub fn counted(&self, counter: LinkCounter) -> u64 {
        self.look(|machine| machine.counted(counter))
    }

    /// What happened in discovery and membership.
    pub fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.look(|machine| machine.hub.node.counters.value(counter))
    }

    /// Everything that is counted, in discovery and membership and on all links: (name, number), zeros included.
    pub fn counters(&self) -> impl Iterator<Item = (&'static str, u64)> + use<T> {
        let unit = *self;
        let node = NodeCounter::ALL.iter().map(move |counter| (counter.name(), unit.node_counted(*counter)));
        node.chain(LinkCounter::ALL.iter().map(move |counter| (counter.name(), unit.counted(*counter))))
    }

    /// The last refusals.
    pub fn findings(&self) -> impl Iterator<Item = Finding<SocketAddrV4>> + use<T> {
        let unit = *self;
        (0..).map_while(move |index| unit.look(|machine| machine.hub.node.findings().nth(index).cloned()))
    }
}
