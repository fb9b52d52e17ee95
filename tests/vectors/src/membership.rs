//! What decides whether a unit takes a peer.

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::{Node, NodeConfig, NodeStorage, Order, Target};
use cara_core::distribution::hello::Hello;
use cara_core::services::hub::Hub;
use cara_core::services::publications::Publications;
use cara_core::time::Instant;

use crate::side::Vectors;

/// The hub of the unit that `own` introduces, which takes `maximum` peers.
pub(crate) fn hub(own: &Hello, constraints: Constraints, maximum: u16) -> Hub<Vectors> {
    let config = NodeConfig {
        identity: own.identity.clone(),
        fleet: own.fleet,
        epoch: own.epoch,
        target: own.wanted.clone().map_or(Target::Everybody, Target::Manager),
        tcp_port: 0,
        udp_port: own.udp_port,
        constraints: Constraints { maximum_nodes: maximum, ..constraints },
        seed: 1,
    };
    let storage = NodeStorage {
        nodes: vec![None; 4].into(),
        order: vec![Order::default(); 4].into(),
        links: vec![None; 512].into(),
        findings: vec![None; 4].into(),
    };
    let publications = Publications::new(vec![false; 8].into(), vec![None; 1].into());
    Hub { node: Node::new(Instant::START, config, storage), publications }
}
