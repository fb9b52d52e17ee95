//! The tables of a link: short ones when it opens, longer ones when its peer or this unit needs them, up to the
//! unit's capacities. A manager of a thousand nodes pays for what its nodes offer, not for the most that they could.

use cara_core::config::LINK_BUFFER_BYTES;
use cara_core::distribution::connection_handler::NodeStorage;
use cara_core::distribution::function_list::Entry;
use cara_core::error::Error;
use cara_core::services::session::SessionStorage;
use cara_core::services::slots_for;

use super::hub::SharedHub;
use super::link::{LinkState, Linux};
use super::links::Links;
use super::tape::OFFERS;
use crate::config::Capacities;
use crate::storage::{Boxed, filled, filled_with};
use crate::sys::limits;

/// Nodes that left and are remembered, beyond the most that may be connected.
const REMEMBERED_NODES: usize = 16;
/// Refusals that are remembered for the operator.
const FINDINGS: usize = 32;

/// Calls in flight to a peer, and of the peer, that a link begins with room for.
const FIRST_CALLS: usize = 4;
/// Functions of a peer that a link begins with room for.
const FIRST_FUNCTIONS: usize = 4;
/// Bytes of signatures of a peer that a link begins with room for.
const FIRST_SIGNATURES: usize = 512;

/// Slots for calls to begin with: at most [`FIRST_CALLS`], and so many that `most` is a multiple of them.
fn first_calls(most: usize) -> usize {
    (1..=FIRST_CALLS).rev().find(|slots| most.checked_rem(*slots) == Some(0)).unwrap_or(most).min(most)
}

/// The slices of a unit that may be connected to so many nodes, over so many links.
pub(crate) fn node_storage(nodes: usize, links: usize) -> NodeStorage<Linux> {
    NodeStorage {
        nodes: filled(nodes + REMEMBERED_NODES, None),
        order: filled_with(nodes + REMEMBERED_NODES, Default::default),
        links: filled(links, None),
        findings: filled(FINDINGS, None),
    }
}

/// The slices that a session begins with, where the unit's own list has so many functions.
pub(super) fn session_storage(capacities: &Capacities, functions: usize) -> SessionStorage<Boxed> {
    let &Capacities { calls_in_flight, calls_running, their_functions, their_signature_bytes, .. } = capacities;
    SessionStorage {
        small: filled(LINK_BUFFER_BYTES, 0),
        pending: filled(first_calls(calls_in_flight), None),
        running: filled(slots_for(calls_running.min(FIRST_CALLS)), None),
        publications: filled_with(functions, Default::default),
        their_functions: filled_with(their_functions.min(FIRST_FUNCTIONS), Entry::empty),
        their_signatures: filled(their_signature_bytes.min(FIRST_SIGNATURES), 0),
    }
}

impl Links {
    /// Longer tables where those of the node are too short for so many. [`Error::BadConstraint`] where the process may not have
    /// as many files open.
    pub(super) fn make_node_room(&self, hub: &SharedHub, nodes: u16) -> Result<(), Error> {
        let nodes = usize::from(nodes);
        let links = nodes + self.capacities.pending_links;
        if self.table().len() >= links {
            return Ok(());
        }
        if !limits::make_room_for(links) {
            return Err(Error::BadConstraint);
        }
        // The node first: it is to know every link that there can be.
        let longer = node_storage(nodes, links);
        hub.lock().hub.node.grow(longer.nodes, longer.order, longer.links);
        let mut cells = self.table_mut();
        let length = cells.len().max(links);
        cells.resize_with(length, || None);
        Ok(())
    }

    /// Makes room for as many calls of the peer as it may have here once more than one runs or waits, before the next one comes.
    pub(super) fn make_call_room(&self, state: &mut LinkState) {
        let most = slots_for(self.capacities.calls_running);
        let (slots, calls) = state.session.running_slots();
        if slots < most && calls > 1 {
            drop(state.session.lend_running(filled(most, None)));
        }
    }
}

/// Makes room for all functions of the unit's own list, which may be published next; whether there was too little.
pub(super) fn make_publication_room(state: &mut LinkState, functions: usize) -> bool {
    let grows = functions > state.session.publication_slots();
    if grows {
        drop(state.session.unrecorded(OFFERS).lend_publications(filled_with(functions, Default::default)));
    }
    grows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_begin_short_and_reach_their_capacity() {
        assert_eq!([64, 20, 7, 1, 0, 11].map(first_calls), [4, 4, 1, 1, 0, 1]);
    }
}
