//! A node as this unit sees it.

use core::fmt;
use core::net::SocketAddrV4;

use cara_core::distribution::identity::{Epoch, Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::requests::CallId;

use crate::handle::Handle;
use crate::port::LinkSession;

/// A node, connected or not. Stays valid when the node leaves, and works again when it comes back.
pub struct Peer<T: 'static = ()> {
    pub(crate) unit: Handle<T>,
    pub(crate) identity: Identity,
}

impl<T> Clone for Peer<T> {
    fn clone(&self) -> Self {
        Self { unit: self.unit, identity: self.identity.clone() }
    }
}

impl<T> fmt::Debug for Peer<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.identity)
    }
}

impl<T> Handle<T> {
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

    /// The connected nodes, in the order of their links.
    pub fn peers(&self) -> impl Iterator<Item = Peer<T>> + use<T> {
        let unit = *self;
        (0..self.links()).filter_map(move |link| unit.peer_at(link))
    }

    /// The connected nodes that offer a function to this unit.
    pub fn nodes_offering<'n>(&self, function: &'n str) -> impl Iterator<Item = Peer<T>> + use<'n, T> {
        self.peers().filter(move |peer| peer.their_function_list().contains(function))
    }

    /// How many s_units are connected and have published their lists (paper, listing line 4).
    pub fn number_of_s_units(&self) -> usize {
        self.number_of(Role::SUnit)
    }

    /// How many m_units are connected and have published their lists.
    pub fn number_of_m_units(&self) -> usize {
        self.number_of(Role::MUnit)
    }

    fn number_of(&self, role: Role) -> usize {
        let is_listed = |peer: &Peer<T>| peer.session(LinkSession::is_listed).unwrap_or(false);
        self.peers().filter(|peer| peer.identity().role() == role && is_listed(peer)).count()
    }

    /// Whether any node, such as the manager, is connected.
    pub fn is_connected(&self) -> bool {
        self.peers().next().is_some()
    }

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
}

impl<T> Peer<T> {
    /// Its name, id and role.
    pub const fn identity(&self) -> &Identity {
        &self.identity
    }

    pub(crate) fn link(&self) -> Result<u16, Error> {
        self.unit.look(|machine| machine.link_to(&self.identity)).ok_or(Error::NotConnected)
    }

    pub(crate) fn session<R>(&self, look: impl FnOnce(&LinkSession) -> R) -> Option<R> {
        self.unit.look(|machine| {
            let index = machine.link_to(&self.identity)?;
            machine.link(index)?.session.as_ref().map(look)
        })
    }

    /// Whether it is connected now.
    pub fn is_connected(&self) -> bool {
        self.link().is_ok()
    }

    /// The other end of its link, while it is connected.
    pub fn address(&self) -> Option<SocketAddrV4> {
        self.session(LinkSession::address)
    }

    /// Which of its runs is connected: it differs after each start of the node.
    pub fn epoch(&self) -> Option<Epoch> {
        self.session(LinkSession::epoch).flatten()
    }

    /// What the node has published to this unit; empty while it is not connected.
    pub const fn their_function_list(&self) -> TheirFunctionList<'_, T> {
        TheirFunctionList { peer: self }
    }

    /// Waits until the node has published `function`. Cancelling loses nothing.
    pub async fn wait_for_function(&self, function: &str) {
        self.unit.wait_until(|_| self.their_function_list().contains(function)).await;
    }

    /// Gives up the leases that calls of `function` have begun or will begin: what they started stops, and what has not
    /// begun does not begin.
    pub fn release(&self, function: &str) -> Result<(), Error> {
        let link = self.link()?;
        let released = self.unit.act(|machine| {
            machine.with(link, |session, cx| {
                let slot = session.their_function_list().find(function).ok_or(Error::UnknownFunction)?;
                session.release(cx, slot)
            })
        });
        released.unwrap_or(Err(Error::NotConnected))
    }

    /// Sends one-way messages that gather now.
    pub fn flush(&self) -> Result<(), Error> {
        let link = self.link()?;
        self.unit.act(|machine| machine.with(link, |session, cx| session.flush_gathered(cx)));
        Ok(())
    }

    /// Makes the unit's functions visible to this node only (paper, listing line 23); survives its reconnection.
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.unit.act(|machine| machine.publish_to(&self.identity)).map(drop)
    }

    /// What happened on its link; nothing while it is not connected.
    pub fn counted(&self, counter: LinkCounter) -> u64 {
        self.session(|session| session.counters().value(counter)).unwrap_or(0)
    }
}

/// The functions that a node has published to this unit, looked at now.
pub struct TheirFunctionList<'p, T: 'static> {
    peer: &'p Peer<T>,
}

impl<T> fmt::Debug for TheirFunctionList<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TheirFunctionList").field("peer", &self.peer).finish_non_exhaustive()
    }
}

impl<T> TheirFunctionList<'_, T> {
    /// One line per function (paper, listing line 10).
    pub fn show_functions(&self) -> impl fmt::Display + '_ {
        self
    }

    /// Whether a function is among them.
    pub fn contains(&self, name: &str) -> bool {
        self.peer.session(|session| session.their_function_list().find(name).is_some()).unwrap_or(false)
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.peer.session(|session| session.their_function_list().len()).unwrap_or(0)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Functions that the node published and for which there is no room here.
    pub fn skipped(&self) -> u32 {
        self.peer.session(|session| session.their_function_list().skipped()).unwrap_or(0)
    }
}

impl<T> fmt::Display for TheirFunctionList<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown = self.peer.session(|session| write!(f, "{}", session.their_function_list().show_functions()));
        shown.unwrap_or(Ok(()))
    }
}
