//! A request between two sessions that are joined in memory.
//!
//! Each side does what a port does with it, as the front page of `cara_core::services` says. What is no part of it: sockets,
//! locks, wakers, and the handler, which does nothing. The mailman copies what it is given once, as a socket would.

use core::net::{Ipv4Addr, SocketAddrV4};

use cara_core::config::{Constraints, LINK_BUFFER_BYTES};
use cara_core::distribution::connection_handler::{Finding, Known, Node, NodeConfig, NodeStorage, Order, Target};
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::host::secure::Plain;
use cara_core::services::hub::Hub;
use cara_core::services::lease::{Lease, Service};
use cara_core::services::publications::{Publications, PublishedToOne};
use cara_core::services::requests::{CallId, Pending};
use cara_core::services::session::{
    Event, Incoming, Publication, RequestOptions, Session, SessionConfig, SessionStorage,
};
use cara_core::services::{Context, Port, RunningCall};
use cara_core::storage::{Buffer, Lent, Pool};
use cara_core::time::{Duration, Instant};

use crate::{Meter, Of, Operation, Uncounted};

const CALLS: usize = 4;
const FUNCTIONS: usize = 4;
const SIGNATURES: usize = 512;
const BUFFERS: usize = 3;
/// Nodes that an end knows.
const NODES: usize = 2;
/// Bytes of parameters beside the text.
const NAMES: usize = 64;

/// The memory of a pair: messages of at most `MESSAGE` bytes in buffers of `BUFFER`, and parameters of `ARGUMENTS`.
pub struct PairMemory<const BUFFER: usize, const ARGUMENTS: usize> {
    caller: SideMemory<BUFFER>,
    callee: SideMemory<BUFFER>,
    ints: Parameters<NAMES>,
    text: Parameters<ARGUMENTS>,
    arguments: Parameters<ARGUMENTS>,
    characters: [u8; ARGUMENTS],
}

struct SideMemory<const BUFFER: usize> {
    small: [u8; LINK_BUFFER_BYTES],
    pending: [Option<Pending>; CALLS],
    running: [Option<RunningCall>; CALLS],
    publications: [Publication; FUNCTIONS],
    their_functions: [Entry; FUNCTIONS],
    their_signatures: [u8; SIGNATURES],
    functions: [Entry<Nothing>; FUNCTIONS],
    signatures: [u8; SIGNATURES],
    buffers: [[u8; BUFFER]; BUFFERS],
    pool: [Option<Buffer<Lent>>; BUFFERS],
    pipe: [u8; BUFFER],
    nodes: [Option<Known<SocketAddrV4>>; NODES],
    order: [Order; NODES],
    links: [Option<u16>; 1],
    findings: [Option<Finding<SocketAddrV4>>; 1],
    to_all: [bool; FUNCTIONS],
    to_one: [Option<PublishedToOne>; 1],
}

impl<const BUFFER: usize, const ARGUMENTS: usize> PairMemory<BUFFER, ARGUMENTS> {
    /// Memory for one pair.
    pub fn new() -> Self {
        Self {
            caller: SideMemory::new(),
            callee: SideMemory::new(),
            ints: Parameters::sized(),
            text: Parameters::sized(),
            arguments: Parameters::sized(),
            characters: [0; ARGUMENTS],
        }
    }
}

impl<const BUFFER: usize, const ARGUMENTS: usize> Default for PairMemory<BUFFER, ARGUMENTS> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const BUFFER: usize> SideMemory<BUFFER> {
    fn new() -> Self {
        Self {
            small: [0; LINK_BUFFER_BYTES],
            pending: [const { None }; CALLS],
            running: [const { None }; CALLS],
            publications: [Publication::default(); FUNCTIONS],
            their_functions: [const { Entry::empty() }; FUNCTIONS],
            their_signatures: [0; SIGNATURES],
            functions: [const { Entry::empty() }; FUNCTIONS],
            signatures: [0; SIGNATURES],
            buffers: [[0; BUFFER]; BUFFERS],
            pool: [const { None }; BUFFERS],
            pipe: [0; BUFFER],
            nodes: [const { None }; NODES],
            order: [Order::default(); NODES],
            links: [None; 1],
            findings: [const { None }; 1],
            to_all: [false; FUNCTIONS],
            to_one: [const { None }; 1],
        }
    }

