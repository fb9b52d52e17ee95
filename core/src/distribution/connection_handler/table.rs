//! The table of nodes: lent slots, an index by identity, one entry per link, and stable indices.
//!
//! Each event costs one binary search at most. Only a new node moves two bytes for each entry behind it in the sorted index.

use super::known::{Known, NodeState};
use crate::distribution::identity::{Epoch, Identity, Role};
use crate::host::endpoint::Endpoint as _;
use crate::host::mailman::LinkId;
use crate::host::port::{Port, Slice};

/// No slot, position or index.
pub(super) const NONE: u16 = u16::MAX;

/// Capacity for nodes that were heard of and have never joined: the oldest gives way to the next. However many names an
/// attacker makes up, they displace at most this many disconnected nodes from a full table.
pub(super) const UNJOINED: usize = 8;

/// One row of the table's indexes, as slot numbers; ports allocate a slice of default ones. A row does not belong to one node.
#[derive(Clone, Copy, Debug)]
pub struct Order {
    /// Slots, sorted by identity.
    sorted: u16,
    /// Slots, as a heap by next deadline.
    pub(super) due: u16,
    /// Slots of the s_units, by their stable index.
    s_unit: u16,
    /// Slots of the m_units, by their stable index.
    m_unit: u16,
}

impl Default for Order {
    fn default() -> Self {
        Self { sorted: NONE, due: NONE, s_unit: NONE, m_unit: NONE }
    }
}

impl Order {
    const fn of(&self, role: Role) -> u16 {
        match role {
            Role::SUnit => self.s_unit,
            Role::MUnit => self.m_unit,
        }
    }

    const fn of_mut(&mut self, role: Role) -> &mut u16 {
        match role {
            Role::SUnit => &mut self.s_unit,
            Role::MUnit => &mut self.m_unit,
        }
    }
}

pub(super) struct Table<P: Port> {
    nodes: Slice<P, Option<Known<P::Endpoint>>>,
    pub(super) order: Slice<P, Order>,
    links: Slice<P, Option<u16>>,
    len: usize,
    pub(super) due_len: usize,
    s_units: u16,
    m_units: u16,
    /// The nodes that left first and last of those that are away: the ends of a linked list.
    oldest: u16,
    youngest: u16,
    /// Slots of nodes that were heard of and have not joined, in the order in which they were heard of.
    unjoined: heapless::Vec<u16, UNJOINED>,
}

impl<P: Port> Table<P> {
    pub(super) fn new(
        nodes: Slice<P, Option<Known<P::Endpoint>>>,
        order: Slice<P, Order>,
        links: Slice<P, Option<u16>>,
    ) -> Self {
        Self {
            nodes,
            order,
            links,
            len: 0,
            due_len: 0,
            s_units: 0,
            m_units: 0,
            oldest: NONE,
            youngest: NONE,
            unjoined: heapless::Vec::new(),
        }
    }

    /// Moves to longer slices; does nothing if one is shorter. Slots, indexes and orders are unchanged.
    pub(super) fn grow(
        &mut self,
        mut nodes: Slice<P, Option<Known<P::Endpoint>>>,
        mut order: Slice<P, Order>,
        mut links: Slice<P, Option<u16>>,
    ) {
        if nodes.len() < self.nodes.len() || order.len() < self.order.len() || links.len() < self.links.len() {
            return;
        }
        nodes.iter_mut().zip(self.nodes.iter_mut()).for_each(|(new, old)| *new = old.take());
        order.iter_mut().zip(self.order.iter()).for_each(|(new, old)| *new = *old);
        links.iter_mut().zip(self.links.iter()).for_each(|(new, old)| *new = *old);
        (self.nodes, self.order, self.links) = (nodes, order, links);
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.nodes.iter().flatten()
    }

    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn node(&self, place: usize) -> Option<&Known<P::Endpoint>> {
        self.nodes.get(place)?.as_ref()
    }

    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn node_mut(&mut self, place: usize) -> Option<&mut Known<P::Endpoint>> {
        self.nodes.get_mut(place)?.as_mut()
    }

    /// How many nodes are connected.
    pub(super) const fn joined(&self) -> u16 {
        self.s_units.saturating_add(self.m_units)
    }

