//! The registry: nodes by place, name, id, address and link (paper, section 2).

use super::{Known, Node};
use crate::distribution::identity::{Identity, Role};
use crate::error::Error;
use crate::host::mailman::LinkId;
use crate::host::port::Port;

impl<P: Port> Node<P> {
    /// All known nodes, in the order in which they were first heard of, unless some were forgotten.
    pub fn nodes(&self) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.table.iter()
    }

    /// The s_units that have joined, including those that have left, in the order of joining (paper, listing line 8). The index
    /// of each is its [`Known::index`].
    pub fn s_units(&self) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.table.by_index(Role::SUnit)
    }

    /// The m_units that have joined, including those that have left, in the order of joining.
    pub fn m_units(&self) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.table.by_index(Role::MUnit)
    }

    /// The s_unit with this stable index.
    pub fn s_unit(&self, index: u16) -> Option<&Known<P::Endpoint>> {
        self.table.at_index(Role::SUnit, index)
    }

    /// The m_unit with this stable index.
    pub fn m_unit(&self, index: u16) -> Option<&Known<P::Endpoint>> {
        self.table.at_index(Role::MUnit, index)
    }

    /// The node with this identity.
    pub fn node(&self, identity: &Identity) -> Option<&Known<P::Endpoint>> {
        self.table.find(identity).and_then(|place| self.table.node(place))
    }

    /// The node with this name among those that have joined, connected or not. [`Error::NotConnected`] if there is none,
    /// [`Error::Ambiguous`] if there are several: the connected one may not be the one that is meant.
    pub fn find(&self, name: &str) -> Result<&Known<P::Endpoint>, Error> {
        let mut same = self.s_units().chain(self.m_units()).filter(|known| known.identity.name() == name);
        let first = same.next().ok_or(Error::NotConnected)?;
        match same.next() {
            None => Ok(first),
            Some(second) => Err(Error::Ambiguous { ids: [first.identity.id(), second.identity.id()] }),
        }
    }

    /// The first node with this id; connected ones precede others.
    pub fn find_id(&self, id: u32) -> Option<&Known<P::Endpoint>> {
        self.table.with_id(id)
    }

    /// The nodes on the host of an address.
    pub fn find_address(&self, address: P::Endpoint) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.table.of_host(address)
    }

    /// The node at the other end of a link.
    pub fn node_of(&self, link: LinkId) -> Option<&Known<P::Endpoint>> {
        let known = self.table.of_link(link).and_then(|place| self.table.node(place))?;
        (known.link() == Some(link) || known.dialing == Some(link)).then_some(known)
    }

    /// How many nodes are connected.
    pub const fn connected(&self) -> usize {
        self.table.joined() as usize
    }

    /// How many s_units are connected (paper, listing line 4).
    pub const fn number_of_s_units(&self) -> usize {
        self.table.joined_as(Role::SUnit) as usize
    }

    /// How many m_units are connected.
    pub const fn number_of_m_units(&self) -> usize {
        self.table.joined_as(Role::MUnit) as usize
    }
}
