//! A unit's hub on the heap, for tests that drive sessions themselves.

use cara_core::distribution::connection_handler::{Node, NodeConfig, NodeStorage};
use cara_core::services::Port;
use cara_core::services::hub::Hub;
use cara_core::services::publications::Publications;
use cara_core::time::Instant;

use crate::storage::Boxed;

/// The hub of a unit that may have so many links and functions, and knows twice as many nodes as it has links.
pub fn hub<P>(now: Instant, config: NodeConfig<P::Endpoint>, links: usize, functions: usize) -> Hub<P>
where
    P: Port<Storage = Boxed>,
{
    let nodes = 2 * links;
    let storage = NodeStorage {
        nodes: Boxed::slice(nodes),
        order: Boxed::slice(nodes),
        links: Boxed::slice(links),
        findings: Boxed::slice(8),
    };
    let publications = Publications::new(Boxed::slice(functions), Boxed::slice(4 * functions));
    Hub { node: Node::new(now, config, storage), publications }
}