    /// How many nodes of one role are connected.
    pub(super) const fn joined_as(&self, role: Role) -> u16 {
        match role {
            Role::SUnit => self.s_units,
            Role::MUnit => self.m_units,
        }
    }

    /// The nodes of one role that have joined, by their stable index.
    pub(super) fn by_index(&self, role: Role) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.order.iter().take(self.len).filter_map(move |row| self.node(usize::from(row.of(role))))
    }

    pub(super) fn at_index(&self, role: Role, index: u16) -> Option<&Known<P::Endpoint>> {
        self.node(usize::from(self.order.get(usize::from(index))?.of(role)))
    }

    /// The first node with this id; connected ones precede others.
    pub(super) fn with_id(&self, id: u32) -> Option<&Known<P::Endpoint>> {
        let sorted = self.order.get(..self.len)?;
        let place = |row: &Order| self.node(usize::from(row.sorted));
        let start = sorted.partition_point(|row| place(row).is_some_and(|known| known.identity.id() < id));
        let mut same = sorted.get(start..)?.iter().filter_map(place).take_while(|known| known.identity.id() == id);
        let first = same.next()?;
        if first.is_joined() { Some(first) } else { same.find(|known| known.is_joined()).or(Some(first)) }
    }

    pub(super) fn of_host(&self, address: P::Endpoint) -> impl Iterator<Item = &Known<P::Endpoint>> {
        self.iter().filter(move |known| known.address.is_of_host(&address))
    }

    pub(super) fn of_link(&self, link: LinkId) -> Option<usize> {
        self.links.get(usize::from(link.0)).copied().flatten().map(usize::from)
    }

    /// Records which node a link belongs to.
    pub(super) fn set_link(&mut self, link: LinkId, place: Option<usize>) {
        if let Some(slot) = self.links.get_mut(usize::from(link.0)) {
            *slot = place.and_then(|place| u16::try_from(place).ok());
        }
    }

    pub(super) fn find(&self, identity: &Identity) -> Option<usize> {
        let at = self.search(identity).ok()?;
        self.order.get(at).map(|row| usize::from(row.sorted))
    }

    fn search(&self, identity: &Identity) -> Result<usize, usize> {
        let sorted = self.order.get(..self.len).unwrap_or(&[]);
        sorted.binary_search_by(|row| match self.node(usize::from(row.sorted)) {
            Some(known) => known.identity.cmp(identity),
            None => core::cmp::Ordering::Less,
        })
    }

    /// The slot of a node that was heard of, a new one if it is unknown; `true` if another node was forgotten for it. `None` if
    /// there is no capacity for another unjoined node.
    pub(super) fn hear_of(&mut self, identity: &Identity, address: P::Endpoint, epoch: Epoch) -> Option<(usize, bool)> {
        if let Some(place) = self.find(identity) {
            return Some((place, false));
        }
        let (place, forgotten) = if self.unjoined.is_full() {
            let idle = self.idle_unjoined()?;
            self.forget(idle)?;
            (self.settle(idle, identity, address, epoch)?, true)
        } else {
            self.place_of(identity, address, epoch)?
        };
        let _ = self.unjoined.push(u16::try_from(place).ok()?);
        Some((place, forgotten))
    }

    /// The first unjoined node that is not being dialled.
    fn idle_unjoined(&self) -> Option<usize> {
        let away = |place: &usize| self.node(*place).is_some_and(|known| known.state == NodeState::Away);
        self.unjoined.iter().copied().map(usize::from).find(away)
    }

    /// The slot of an identity, a new one if it is unknown; `true` if an unjoined node, or else the one that was away longest,
    /// was forgotten for it. `None` if every slot has a node that is connected or being dialled.
    pub(super) fn place_of(
        &mut self,
        identity: &Identity,
        address: P::Endpoint,
        epoch: Epoch,
    ) -> Option<(usize, bool)> {
        if let Some(place) = self.find(identity) {
            return Some((place, false));
        }
        let capacity = self.nodes.len().min(self.order.len()).min(usize::from(NONE));
        let (place, forgotten) = if self.len < capacity {
            (self.len, false)
        } else {
            let oldest = self.idle_unjoined().unwrap_or(usize::from(self.oldest));
            self.forget(oldest)?;
            (oldest, true)
        };
        Some((self.settle(place, identity, address, epoch)?, forgotten))
    }

    /// Puts a new node into a free slot.
    fn settle(&mut self, place: usize, identity: &Identity, address: P::Endpoint, epoch: Epoch) -> Option<usize> {
        let at = self.search(identity).err()?;
        let mut carried = u16::try_from(place).ok()?;
        for row in self.order.get_mut(at..=self.len)? {
            core::mem::swap(&mut row.sorted, &mut carried);
        }
        *self.nodes.get_mut(place)? = Some(Known::new(identity.clone(), address, epoch));
        self.len = self.len.saturating_add(1);
        self.begin_rest(place);
        Some(place)
    }

    /// Frees the slot of a node that is away.
    fn forget(&mut self, place: usize) -> Option<()> {
        let at = self.search(&self.node(place)?.identity).ok()?;
        self.cancel(place);
        self.end_rest(place);
        self.unjoined.retain(|unjoined| usize::from(*unjoined) != place);
        let mut carried = NONE;
        for row in self.order.get_mut(at..self.len)?.iter_mut().rev() {
            core::mem::swap(&mut row.sorted, &mut carried);
        }
        let known = self.nodes.get_mut(place)?.take()?;
        if let Some(row) = self.order.get_mut(usize::from(known.index)) {
            *row.of_mut(known.identity.role()) = NONE;
        }
        self.len = self.len.saturating_sub(1);
        Some(())
    }

    /// Changes a node's state, and updates the counts and whether the node may be forgotten.
    pub(super) fn set_state(&mut self, place: usize, state: NodeState) {
        let Some(known) = self.node_mut(place) else { return };
        let role = known.identity.role();
        let before = core::mem::replace(&mut known.state, state);
        let count = match role {
            Role::SUnit => &mut self.s_units,
            Role::MUnit => &mut self.m_units,
        };
        match (matches!(before, NodeState::Joined(_)), matches!(state, NodeState::Joined(_))) {
            (false, true) => *count = count.saturating_add(1),
            (true, false) => *count = count.saturating_sub(1),
            _ => {}
        }
        match (before == NodeState::Away, state == NodeState::Away) {
            (true, false) => self.end_rest(place),
            (false, true) => self.begin_rest(place),
            _ => {}
        }
    }

    /// Gives a node that joins for the first time the lowest free index of its role, which it then keeps.
    pub(super) fn keep_index(&mut self, place: usize) {
        self.unjoined.retain(|unjoined| usize::from(*unjoined) != place);
        let Some(known) = self.node(place).filter(|known| known.index == NONE) else { return };
        let role = known.identity.role();
        let free = self.order.iter().position(|row| row.of(role) == NONE);
        let Some((index, row)) = free.and_then(|index| Some((index, self.order.get_mut(index)?))) else { return };
        *row.of_mut(role) = u16::try_from(place).unwrap_or(NONE);
        if let Some(known) = self.node_mut(place) {
            known.index = u16::try_from(index).unwrap_or(NONE);
        }
    }

    /// Appends a node to the list of those that are away.
    fn begin_rest(&mut self, place: usize) {
        let before = self.youngest;
        self.youngest = u16::try_from(place).unwrap_or(NONE);
        if let Some(known) = self.node_mut(place) {
            (known.before, known.after) = (before, NONE);
        }
        match self.nodes.get_mut(usize::from(before)) {
            Some(Some(known)) => known.after = self.youngest,
            _ => self.oldest = self.youngest,
        }
    }

    /// Removes a node from the list of those that are away.
    fn end_rest(&mut self, place: usize) {
        let Some(known) = self.node_mut(place) else { return };
        let before = core::mem::replace(&mut known.before, NONE);
        let after = core::mem::replace(&mut known.after, NONE);
        match self.nodes.get_mut(usize::from(before)) {
            Some(Some(known)) => known.after = after,
            _ => self.oldest = after,
        }
        match self.nodes.get_mut(usize::from(after)) {
            Some(Some(known)) => known.before = before,
            _ => self.youngest = before,
        }
    }
}
