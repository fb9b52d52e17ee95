//! One node is found among many that are connected.

use core::net::SocketAddr;

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::{
    Admission, Finding, Known, Node, NodeConfig, NodeStorage, Order, Target,
};
use cara_core::distribution::datagram::{Announce, SEARCH_BYTES, WhoHas};
use cara_core::distribution::hello::{Hello, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::host::secure::Plain;
use cara_core::storage::Lent;
use cara_core::time::{Duration, Instant};

use crate::{Meter, Of, Operation};

const FLEET: Fleet = Fleet(1);
const DEPOT: &str = "depot";
/// Rows beside those of the nodes that are connected.
const SPARE: usize = 4;

/// The memory of a node: a row for each of `NODES`, four of which stay free.
pub struct DiscoveryMemory<const NODES: usize> {
    nodes: [Option<Known>; NODES],
    order: [Order; NODES],
    links: [Option<u16>; NODES],
    findings: [Option<Finding>; 4],
}

impl<const NODES: usize> DiscoveryMemory<NODES> {
    /// Memory for one node.
    pub fn new() -> Self {
        Self {
            nodes: [const { None }; NODES],
            order: core::array::from_fn(|_| Order::default()),
            links: [None; NODES],
            findings: [const { None }; 4],
        }
    }
}

impl<const NODES: usize> Default for DiscoveryMemory<NODES> {
    fn default() -> Self {
        Self::new()
    }
}

/// Counts datagrams instead of sending them.
struct Outbox(u32);

impl Mailman for Outbox {
    fn write(&mut self, _: LinkId, _: &[&[u8]]) -> Result<usize, CloseReason> {
        Ok(0)
    }

    fn send_to(&mut self, _: SocketAddr, _: &[u8]) -> bool {
        self.0 += 1;
        true
    }

    fn broadcast(&mut self, _: &[u8]) -> bool {
        self.0 += 1;
        true
    }
}

/// A manager with many AGVs.
pub struct Discovery {
    node: Node<Lent>,
    now: Instant,
    link: LinkId,
    hello: Hello,
    sequence: u32,
}

impl Discovery {
    /// All rows but four are taken by nodes that have joined.
    pub fn new<const NODES: usize>(memory: &'static mut DiscoveryMemory<NODES>) -> Self {
        let config = NodeConfig {
            identity: Identity::m_unit(DEPOT, 1).expect("a name"),
            fleet: FLEET,
            epoch: Epoch(1),
            target: Target::Everybody,
            tcp_port: 7_000,
            udp_port: 7_001,
            constraints: Constraints { maximum_nodes: NODES as u16, ..Constraints::M_UNIT },
            seed: 1,
        };
        let storage = NodeStorage {
            nodes: memory.nodes.as_mut_slice(),
            order: memory.order.as_mut_slice(),
            links: memory.links.as_mut_slice(),
            findings: memory.findings.as_mut_slice(),
        };
        let mut node = Node::new(Instant::START, config, storage);
        let mut hello = node.hello(Instant::START, LinkId(0));
        hello.wanted = Manager::new(DEPOT, 1).ok();
        let connected = NODES - SPARE;
        for number in 0..connected as u16 {
            hello.identity = agv(u32::from(number));
            let admitted = node.admit(Instant::START, LinkId(number), address(&hello.identity), &hello);
            assert_eq!(admitted, Admission::Accept);
        }
        let mut discovery = Self { node, now: Instant::START, link: LinkId(connected as u16), hello, sequence: 0 };
        discovery.rest(&mut Outbox(0));
        discovery
    }

    /// Polls at each deadline of the next second.
    fn rest(&mut self, outbox: &mut Outbox) {
        let end = self.now + Duration::from_secs(1);
        while self.node.next_deadline() <= end {
            self.now = self.now.max(self.node.next_deadline());
            while self.node.poll(self.now, outbox, &Plain).is_some() {}
        }
        self.now = end;
    }

    /// The identity of a node that is not there, in the middle of those that are.
    fn newcomer(&mut self) -> Identity {
        self.sequence += 1;
        agv(500_000 + self.sequence)
    }

    /// An AGV asks for its manager, which answers.
    fn who_has(&mut self, meter: &mut dyn Meter) {
        let identity = self.newcomer();
        let from = address(&identity);
        let who_has = WhoHas {
            identity,
            epoch: Epoch(1),
            sequence: 1,
            nonce: 77,
            wanted: Manager::new(DEPOT, 1).ok(),
            tcp_port: 0,
            expected: 1,
            known: Default::default(),
        };
        let mut bytes = [0; SEARCH_BYTES];
        let length = who_has.encode(FLEET, &Plain, &mut bytes).expect("room for it").len();
        let mut outbox = Outbox(0);
        meter.count(&mut || {
            self.node.datagram(self.now, from, &mut bytes[..length], &Plain);
            self.now = self.now.max(self.node.next_deadline());
            while self.node.poll(self.now, &mut outbox, &Plain).is_some() {}
        });
        assert!(outbox.0 > 0, "the manager answers");
        self.rest(&mut outbox);
    }

    /// Another manager, with which this one is not connected, says that it is there.
    fn announce(&mut self, meter: &mut dyn Meter) {
        self.sequence += 1;
        let identity = Identity::m_unit("other", 500_000 + self.sequence).expect("a name");
        let from = address(&identity);
        // Nowhere to be dialled, so that nothing follows from it.
        let announce = Announce { identity, epoch: Epoch(1), sequence: 1, nonce: 0, tcp_port: 0, room: 8, expected: 8 };
        let mut bytes = [0; SEARCH_BYTES];
        let length = announce.encode(FLEET, &Plain, None, &mut bytes).expect("room for it").len();
        meter.count(&mut || {
            self.node.datagram(self.now, from, &mut bytes[..length], &Plain);
            while self.node.poll(self.now, &mut Outbox(0), &Plain).is_some() {}
        });
        self.rest(&mut Outbox(0));
    }

    /// An AGV has dialled and said who it is.
    fn joins(&mut self, meter: &mut dyn Meter) {
        let identity = self.newcomer();
        let (from, link) = (address(&identity), self.link);
        self.hello.identity = identity;
        let mut admitted = None;
        meter.count(&mut || admitted = Some(self.node.admit(self.now, link, from, &self.hello)));
        assert_eq!(admitted, Some(Admission::Accept));
        self.node.left(self.now, link, CloseReason::Stopped);
        self.rest(&mut Outbox(0));
    }

    /// What can be counted.
    pub fn operations(nodes: u32) -> [Operation<Self>; 3] {
        let of = Of::Nodes(nodes);
        [
            Operation { name: "discovery, a who-has is heard and answered", of, run: Self::who_has },
            Operation { name: "discovery, an announce is heard", of, run: Self::announce },
            Operation { name: "discovery, a node joins", of, run: Self::joins },
        ]
    }

    /// Rows that stay free.
    pub const SPARE: usize = SPARE;
}

fn agv(id: u32) -> Identity {
    Identity::s_unit("agv", id).expect("a name")
}

fn address(identity: &Identity) -> SocketAddr {
    let [_, b, c, d] = identity.id().to_be_bytes();
    SocketAddr::from(([10, b, c, d], 7_001))
}
