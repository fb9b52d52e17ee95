//! A node as this unit sees it.

use core::fmt;
use core::net::SocketAddrV4;

use cara_core::distribution::identity::{Epoch, Identity};
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;

use crate::handle::Handle;
use crate::machine::LinkSession;

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