    fn side(&'static mut self, constraints: Constraints, caller: bool) -> Side {
        for (place, buffer) in self.pool.iter_mut().zip(&mut self.buffers) {
            *place = Some(buffer);
        }
        let storage = SessionStorage {
            small: self.small.as_mut_slice(),
            pending: self.pending.as_mut_slice(),
            running: self.running.as_mut_slice(),
            publications: self.publications.as_mut_slice(),
            their_functions: self.their_functions.as_mut_slice(),
            their_signatures: self.their_signatures.as_mut_slice(),
        };
        let node = NodeStorage {
            nodes: self.nodes.as_mut_slice(),
            order: self.order.as_mut_slice(),
            links: self.links.as_mut_slice(),
            findings: self.findings.as_mut_slice(),
        };
        let publications = Publications::new(self.to_all.as_mut_slice(), self.to_one.as_mut_slice());
        let config = SessionConfig {
            link: LinkId(0),
            dialed: !caller,
            address: SocketAddrV4::new(Ipv4Addr::LOCALHOST, 7_000),
            nonce: if caller { 0x1234_5678 } else { 0x8765_4321 },
            constraints,
        };
        Side {
            now: Instant::START,
            session: Session::new(Instant::START, config, Plain, storage),
            functions: FunctionList::new(self.functions.as_mut_slice(), self.signatures.as_mut_slice()),
            pool: Pool::new(self.pool.as_mut_slice()),
            pipe: Pipe { bytes: &mut self.pipe, used: 0 },
            hub: Hub { node: Node::new(Instant::START, node_config(constraints, caller), node), publications },
        }
    }
}

/// A service that does nothing.
pub(crate) struct Nothing;

impl Service for Nothing {
    fn lease(&self) -> Option<&Lease> {
        None
    }
}

/// What one side has written and the other one has not read.
struct Pipe {
    bytes: &'static mut [u8],
    used: usize,
}

impl Mailman<SocketAddrV4> for Pipe {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let before = self.used;
        for slice in slices {
            let end = self.used + slice.len();
            self.bytes[self.used..end].copy_from_slice(slice);
            self.used = end;
        }
        Ok(self.used - before)
    }

    fn send_to(&mut self, _: SocketAddrV4, _: &[u8]) -> bool {
        false
    }

    fn broadcast(&mut self, _: &[u8]) -> bool {
        false
    }
}

/// Both sides, as the core's port.
pub(crate) enum Bench {}

impl Port for Bench {
    type Storage = Lent;
    type Cipher = Plain;
    type Endpoint = SocketAddrV4;
}

struct Side {
    now: Instant,
    session: Session<Bench>,
    functions: FunctionList<Lent, Nothing>,
    pool: Pool<Lent>,
    pipe: Pipe,
    hub: Hub<Bench>,
}

macro_rules! context {
    ($side:expr) => {
        &mut Context {
            now: $side.now,
            mailman: &mut $side.pipe,
            buffers: &mut $side.pool,
            functions: &$side.functions,
            access: None,
            hub: &mut $side.hub,
            keys: &mut (),
        }
    };
}

impl Side {
    fn ask(&mut self, function: &str, parameters: &ParametersView) -> CallId {
        let asked = self.session.request(context!(self), function.into(), parameters, &RequestOptions::default(), true);
        asked.expect("a request is sent")
    }

    /// Reads all that the other side has written, answers calls with their own arguments, and puts the results of a
    /// reply into `parameters`; how many calls and replies there were.
    fn work(&mut self, from: &mut Pipe, parameters: &mut ParametersView) -> usize {
        let mut done = self.read(from, parameters);
        while let Some(call) = self.session.next_call(context!(self), parameters) {
            self.answer(call, parameters);
            done += 1;
        }
        while self.session.deadline() <= self.now && self.session.poll(context!(self)).is_some() {}
        done
    }

    fn read(&mut self, from: &mut Pipe, parameters: &mut ParametersView) -> usize {
        let (mut at, mut done) = (0, 0);
        loop {
            let lent = &mut from.bytes[at..from.used];
            let receipt = self.session.receive(context!(self), lent, Some(&mut *parameters));
            at += receipt.consumed;
            let nothing = receipt.consumed == 0 && receipt.event.is_none();
            match receipt.event {
                Some(Event::Incoming(call)) => {
                    self.answer(call, parameters);
                    done += 1;
                }
                Some(Event::Reply(_, Ok(results))) => {
                    let block = self.session.results(&results, lent).expect("they are the last ones");
                    block.read_into(parameters).expect("the results fit");
                    done += 1;
                }
                _ => {}
            }
            if nothing {
                break;
            }
        }
        assert_eq!(at, from.used, "all is read");
        from.used = 0;
        done
    }

    fn answer(&mut self, call: Incoming, parameters: &ParametersView) {
        self.session.answer(context!(self), call.ticket, Ok(parameters)).expect("an answer is sent");
    }
}

/// A manager and its AGV.
pub struct Pair {
    caller: Side,
    callee: Side,
    ints: &'static mut ParametersView,
    text: &'static mut ParametersView,
    arguments: &'static mut ParametersView,
}

