//! The memory of a unit: all of it, sized when compiling, lent for ever.

use core::cell::RefCell;
use core::mem::MaybeUninit;

use cara_core::config::{HANDSHAKE_LIFE, LINK_BUFFER_BYTES, Mode};
use cara_core::counters::Counters;
use cara_core::distribution::connection_handler::{Finding, Known, Node, NodeConfig, NodeStorage, Order};
use cara_core::distribution::datagram::SEARCH_BYTES;
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::identity::{Epoch, Role};
use cara_core::distribution::parameters::Parameters;
use cara_core::error::Error;
use cara_core::services::CallHead;
use cara_core::services::hub::Hub;
use cara_core::services::publications::{Publications, PublishedToOne};
use cara_core::services::requests::Pending;
use cara_core::services::unit::{Publication, SessionStorage};
use cara_core::storage::Pool;
use cara_core::time::Instant;
use embassy_net::Stack;
use embassy_net::udp::{PacketMetadata, UdpSocket};

use crate::config::{Config, check, message_buffer};
use crate::driving::Begun;
use crate::event::{Events, UnitEvent};
use crate::handle::Handle;
use crate::handler::Listed;
use crate::line::Line;
use crate::machine::{Link, Machine, Room, Shared, Wakers};
use crate::mail::EmbassyMailman;
use crate::replies::{ReplyBox, Waiter};
use crate::runner::Runner;
use crate::security::{Proof, Security};
use crate::taken::TaskSlot;
use crate::time::now;

/// Nodes that are remembered for each link: the one that is connected, and one that was.
const KNOWN: usize = 2;
/// Bytes of signatures for each function; a list shares them.
const SIGNATURE: usize = 64;
/// Events that wait for the application.
const EVENTS: usize = 6;
/// Refusals that are remembered.
const FINDINGS: usize = 2;
/// Datagrams that wait to be read or sent.
const DATAGRAMS: usize = 8;

/// The memory of one unit. [`BYTES`](Self::BYTES) tells how much that is, [`SOCKETS`](Self::SOCKETS) how many sockets
/// the stack needs for it.
///
/// | parameter | what | bytes for each |
/// |---|---|---|
/// | `T` | the application's state | its size |
/// | `LINKS` | connections; for an m_unit one more than its nodes, so that it can refuse one by name | about 5,000 and twice `STREAM` |
/// | `MESSAGE` | [`message_buffer`] of the longest message | 1 for each of `BUFFERS`; 4 with `DATAGRAM` and `REPLY` as they are |
/// | `BUFFERS` | message buffers that all links share, at least 2 | `MESSAGE` |
/// | `STREAM` | bytes that TCP keeps, in each direction of each link | 2 for each of `LINKS` |
/// | `FUNCTIONS` | its own functions, with 64 bytes of signature each | about 180 |
/// | `THEIR` | functions kept of each peer's list, with as much; others are counted as skipped | about 120 for each of `LINKS` |
/// | `CALLS` | calls in flight to one peer; calls of one peer that run here, one of which is kept for an emergency | about 250 for each of `LINKS` |
/// | `TASKS` | calls that wait for a task of the application, and answers that wait for room | `ARGUMENTS` and 350 |
/// | `ARGUMENTS` | bytes of the arguments and results of a service, with their names | 1, and 1 for each of `TASKS` |
/// | `DATAGRAM` | the longest datagram, at least 512; best-effort requests that are longer are lost; `MESSAGE` unless set | 3 |
/// | `REPLY` | the longest results that come back from a peer, encoded; `MESSAGE` unless set | 1 |
///
/// ```
/// use cara_embassy::{Resources, message_buffer};
/// struct Agv;
/// // An s_unit with messages of 1 KiB: the default.
/// type AgvResources = Resources<Agv>;
/// const { assert!(AgvResources::BYTES <= 26 * 1024) };
/// // An m_unit of three nodes with shorter messages.
/// type DepotResources = Resources<Agv, 4, { message_buffer(256) }, 4, 768>;
/// const { assert!(DepotResources::SOCKETS == 5) };
/// ```
///
/// In firmware it is a static: `static RESOURCES: StaticCell<AgvResources> = StaticCell::new();`, and
/// `RESOURCES.init_with(Resources::new)` is the `&'static mut` that [`new`] wants. It costs no flash and nothing is
/// copied, since nothing is initialised before.
pub struct Resources<
    T: 'static = (),
    const LINKS: usize = 1,
    const MESSAGE: usize = { message_buffer(1024) },
    const BUFFERS: usize = 3,
    const STREAM: usize = 1536,
    const FUNCTIONS: usize = 8,
    const THEIR: usize = 8,
    const CALLS: usize = 4,
    const TASKS: usize = 1,
    const ARGUMENTS: usize = 512,
    const DATAGRAM: usize = MESSAGE,
    const REPLY: usize = MESSAGE,
