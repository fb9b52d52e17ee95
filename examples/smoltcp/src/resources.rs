//! All memory of a unit, in one value that goes into a `static`; change the numbers to suit the program.

use core::array::from_fn;
use core::net::SocketAddrV4;

use cara_core::config::{LINK_BUFFER_BYTES, PLAIN_PORT};
use cara_core::distribution::connection_handler::{Finding, Known, NodeStorage, Order};
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::parameters::Parameters;
use cara_core::services::RunningCall;
use cara_core::services::lease::{Lease, Service};
use cara_core::services::publications::{Publications, PublishedToOne};
use cara_core::services::requests::Pending;
use cara_core::services::session::{Publication, SessionStorage, buffer_bytes};
use cara_core::storage::{Lent, Pool};
use smoltcp::iface::SocketStorage;
use smoltcp::socket::udp;

use crate::unit::Smoltcp;

/// Datagrams, including broadcasts, arrive at this port and are sent from it: the host has no other user of it.
pub(crate) const DATAGRAM_PORT: u16 = PLAIN_PORT;
/// Longest block of arguments or results.
pub(crate) const MESSAGE_SIZE: usize = 1_024;
/// Calls that may wait or run here, and calls of this unit that may wait for a reply.
pub(crate) const CALLS: usize = 4;
/// What a TCP buffer holds; the smaller, the less stands in the way of an emergency.
const STREAM: usize = 2_048;
/// What the buffers for datagrams hold: two of the longest.
const DATAGRAM_BYTES: usize = 3_072;
/// Functions of this unit, and functions of the manager that are kept.
const FUNCTIONS: usize = 8;
/// Bytes of signatures for those.
const SIGNATURES: usize = 512;
/// Message buffers: one is received into, one waits to be written, one waits to be served, one is spare.
const MESSAGE_BUFFERS: usize = 4;
/// Nodes that are known: the manager, and one that it took the place of.
const NODES: usize = 2;

/// The handler that the core keeps of a function: only its lease, since the program serves.
pub(crate) struct Offered(pub(crate) Option<&'static Lease>);

impl Service for Offered {
    fn lease(&self) -> Option<&Lease> {
        self.0
    }
}

/// A buffer for arguments and results, names included.
pub(crate) type Arguments = Parameters<{ 2 * MESSAGE_SIZE }>;

/// What the sockets live in: received, then sent.
pub(crate) struct StackMemory {
    pub(crate) sockets: [SocketStorage<'static>; 2],
    pub(crate) stream: [[u8; STREAM]; 2],
    pub(crate) datagrams: [[u8; DATAGRAM_BYTES]; 2],
    pub(crate) datagram_heads: [[udp::PacketMetadata; 8]; 2],
}

/// The memory of one unit, which is lent to it for good.
pub struct Resources {
    stack: StackMemory,
    arguments: Arguments,
    results: Arguments,
    nodes: [Option<Known<SocketAddrV4>>; NODES],
    order: [Order; NODES],
    links: [Option<u16>; 1],
    findings: [Option<Finding<SocketAddrV4>>; 4],
    to_all: [bool; FUNCTIONS],
    to_one: [Option<PublishedToOne>; 0],
    functions: [Entry<Offered>; FUNCTIONS],
    signatures: [u8; SIGNATURES],
    small: [u8; LINK_BUFFER_BYTES],
    pending: [Option<Pending>; CALLS],
    running: [Option<RunningCall>; CALLS + 1],
    publications: [Publication; FUNCTIONS],
    their_functions: [Entry; FUNCTIONS],
    their_signatures: [u8; SIGNATURES],
    buffers: [[u8; buffer_bytes(MESSAGE_SIZE as u32, 0)]; MESSAGE_BUFFERS],
    pool: [Option<&'static mut [u8]>; MESSAGE_BUFFERS],
}

/// The slices of the resources in the shape in which the core takes them.
pub(crate) struct Parts {
    pub(crate) stack: &'static mut StackMemory,
    pub(crate) node: NodeStorage<Smoltcp>,
    pub(crate) publications: Publications<Lent>,
    pub(crate) link: SessionStorage<Lent>,
    pub(crate) functions: FunctionList<Lent, Offered>,
    pub(crate) buffers: Pool<Lent>,
    pub(crate) arguments: &'static mut Arguments,
    pub(crate) results: &'static mut Arguments,
}

impl Resources {
    /// Empty resources.
    pub fn new() -> Self {
        Self {
            stack: StackMemory {
                sockets: [SocketStorage::EMPTY; 2],
                stream: [[0; STREAM]; 2],
                datagrams: [[0; DATAGRAM_BYTES]; 2],
                datagram_heads: [[udp::PacketMetadata::EMPTY; 8]; 2],
            },
            arguments: Arguments::sized(),
            results: Arguments::sized(),
            nodes: [const { None }; NODES],
            order: from_fn(|_| Order::default()),
            links: [None; 1],
            findings: [const { None }; 4],
            to_all: [false; FUNCTIONS],
            to_one: [],
            functions: [const { Entry::empty() }; FUNCTIONS],
            signatures: [0; SIGNATURES],
            small: [0; LINK_BUFFER_BYTES],
            pending: [const { None }; CALLS],
            running: [const { None }; CALLS + 1],
            publications: from_fn(|_| Publication::default()),
            their_functions: [const { Entry::empty() }; FUNCTIONS],
            their_signatures: [0; SIGNATURES],
            buffers: [[0; buffer_bytes(MESSAGE_SIZE as u32, 0)]; MESSAGE_BUFFERS],
            pool: [const { None }; MESSAGE_BUFFERS],
        }
    }

    pub(crate) fn split(&'static mut self) -> Parts {
        for (place, buffer) in self.pool.iter_mut().zip(&mut self.buffers) {
            *place = Some(buffer);
        }
        Parts {
            stack: &mut self.stack,
            node: NodeStorage {
                nodes: &mut self.nodes[..],
                order: &mut self.order[..],
                links: &mut self.links[..],
                findings: &mut self.findings[..],
            },
            publications: Publications::new(&mut self.to_all[..], &mut self.to_one[..]),
            link: SessionStorage {
                small: &mut self.small[..],
                pending: &mut self.pending[..],
                running: &mut self.running[..],
                publications: &mut self.publications[..],
                their_functions: &mut self.their_functions[..],
                their_signatures: &mut self.their_signatures[..],
            },
            functions: FunctionList::new(&mut self.functions[..], &mut self.signatures[..]),
            buffers: Pool::new(&mut self.pool[..]),
            arguments: &mut self.arguments,
            results: &mut self.results,
        }
    }
}

/// What a board must have: the page says so.
#[cfg(target_pointer_width = "32")]
const _: () = assert!(size_of::<Resources>() <= 24 * 1024 && size_of::<crate::SUnit>() <= 6 * 1024 + 512);

impl Default for Resources {
    fn default() -> Self {
        Self::new()
    }
}