impl Pair {
    /// Two units that know each other's functions, and a text of so many characters to be sent there and back.
    pub fn new<const BUFFER: usize, const ARGUMENTS: usize>(
        memory: &'static mut PairMemory<BUFFER, ARGUMENTS>,
        characters: u32,
    ) -> Self {
        let constraints = |defaults| Constraints { message_size: characters + NAMES as u32, ..defaults };
        memory.ints.add_int("position", 2).expect("room for two integers");
        memory.ints.set_value("position", [3, 4]).expect("two integers");
        memory.text.add_string("text", characters).expect("room for the text");
        let text = crate::text(&mut memory.characters, characters as usize);
        memory.text.set_value("text", text).expect("the text");
        let mut pair = Self {
            caller: memory.caller.side(constraints(Constraints::M_UNIT), true),
            callee: memory.callee.side(constraints(Constraints::S_UNIT), false),
            ints: &mut memory.ints,
            text: &mut memory.text,
            arguments: &mut memory.arguments,
        };
        pair.join(characters);
        pair
    }

    fn join(&mut self, characters: u32) {
        let position = Definition::parse("pos_info(position: int[2]) -> (position: int[2])").expect("a signature");
        let text = Definition::new("echo").and_then(|echo| echo.arguments(self.text)?.results(self.text));
        let echo = text.expect("a signature");
        let callee = &mut self.callee;
        for definition in [position, echo] {
            callee.functions.add_function(&definition, Attributes::default(), Nothing).expect("room for it");
        }
        self.caller.session.connected(context!(self.caller));
        callee.session.connected(context!(callee));
        self.settle();
        let slots = ["pos_info", "echo"].map(|name| self.callee.functions.find(name).expect("it is there"));
        let callee = &mut self.callee;
        for slot in slots {
            callee.hub.publications.publish_to_all(slot).expect("room for it");
        }
        callee.session.publish(context!(callee));
        self.settle();
        assert_eq!(self.caller.session.their_function_list().len(), 2, "of {characters} characters");
    }

    /// Lets both sides work until they have nothing more to say.
    fn settle(&mut self) {
        while self.caller.pipe.used + self.callee.pipe.used > 0 {
            self.callee.work(&mut self.caller.pipe, self.arguments);
            self.caller.work(&mut self.callee.pipe, self.arguments);
        }
    }

    fn request(&mut self, with_text: bool, caller: &mut dyn Meter, callee: &mut dyn Meter) {
        let Self { caller: asking, callee: serving, ints, text, arguments } = self;
        for side in [&mut *asking, &mut *serving] {
            side.now = side.now + Duration::from_micros(10);
        }
        let (function, parameters) = if with_text { ("echo", text) } else { ("pos_info", ints) };
        caller.count(&mut || {
            asking.ask(function, parameters);
        });
        let mut served = 0;
        callee.count(&mut || served = serving.work(&mut asking.pipe, arguments));
        let mut answered = 0;
        caller.count(&mut || answered = asking.work(&mut serving.pipe, parameters));
        assert_eq!((served, answered), (1, 1));
    }

    /// What can be counted.
    ///
    /// The caller's side: check and encode the request, frame it, hand it to the mailman; read the reply's frames, find
    /// the call that waits, update the caller's parameters. The callee's side: read the request's frames, check it
    /// against the signature, put the arguments into the service's parameters, and the same way back.
    pub fn operations(characters: u32) -> [Operation<Self>; 4] {
        let (ints, text) = (Of::Ints(2), Of::Characters(characters));
        let (caller, callee) = ("request, caller's side", "request, callee's side");
        [
            Operation { name: caller, of: ints, run: |pair, meter| pair.request(false, meter, &mut Uncounted) },
            Operation { name: callee, of: ints, run: |pair, meter| pair.request(false, &mut Uncounted, meter) },
            Operation { name: caller, of: text, run: |pair, meter| pair.request(true, meter, &mut Uncounted) },
            Operation { name: callee, of: text, run: |pair, meter| pair.request(true, &mut Uncounted, meter) },
        ]
    }
}

fn identity(caller: bool) -> Identity {
    if caller { Identity::m_unit("depot", 1) } else { Identity::s_unit("agv-17", 17) }.expect("a name")
}

fn depot() -> Manager {
    Manager::new("depot", 1).expect("a name")
}

fn node_config(constraints: Constraints, caller: bool) -> NodeConfig<SocketAddrV4> {
    NodeConfig {
        identity: identity(caller),
        fleet: Fleet(1),
        epoch: Epoch(1),
        target: if caller { Target::Everybody } else { Target::Manager(depot()) },
        tcp_port: 0,
        udp_port: 0,
        constraints,
        seed: 1,
    }
}