> {
    shared: MaybeUninit<Shared<T>>,
    links: MaybeUninit<[Link; LINKS]>,
    lines: MaybeUninit<[Line; LINKS]>,
    streams: [StreamMemory<STREAM>; LINKS],
    sessions: [SessionMemory<FUNCTIONS, THEIR, CALLS>; LINKS],
    nodes: MaybeUninit<[[Option<Known>; KNOWN]; LINKS]>,
    order: MaybeUninit<[[Order; KNOWN]; LINKS]>,
    node_links: MaybeUninit<[Option<u16>; LINKS]>,
    findings: MaybeUninit<[Option<Finding>; FINDINGS]>,
    functions: MaybeUninit<[Entry<Listed<T>>; FUNCTIONS]>,
    signatures: MaybeUninit<[[u8; SIGNATURE]; FUNCTIONS]>,
    to_all: MaybeUninit<[bool; FUNCTIONS]>,
    to_one: MaybeUninit<[[Option<PublishedToOne>; FUNCTIONS]; LINKS]>,
    buffers: [MaybeUninit<[u8; MESSAGE]>; BUFFERS],
    pool: MaybeUninit<[Option<&'static mut [u8]>; BUFFERS]>,
    reply: MaybeUninit<[u8; REPLY]>,
    arguments: MaybeUninit<Parameters<ARGUMENTS>>,
    task_parameters: [MaybeUninit<Parameters<ARGUMENTS>>; TASKS],
    tasks: MaybeUninit<[TaskSlot; TASKS]>,
    events: MaybeUninit<[Option<UnitEvent>; EVENTS]>,
    scratch: MaybeUninit<[u8; DATAGRAM]>,
    udp: UdpMemory<DATAGRAM>,
}

/// The memory of one TCP socket.
struct StreamMemory<const STREAM: usize> {
    receive: MaybeUninit<[u8; STREAM]>,
    send: MaybeUninit<[u8; STREAM]>,
}

/// The memory of one link.
struct SessionMemory<const FUNCTIONS: usize, const THEIR: usize, const CALLS: usize> {
    small: MaybeUninit<[u8; LINK_BUFFER_BYTES]>,
    pending: MaybeUninit<[Option<Pending>; CALLS]>,
    running: MaybeUninit<[Option<CallHead>; CALLS]>,
    publications: MaybeUninit<[Publication; FUNCTIONS]>,
    their_functions: MaybeUninit<[Entry; THEIR]>,
    their_signatures: MaybeUninit<[[u8; SIGNATURE]; THEIR]>,
    waiters: MaybeUninit<[Option<Waiter>; CALLS]>,
}

/// The memory of the UDP socket.
struct UdpMemory<const DATAGRAM: usize> {
    receive: MaybeUninit<[u8; DATAGRAM]>,
    send: MaybeUninit<[u8; DATAGRAM]>,
    received: MaybeUninit<[PacketMetadata; DATAGRAMS]>,
    sent: MaybeUninit<[PacketMetadata; DATAGRAMS]>,
}

impl<
    T: 'static,
    const LINKS: usize,
    const MESSAGE: usize,
    const BUFFERS: usize,
    const STREAM: usize,
    const FUNCTIONS: usize,
    const THEIR: usize,
    const CALLS: usize,
    const TASKS: usize,
    const ARGUMENTS: usize,
    const DATAGRAM: usize,
    const REPLY: usize,
> Resources<T, LINKS, MESSAGE, BUFFERS, STREAM, FUNCTIONS, THEIR, CALLS, TASKS, ARGUMENTS, DATAGRAM, REPLY>
{
    /// All memory of the unit, but for the stack and embassy-net's own.
    pub const BYTES: usize = size_of::<Self>();
    /// Sockets of embassy-net's `StackResources`, beside those of the application and one for DHCP.
    pub const SOCKETS: usize = LINKS + 1;

    /// Memory for a unit.
    pub const fn new() -> Self {
        const {
            assert!(LINKS > 0, "a unit has at least one link");
            assert!(BUFFERS > 1, "what waits in a buffer needs another one to be answered with");
            assert!(CALLS > 1, "one call is kept for emergencies");
            assert!(MESSAGE >= message_buffer(0), "a buffer holds the longest message of the protocol itself");
            assert!(DATAGRAM >= SEARCH_BYTES, "a datagram holds the longest search");
        }
        Self {
            shared: MaybeUninit::uninit(),
            links: MaybeUninit::uninit(),
            lines: MaybeUninit::uninit(),
            streams: [const { StreamMemory::new() }; LINKS],
            sessions: [const { SessionMemory::new() }; LINKS],
            nodes: MaybeUninit::uninit(),
            order: MaybeUninit::uninit(),
            node_links: MaybeUninit::uninit(),
            findings: MaybeUninit::uninit(),
            functions: MaybeUninit::uninit(),
            signatures: MaybeUninit::uninit(),
            to_all: MaybeUninit::uninit(),
            to_one: MaybeUninit::uninit(),
            buffers: [const { MaybeUninit::uninit() }; BUFFERS],
            pool: MaybeUninit::uninit(),
            reply: MaybeUninit::uninit(),
            arguments: MaybeUninit::uninit(),
            task_parameters: [const { MaybeUninit::uninit() }; TASKS],
            tasks: MaybeUninit::uninit(),
            events: MaybeUninit::uninit(),
            scratch: MaybeUninit::uninit(),
            udp: UdpMemory {
                receive: MaybeUninit::uninit(),
                send: MaybeUninit::uninit(),
                received: MaybeUninit::uninit(),
                sent: MaybeUninit::uninit(),
            },
        }
    }
}

impl<
    T: 'static,
    const LINKS: usize,
    const MESSAGE: usize,
    const BUFFERS: usize,
    const STREAM: usize,
    const FUNCTIONS: usize,
    const THEIR: usize,
    const CALLS: usize,
    const TASKS: usize,
    const ARGUMENTS: usize,
    const DATAGRAM: usize,
    const REPLY: usize,
> Default
    for Resources<T, LINKS, MESSAGE, BUFFERS, STREAM, FUNCTIONS, THEIR, CALLS, TASKS, ARGUMENTS, DATAGRAM, REPLY>
{
    fn default() -> Self {
        Self::new()
    }
}

impl<const STREAM: usize> StreamMemory<STREAM> {
    const fn new() -> Self {
        Self { receive: MaybeUninit::uninit(), send: MaybeUninit::uninit() }
    }

    fn line(&'static mut self, stack: Stack<'static>) -> Line {
        Line::new(stack, self.receive.write([0; STREAM]), self.send.write([0; STREAM]))
    }
}

impl<const FUNCTIONS: usize, const THEIR: usize, const CALLS: usize> SessionMemory<FUNCTIONS, THEIR, CALLS> {
    const fn new() -> Self {
        Self {
            small: MaybeUninit::uninit(),
            pending: MaybeUninit::uninit(),
            running: MaybeUninit::uninit(),
            publications: MaybeUninit::uninit(),
            their_functions: MaybeUninit::uninit(),
            their_signatures: MaybeUninit::uninit(),
            waiters: MaybeUninit::uninit(),
        }
    }

    fn link(&'static mut self) -> Link {
        let storage = SessionStorage {
            small: self.small.write([0; LINK_BUFFER_BYTES]).as_mut_slice(),
            pending: self.pending.write([const { None }; CALLS]).as_mut_slice(),
            running: self.running.write([const { None }; CALLS]).as_mut_slice(),
            publications: self.publications.write([Publication::default(); FUNCTIONS]).as_mut_slice(),
            their_functions: self.their_functions.write([const { Entry::empty() }; THEIR]).as_mut_slice(),
            their_signatures: self.their_signatures.write([[0; SIGNATURE]; THEIR]).as_flattened_mut(),
        };
        Link::new(storage, self.waiters.write([const { None }; CALLS]))
    }
}

impl<const DATAGRAM: usize> UdpMemory<DATAGRAM> {
    fn socket(&'static mut self, stack: Stack<'static>, port: u16) -> Result<UdpSocket<'static>, Error> {
        let mut socket = UdpSocket::new(
            stack,
            self.received.write([PacketMetadata::EMPTY; DATAGRAMS]),
            self.receive.write([0; DATAGRAM]),
            self.sent.write([PacketMetadata::EMPTY; DATAGRAMS]),
            self.send.write([0; DATAGRAM]),
        );
        socket.bind(port).map_err(|_| Error::PortInUse)?;
        Ok(socket)
    }
}

