//! Whether a unit takes a peer, as the core's node decides it.

use core::net::SocketAddr;

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::{Admission, Node, NodeConfig, NodeStorage, Order, Target};
use cara_core::distribution::hello::Hello;
use cara_core::error::Refusal;
use cara_core::host::mailman::LinkId;
use cara_core::time::Instant;

use crate::stream::Boxed;

/// The node of the unit that `own` introduces, which takes `maximum` peers.
pub(crate) fn node(own: &Hello, maximum: u16) -> Node<Boxed> {
    let config = NodeConfig {
        identity: own.identity.clone(),
        fleet: own.fleet,
        epoch: own.epoch,
        target: own.wanted.clone().map_or(Target::Everybody, Target::Manager),
        tcp_port: 0,
        udp_port: own.udp_port,
        constraints: Constraints { maximum_nodes: maximum, ..Constraints::M_UNIT },
        seed: 1,
    };
    let storage = NodeStorage {
        nodes: vec![None; 4].into(),
        order: vec![Order::default(); 4].into(),
        links: vec![None; 512].into(),
        findings: vec![None; 4].into(),
    };
    Node::new(Instant::START, config, storage)
}

/// What the node says to the first hello of all.
pub(crate) fn decide(node: &mut Node<Boxed>, link: u16, peer: &Hello) -> Result<(), Refusal> {
    let from = SocketAddr::from(([192, 0, 2, 1], 50_000));
    match node.admit(Instant::START, LinkId(link), from, peer) {
        Admission::Accept => Ok(()),
        Admission::Refuse(refusal) => Err(refusal),
        Admission::Challenge { .. } => Err(Refusal::DuplicateIdentity),
    }
}
