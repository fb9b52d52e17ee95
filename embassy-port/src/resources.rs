//! The memory of a unit: all of it, sized when compiling, lent for ever.

use core::cell::RefCell;
use core::mem::MaybeUninit;
use core::net::SocketAddrV4;

use cara_core::config::{HANDSHAKE_LIFE, LINK_BUFFER_BYTES, Mode};
use cara_core::counters::Counters;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::{Finding, Known, Node, NodeConfig, NodeStorage, Order, Target};
use cara_core::distribution::datagram::SEARCH_BYTES;
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::parameters::Parameters;
use cara_core::error::Error;
use cara_core::services::hub::Hub;
use cara_core::services::lease::Latch;
use cara_core::services::publications::{Publications, PublishedToOne};
use cara_core::services::requests::Pending;
use cara_core::services::session::{Publication, SessionStorage};
use cara_core::services::{Port, RunningCall};
use cara_core::storage::Pool;
use cara_core::time::Instant;

use crate::config::Config;

use crate::event::{Events, UnitEvent};
use crate::handle::Handle;
use crate::handler::Listed;
use crate::limits::{Limits, check_sockets};
use crate::link::Link;
use crate::link::Waiter;
use crate::machine::{Machine, Shared, Started, Unwanted, Wakers};
use crate::mail::{self, Carrier, Transport};
use crate::owned::{FREE, Place, Places};
use crate::port::Board;
use crate::replies::ReplyBox;
use crate::runner::Runner;
use crate::task_slots::TaskSlot;
use crate::time::now;

/// Nodes that are remembered for each link: the one that is connected, and one that was.
const KNOWN: usize = 2;
/// Bytes of signatures for each function; a list shares them.
const SIGNATURE: usize = 64;
/// The same of the unit's own functions, which have help where it is sent.
const OWN_SIGNATURE: usize = if cfg!(feature = "help") { 192 } else { SIGNATURE };
/// Events that wait for the application.
const EVENTS: usize = 6;
/// Refusals that are remembered.
const FINDINGS: usize = 2;

/// The memory of one unit, of the type that [`resources!`](crate::resources) makes of its [`Limits`].
///
/// In firmware it is a static, and `RESOURCES.init_with(Resources::new)` is the `&'static mut` that [`new`] wants. It costs
/// no flash and nothing is copied, since nothing is initialised before.
pub struct Resources<
    T: 'static,
    const LINKS: usize,
    const SIZE: u32,
    const BUFFER: usize,
    const BUFFERS: usize,
    const STREAM: usize,
    const OWN: usize,
    const THEIR: usize,
    const CALLS: usize,
    const WAIT: usize,
    const TASKS: usize,
    const ARGUMENTS: usize,
    const DATAGRAM: usize,
    const REPLY: usize,