/// Makes a unit on a network stack, with the application's state. It does nothing until the runner runs.
///
/// The stack is the application's: it brings the driver, and an address, fixed or by DHCP. The unit notices when the
/// cable is pulled or the address changes: its connections end, the hook for the lost manager runs once, and it
/// searches again when there is an address again. One unit fits on one stack.
///
/// [`Error::BadConstraint`] when the memory cannot hold the constraints, [`Error::PortInUse`] when the discovery port
/// is bound already.
///
/// # Panics
/// In embassy-net, when the stack was made with fewer sockets than [`Resources::SOCKETS`] asks for.
#[inline(never)]
pub fn new<
    T: 'static,
    const LINKS: usize,
    const MESSAGE: usize,
    const BUFFERS: usize,
    const STREAM: usize,
    const FUNCTIONS: usize,
    const THEIR: usize,
    const CALLS: usize,
    const TASKS: usize,
    const ARGUMENTS: usize,
    const DATAGRAM: usize,
    const REPLY: usize,
>(
    stack: Stack<'static>,
    resources: &'static mut Resources<
        T,
        LINKS,
        MESSAGE,
        BUFFERS,
        STREAM,
        FUNCTIONS,
        THEIR,
        CALLS,
        TASKS,
        ARGUMENTS,
        DATAGRAM,
        REPLY,
    >,
    config: Config,
    state: T,
) -> Result<(Handle<T>, Runner<T>), Error> {
    check(&config.constraints, LINKS, MESSAGE)?;
    let mode = config.security.0.mode();
    if mode == Mode::Plain {
        warning!("this unit is INSECURE: anybody on the network can read what it says, and can speak as its peers");
    }
    let udp = resources.udp.socket(stack, mode.port())?;
    let storage = NodeStorage {
        nodes: resources.nodes.write([const { [const { None }; KNOWN] }; LINKS]).as_flattened_mut(),
        order: resources.order.write(core::array::from_fn(|_| Default::default())).as_flattened_mut(),
        links: resources.node_links.write([None; LINKS]).as_mut_slice(),
        findings: resources.findings.write([const { None }; FINDINGS]).as_mut_slice(),
    };
    let (tcp_port, access) = (config.tcp_port, config.access);
    let (node_config, proof) = parts(config);
    let node = Node::new(now(), node_config, storage);
    let buffers = resources.buffers.each_mut().map(|buffer| Some(buffer.write([0; MESSAGE]).as_mut_slice()));
    let machine = Machine {
        hub: Hub {
            node,
            publications: Publications::new(
                resources.to_all.write([false; FUNCTIONS]).as_mut_slice(),
                resources.to_one.write([const { [const { None }; FUNCTIONS] }; LINKS]).as_flattened_mut(),
            ),
        },
        proof,
        access,
        functions: FunctionList::new(
            resources.functions.write([const { Entry::empty() }; FUNCTIONS]).as_mut_slice(),
            resources.signatures.write([[0; SIGNATURE]; FUNCTIONS]).as_flattened_mut(),
        ),
        pool: Pool::new(resources.pool.write(buffers).as_mut_slice()),
        links: resources.links.write(resources.sessions.each_mut().map(SessionMemory::link)),
        mail: EmbassyMailman {
            lines: resources.lines.write(resources.streams.each_mut().map(|memory| memory.line(stack))),
            udp,
            port: mode.port(),
            stack,
        },
        reply: ReplyBox::new(resources.reply.write([0; REPLY])),
        tasks: resources
            .tasks
            .write(resources.task_parameters.each_mut().map(|memory| TaskSlot::new(memory.write(Parameters::sized())))),
        events: Events::new(resources.events.write([const { None }; EVENTS])),
        yields: false,
        lost_hook: None,
        tcp_port,
        address: None,
        look: Instant::START,
        begun: Begun::Nothing,
        begun_on: 0,
        has_begun: false,
        stopped: false,
        logged: Instant::START,
        renews_every: HANDSHAKE_LIFE,
        counters: Counters::new(),
        room: Room { buffer: MESSAGE, parameters: ARGUMENTS },
        wakers: Wakers::new(),
    };
    let shared = resources.shared.write(Shared { machine: RefCell::new(machine), state: RefCell::new(state) });
    let runner = Runner {
        shared,
        scratch: resources.scratch.write([0; DATAGRAM]),
        arguments: resources.arguments.write(Parameters::sized()),
        rested_until: Instant::START,
        unanswered: None,
    };
    Ok((Handle { shared }, runner))
}

/// The configuration of its node, and the proof of its identity.
fn parts(config: Config) -> (NodeConfig, Proof) {
    let Config { identity, target, fleet, constraints, security: Security(proof), seed, epoch, tcp_port, .. } = config;
    let listens = identity.role() == Role::MUnit;
    let node = NodeConfig {
        identity,
        fleet,
        epoch: Epoch(epoch),
        target,
        tcp_port: if listens { tcp_port } else { 0 },
        udp_port: proof.mode().port(),
        constraints,
        seed,
    };
    (node, proof)
}
