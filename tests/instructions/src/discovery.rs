//! One node is found among many that are connected.

use core::net::{Ipv4Addr, SocketAddrV4};

use cara_core::config::{Constraints, LINK_BUFFER_BYTES, Mode};
use cara_core::distribution::connection_handler::{Finding, Known, Node, NodeConfig, NodeStorage, Order, Target};
use cara_core::distribution::datagram::{Announce, SEARCH_BYTES, WhoHas};
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::hello::{Hello, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::error::CloseReason;
use cara_core::host::frame::{self, Frame};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::host::secure::Plain;
use cara_core::services::hub::Hub;
use cara_core::services::publications::{Publications, PublishedToOne};
use cara_core::services::requests::Pending;
use cara_core::services::session::{Event, Publication, Session, SessionConfig, SessionStorage};
use cara_core::services::{Context, RunningCall};
use cara_core::storage::{Buffer, Lent, Pool};
use cara_core::time::{Duration, Instant};

use crate::pair::{Bench, Nothing};
use crate::{Meter, Of, Operation, Uncounted};

const FLEET: Fleet = Fleet(1);
const DEPOT: &str = "depot";
/// Rows beside those of the nodes that are connected.
const SPARE: usize = 4;

/// The memory of a node: a row for each of `NODES`, four of which stay free.
pub struct DiscoveryMemory<const NODES: usize> {
    nodes: [Option<Known<SocketAddrV4>>; NODES],
    order: [Order; NODES],
    links: [Option<u16>; NODES],
    findings: [Option<Finding<SocketAddrV4>>; 4],
    to_all: [bool; 1],
    to_one: [Option<PublishedToOne>; 1],
    functions: [Entry<Nothing>; 1],
    signatures: [u8; 8],
    pool: [Option<Buffer<Lent>>; 1],
    small: [u8; LINK_BUFFER_BYTES],
    pending: [Option<Pending>; 1],
    running: [Option<RunningCall>; 2],
    publications: [Publication; 1],
    their_functions: [Entry; 1],
    their_signatures: [u8; 8],
}

impl<const NODES: usize> DiscoveryMemory<NODES> {
    /// Memory for one node.
    pub fn new() -> Self {
        Self {
            nodes: [const { None }; NODES],
            order: core::array::from_fn(|_| Order::default()),
            links: [None; NODES],
            findings: [const { None }; 4],
            to_all: [false; 1],
            to_one: [const { None }; 1],
            functions: [const { Entry::empty() }; 1],
            signatures: [0; 8],
            pool: [const { None }; 1],
            small: [0; LINK_BUFFER_BYTES],
            pending: [const { None }; 1],
            running: [const { None }; 2],
            publications: [Publication::default(); 1],
            their_functions: [const { Entry::empty() }; 1],
            their_signatures: [0; 8],
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

impl Mailman<SocketAddrV4> for Outbox {
    fn write(&mut self, _: LinkId, _: &[&[u8]]) -> Result<usize, CloseReason> {
        Ok(0)
    }

    fn send_to(&mut self, _: SocketAddrV4, _: &[u8]) -> bool {
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
    hub: Hub<Bench>,
    functions: FunctionList<Lent, Nothing>,
    pool: Pool<Lent>,
    /// What the session of the next newcomer lives in.
    spare: Option<SessionStorage<Lent>>,
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
        let publications = Publications::new(memory.to_all.as_mut_slice(), memory.to_one.as_mut_slice());
        let hub = Hub { node: Node::new(Instant::START, config, storage), publications };
        let mut hello = hub.node.hello(Instant::START, LinkId(0), 1);
        hello.wanted = Manager::new(DEPOT, 1).ok();
        let connected = (NODES - SPARE) as u16;
        let spare = SessionStorage {
            small: memory.small.as_mut_slice(),
            pending: memory.pending.as_mut_slice(),
            running: memory.running.as_mut_slice(),
            publications: memory.publications.as_mut_slice(),
            their_functions: memory.their_functions.as_mut_slice(),
            their_signatures: memory.their_signatures.as_mut_slice(),
        };
        let mut discovery = Self {
            hub,
            functions: FunctionList::new(memory.functions.as_mut_slice(), memory.signatures.as_mut_slice()),
            pool: Pool::new(memory.pool.as_mut_slice()),
            spare: Some(spare),
            now: Instant::START,
            link: LinkId(connected),
            hello,
            sequence: 0,
        };
        for number in 0..connected {
            discovery.introduce(LinkId(number), agv(u32::from(number)), &mut Uncounted);
        }
        discovery.rest(&mut Outbox(0));
        discovery
    }

    /// Polls at each deadline of the next second.
    fn rest(&mut self, outbox: &mut Outbox) {
        let end = self.now + Duration::from_secs(1);
        while self.hub.node.next_deadline() <= end {
            self.now = self.now.max(self.hub.node.next_deadline());
            while self.hub.node.poll(self.now, outbox, &Plain).is_some() {}
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
            standby: false,
            skipped: 0,
        };
        let mut bytes = [0; SEARCH_BYTES];
        let length = who_has.encode(FLEET, &Plain, &mut bytes).expect("room for it").len();
        let mut outbox = Outbox(0);
        meter.count(&mut || {
            self.hub.node.datagram(self.now, from, &bytes[..length], &Plain);
            self.now = self.now.max(self.hub.node.next_deadline());
            while self.hub.node.poll(self.now, &mut outbox, &Plain).is_some() {}
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
        let announce = Announce {
            identity,
            epoch: Epoch(1),
            claim: None,
            obeyed: None,
            sequence: 1,
            nonce: 0,
            tcp_port: 0,
            room: 8,
            expected: 8,
            skipped: 0,
        };
        let mut bytes = [0; SEARCH_BYTES];
        let length = announce.encode(FLEET, &Plain, None, &mut bytes).expect("room for it").len();
        meter.count(&mut || {
            self.hub.node.datagram(self.now, from, &bytes[..length], &Plain);
            while self.hub.node.poll(self.now, &mut Outbox(0), &Plain).is_some() {}
        });
        self.rest(&mut Outbox(0));
    }

    /// An AGV has dialled, sends its hello, and is accepted.
    fn introduce(&mut self, link: LinkId, identity: Identity, meter: &mut dyn Meter) {
        let address = address(&identity);
        self.hello.identity = identity;
        let (mut hello, mut bytes) = ([0; 320], [0; 324]);
        let length = self.hello.encode(Mode::Plain, &mut hello).expect("room for it");
        let length = frame::encode(&Frame::Hello(&hello[..length]), 0, &mut bytes);
        let (nonce, constraints) = (self.hub.node.nonce(), *self.hub.node.constraints());
        let config = SessionConfig { link, dialed: false, address, nonce, constraints };
        let mut session: Session<Bench> =
            Session::new(self.now, config, Plain, self.spare.take().expect("it was given back"));
        let mut cx = Context {
            now: self.now,
            mailman: &mut Outbox(0),
            buffers: &mut self.pool,
            functions: &self.functions,
            access: None,
            hub: &mut self.hub,
            keys: &mut (),
        };
        let mut has_joined = false;
        meter.count(&mut || {
            let receipt = session.receive(&mut cx, &mut bytes[..length], None);
            has_joined = matches!(receipt.event, Some(Event::Joined));
        });
        assert!(has_joined);
        self.spare = Some(session.into_storage(&mut self.pool));
    }

    fn joins(&mut self, meter: &mut dyn Meter) {
        let identity = self.newcomer();
        self.introduce(self.link, identity, meter);
        self.hub.node.left(self.now, self.link, CloseReason::Stopped);
        self.rest(&mut Outbox(0));
    }

    /// What can be counted.
    pub fn operations(nodes: u32) -> [Operation<Self>; 3] {
        let of = Of::Nodes(nodes);
        [
            Operation { name: "discovery, a who-has is heard and answered", of, run: Self::who_has },
            Operation { name: "discovery, an announce is heard", of, run: Self::announce },
            Operation { name: "discovery, a node says who it is and joins", of, run: Self::joins },
        ]
    }

    /// Rows that stay free.
    pub const SPARE: usize = SPARE;
}

fn agv(id: u32) -> Identity {
    Identity::s_unit("agv", id).expect("a name")
}

fn address(identity: &Identity) -> SocketAddrV4 {
    let [_, b, c, d] = identity.id().to_be_bytes();
    SocketAddrV4::new(Ipv4Addr::new(10, b, c, d), 7_001)
}