> {
    shared: MaybeUninit<Shared<T>>,
    links: MaybeUninit<[Link; LINKS]>,
    marks: MaybeUninit<[[[Place; CALLS]; 2]; LINKS]>,
    places: MaybeUninit<[Places; LINKS]>,
    mail: mail::Memory<LINKS, STREAM, DATAGRAM>,
    sessions: [SessionMemory<OWN, THEIR, CALLS>; LINKS],
    nodes: MaybeUninit<[[Option<Known<SocketAddrV4>>; KNOWN]; LINKS]>,
    order: MaybeUninit<[[Order; KNOWN]; LINKS]>,
    node_links: MaybeUninit<[Option<u16>; LINKS]>,
    findings: MaybeUninit<[Option<Finding<SocketAddrV4>>; FINDINGS]>,
    functions: MaybeUninit<[Entry<Listed<T>>; OWN]>,
    signatures: MaybeUninit<[[u8; OWN_SIGNATURE]; OWN]>,
    to_all: MaybeUninit<[bool; OWN]>,
    to_one: MaybeUninit<[[Option<PublishedToOne>; OWN]; LINKS]>,
    buffers: MaybeUninit<[[u8; BUFFER]; BUFFERS]>,
    pool: MaybeUninit<[Option<&'static mut [u8]>; BUFFERS]>,
    reply: MaybeUninit<[u8; REPLY]>,
    arguments: MaybeUninit<Parameters<ARGUMENTS>>,
    task_parameters: [MaybeUninit<Parameters<ARGUMENTS>>; TASKS],
    tasks: MaybeUninit<[TaskSlot; TASKS]>,
    events: MaybeUninit<[Option<UnitEvent>; EVENTS]>,
    /// What has arrived is looked at in here.
    scratch: MaybeUninit<[u8; DATAGRAM]>,
}

/// The memory of one link.
struct SessionMemory<const OWN: usize, const THEIR: usize, const CALLS: usize> {
    small: MaybeUninit<[u8; LINK_BUFFER_BYTES]>,
    pending: MaybeUninit<[Option<Pending>; CALLS]>,
    running: MaybeUninit<[Option<RunningCall>; CALLS]>,
    publications: MaybeUninit<[Publication; OWN]>,
    their_functions: MaybeUninit<[Entry; THEIR]>,
    their_signatures: MaybeUninit<[[u8; SIGNATURE]; THEIR]>,
    waiters: MaybeUninit<[Option<Waiter>; CALLS]>,
}

/// [`Resources`] of any size, for an application whose state is a `T`.
pub trait Memory<T> {
    /// How many sockets the unit needs.
    #[doc(hidden)]
    const SOCKETS: usize;

    #[doc(hidden)]
    fn unit(&'static mut self, carrier: Carrier, config: Config, state: T) -> Result<(Handle<T>, Runner<T>), Error>;
}

/// Makes a unit on a network stack or a serial line, with the application's state. It does nothing until the runner runs.
///
/// The stack is the application's: it brings the driver, and an address, fixed or by DHCP. The unit notices when the
/// cable is pulled or the address changes: its connections end, the hook for the lost manager runs once, and it
/// searches again when there is an address again. One unit fits on one stack.
///
/// [`Error::DoesNotFit`] when the memory cannot hold the constraints, [`Error::PortInUse`] when the discovery port
/// is bound already, [`Error::BadConstraint`] for a unit without its manager's address or with an access table where the feature
/// `discover` or `access` is off, and for more than one link on a serial line. A stack with fewer sockets than
/// [`Limits::sockets`] does not compile.
///
/// # Panics
/// In embassy-net, when sockets of the application or of DNS have left too few.
pub fn new<T, N: Transport, M: Memory<T>>(
    transport: N,
    resources: &'static mut M,
    config: Config,
    state: T,
) -> Result<(Handle<T>, Runner<T>), Error> {
    const { check_sockets(M::SOCKETS, N::SOCKETS) };
    resources.unit(transport.carrier(), config, state)
}

// There is no memory of a default size.
#[expect(clippy::new_without_default)]
impl<
    T: 'static,
    const LINKS: usize,
    const SIZE: u32,
    const BUFFER: usize,
    const BUFFERS: usize,
    const STREAM: usize,
    const OWN: usize,
    const THEIR: usize,
    const CALLS: usize,
    const WAIT: usize,
    const TASKS: usize,
    const ARGUMENTS: usize,
    const DATAGRAM: usize,
    const REPLY: usize,
> Resources<T, LINKS, SIZE, BUFFER, BUFFERS, STREAM, OWN, THEIR, CALLS, WAIT, TASKS, ARGUMENTS, DATAGRAM, REPLY>
{
    /// All memory of the unit, but for the stack and embassy-net's own.
    pub const BYTES: usize = size_of::<Self>();
    /// The limits that it was made of.
    pub const LIMITS: Limits = Limits {
        links: LINKS,
        message_size: SIZE,
        message_buffers: BUFFERS,
        stream: STREAM,
        functions: OWN,
        their_functions: THEIR,
        calls: CALLS,
        calls_waiting: WAIT,
        tasks: TASKS,
        arguments: ARGUMENTS,
        datagram: Some(DATAGRAM),
        reply: Some(REPLY),
    };

    /// Memory for a unit.
    pub const fn new() -> Self {
        const {
            assert!(LINKS > 0, "a unit has at least one link");
            assert!(BUFFERS > 1, "what waits in a buffer needs another one to be answered with");
            assert!(CALLS > 1, "one call is kept for emergencies");
            assert!(DATAGRAM >= SEARCH_BYTES, "a datagram holds the longest search");
        }
        Self {
            shared: MaybeUninit::uninit(),
            links: MaybeUninit::uninit(),
            marks: MaybeUninit::uninit(),
            places: MaybeUninit::uninit(),
            mail: mail::Memory::new(),
            sessions: [const { SessionMemory::new() }; LINKS],
            nodes: MaybeUninit::uninit(),
            order: MaybeUninit::uninit(),
            node_links: MaybeUninit::uninit(),
            findings: MaybeUninit::uninit(),
            functions: MaybeUninit::uninit(),
            signatures: MaybeUninit::uninit(),
            to_all: MaybeUninit::uninit(),
            to_one: MaybeUninit::uninit(),
            buffers: MaybeUninit::uninit(),
            pool: MaybeUninit::uninit(),
            reply: MaybeUninit::uninit(),
            arguments: MaybeUninit::uninit(),
            task_parameters: [const { MaybeUninit::uninit() }; TASKS],
            tasks: MaybeUninit::uninit(),
            events: MaybeUninit::uninit(),
            scratch: MaybeUninit::uninit(),
        }
    }
}

impl<
    T: 'static,
    const LINKS: usize,
    const SIZE: u32,
    const BUFFER: usize,
    const BUFFERS: usize,
    const STREAM: usize,
    const OWN: usize,
    const THEIR: usize,
    const CALLS: usize,
    const WAIT: usize,
    const TASKS: usize,
    const ARGUMENTS: usize,
    const DATAGRAM: usize,
    const REPLY: usize,
> Memory<T>
    for Resources<T, LINKS, SIZE, BUFFER, BUFFERS, STREAM, OWN, THEIR, CALLS, WAIT, TASKS, ARGUMENTS, DATAGRAM, REPLY>
{
    const SOCKETS: usize = Self::LIMITS.sockets();

    #[inline(never)]
    fn unit(
        &'static mut self,
        carrier: Carrier,
        mut config: Config,
        state: T,
    ) -> Result<(Handle<T>, Runner<T>), Error> {
        config.node.constraints = config.constraints.unwrap_or(const { Self::LIMITS.constraints() });
        Self::LIMITS.fit(&config.node.constraints)?;
        let has_address = matches!(config.node.target, Target::Fixed(..));
        if !Board::DISCOVERS && !has_address || !Board::HAS_ACCESS && config.access.0.is_some() {
            return Err(Error::BadConstraint);
        }
        if config.security.0.mode() == Mode::Plain {
            warning!("this unit is INSECURE: anybody on the network can read what it says, and can speak as its peers");
        }
        let mail = self.mail.open(carrier, config.node.udp_port)?;
        let scratch = self.scratch.write([0; DATAGRAM]);
        let storage = NodeStorage {
            nodes: self.nodes.write([const { [const { None }; KNOWN] }; LINKS]).as_flattened_mut(),
            order: self.order.write(core::array::from_fn(|_| Default::default())).as_flattened_mut(),
            links: self.node_links.write([None; LINKS]).as_mut_slice(),
            findings: self.findings.write([const { None }; FINDINGS]).as_mut_slice(),
        };
        let tcp_port = config.node.tcp_port;
        let (seed, manager) = (config.node.seed, config.manager());
        let pool = self.pool.write([const { None }; BUFFERS]);
        for (place, buffer) in pool.iter_mut().zip(self.buffers.write([[0; BUFFER]; BUFFERS])) {
            *place = Some(buffer);
        }
        let marks = &*self.marks.write([const { [const { [FREE; CALLS] }; 2] }; LINKS]);
        let places = &*self.places.write(marks.each_ref().map(|marks| Places::new(marks.as_flattened())));
        let machine = Machine {
            hub: Hub {
                node: node(config.node, storage),
                publications: Publications::new(
                    self.to_all.write([false; OWN]).as_mut_slice(),
                    self.to_one.write([const { [const { None }; OWN] }; LINKS]).as_flattened_mut(),
                ),
            },
            proof: config.security.0,
            access: config.access,
            store_own: config.store_own,
            store: config.store,
            unstored: None,
            functions: FunctionList::new(
                self.functions.write([const { Entry::empty() }; OWN]).as_mut_slice(),
                self.signatures.write([[0; OWN_SIGNATURE]; OWN]).as_flattened_mut(),
            ),
            pool: Pool::new(&mut pool[..]),
            links: self.links.write(self.sessions.each_mut().map(SessionMemory::link)),
            places,
            mail,
            reply: ReplyBox::new(self.reply.write([0; REPLY])),
            #[cfg(feature = "streams")]
            readings: crate::readings::Readings::NONE,
            tasks: self
                .tasks
                .write(self.task_parameters.each_mut().map(|memory| TaskSlot::new(memory.write(Parameters::sized())))),
            left_to_tasks: 0,
            events: Events::new(self.events.write([const { None }; EVENTS])),
            yields: false,
            lost_hook: None,
            tcp_port,
            address: None,
            look: Instant::START,
            started: Started::Nothing,
            started_on: 0,
            has_started: false,
            stopped: false,
            logged: Instant::START,
            renews_every: HANDSHAKE_LIFE,
            counters: Counters::new(),
            limits: const { &Self::LIMITS },
            wakers: Wakers::new(),
        };
        let shared = self.shared.write(Shared {
            machine: RefCell::new(machine),
            state: RefCell::new(state),
            unwanted: Unwanted::new(places),
        });
        // In its place: changed before it is moved there, it would lie on the stack more than once.
        let machine = shared.machine.get_mut();
        let claim = if config.claim == Claim::NONE { Claim::NONE.raised(seed) } else { config.claim };
        machine.begin_claims(claim, manager.as_ref(), &config.obeyed)?;
        if let Some(reason) = config.starts_stopped {
            machine.functions.stopped().inhibit(now(), Latch { by: 0, reason });
        }
        let runner = Runner {
            shared,
            scratch,
            arguments: self.arguments.write(Parameters::sized()),
            rested_until: Instant::START,
            unanswered: None,
        };
        Ok((Handle { shared }, runner))
    }
}

/// Kept apart: merged into its caller, what it makes would lie on the stack several times.
#[inline(never)]
fn node(config: NodeConfig<SocketAddrV4>, storage: NodeStorage<Board>) -> Node<Board> {
    Node::new(now(), config, storage)
}

impl<const OWN: usize, const THEIR: usize, const CALLS: usize> SessionMemory<OWN, THEIR, CALLS> {
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
            publications: self.publications.write([Publication::default(); OWN]).as_mut_slice(),
            their_functions: self.their_functions.write([const { Entry::empty() }; THEIR]).as_mut_slice(),
            their_signatures: self.their_signatures.write([[0; SIGNATURE]; THEIR]).as_flattened_mut(),
        };
        Link::new(storage, self.waiters.write([const { None }; CALLS]))
    }
}
