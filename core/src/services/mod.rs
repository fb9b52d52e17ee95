//! Common services (paper, section 2): requesting, serving, publishing; the m_unit's and the s_unit's view of a peer.
//!
//! # How a port drives the machines
//!
//! A port owns sockets, time, threads and memory; the state machines make every decision. A [`Hub`](hub::Hub) is the part that
//! all links of a unit share: the [`Node`](crate::distribution::connection_handler::Node), which finds and admits peers, and the
//! publications. A [`Session`](session::Session) is one link. Each call passes the time and what else is needed; it does what is
//! possible now and returns what happened. It never waits, reads a clock or allocates.
//!
//! | what happens | what the port calls |
//! |---|---|
//! | the unit starts | `Node::new`, and [`Hub`](hub::Hub) around it |
//! | at `node.next_deadline()`, and after anything else was done to the hub | `node.poll` until `None` |
//! | … it returns `Command::Dial` | open a stream, `Session::new` with `dialed: true`, `node.dialing`; or `node.dial_failed` |
//! | … it returns `Command::Notify(link, directive)` | `session.direct`, with nothing of the hub locked |
//! | a stream that was dialled is open, or one was accepted | `session.connected` |
//! | bytes have come | `session.receive` until it consumes nothing and returns no event, then `session.poll` and `session.next_call`, each until `None`. After `paused`, offer the rest again after `direct`, or when a buffer may be free |
//! | the stream takes bytes again, and `session.wants_to_write()` | `session.writable` |
//! | a datagram has come | `session.datagram` of the link that [`for_session`](crate::distribution::datagram::for_session) names, if there is one; else `node.datagram` |
//! | at `session.deadline()`, and after each call that may have ended the link | `session.poll` until `None`, **before** any received bytes: leases end here |
//! | a handler has run, outside of all locks | `session.answer`, then `session.next_call` |
//! | the stream has ended | `session.disconnected` |
//!
//! | event | what the port does |
//! |---|---|
//! | [`LeaseExpired`](session::Event::LeaseExpired) | runs the safe hook of the service, before anything else |
//! | [`Incoming`](session::Event::Incoming) | runs the handler, and answers by ticket. An `order` is the handler's view of the service's [`Lease`](lease::Lease); a newer call of the service ends it without an event, so wake what awaits its end |
//! | [`Reply`](session::Event::Reply), [`Failed`](session::Event::Failed), and all others | passes the program the event that [`UnitEvent::of`](event::UnitEvent::of) returns, and a reply's results from `session.results`. It calls `session.cancel` for a call that the program gives up, `session.release` for all calls of a function |
//! | `Sample`, `Subscribed` (feature `streams`) | stores the value from `session.results`, or the outcome of the subscription. It calls `session.subscribe` again at each [`ListChanged`](session::Event::ListChanged), and `session.stream_changed`, then `session.poll`, for each value that the unit publishes |
//! | [`Joined`](session::Event::Joined) | notes that the peer is admitted and learns what is published to it; from now on it is `session.peer()` |
//! | [`Closed`](session::Event::Closed) | the last event: drops the session (`into_storage` returns its slices), then calls `node.left`, also for a link that never joined |
//!
//! Ports differ only in which thread or task makes these calls, and under which lock. No port locks two sessions at the same
//! time; a session enters the hub itself, through the [`Door`](hub::Door) in its [`Context`].
//!
//! ```
//! # use cara_core::config::Constraints;
//! # use cara_core::distribution::connection_handler::{Command, Node, NodeConfig, NodeStorage, Target};
//! # use cara_core::distribution::function::{Attributes, Definition};
//! # use cara_core::distribution::function_list::{Entry, FunctionList};
//! # use cara_core::distribution::identity::{Epoch, Fleet, Identity};
//! # use cara_core::distribution::parameters::Parameters;
//! # use cara_core::error::CloseReason;
//! # use cara_core::host::mailman::{LinkId, Mailman};
//! # use cara_core::host::secure::Plain;
//! # use cara_core::services::hub::Hub;
//! # use cara_core::services::publications::Publications;
//! # use cara_core::services::session::{Event, RequestOptions, Session, SessionConfig, SessionStorage};
//! # use cara_core::services::{Context, Port};
//! # use cara_core::storage::{Pool, Storage};
//! # use cara_core::time::Instant;
//! # use core::net::{Ipv4Addr, SocketAddrV4};
//! # fn slice<T: Default>(count: usize) -> Box<[T]> { (0..count).map(|_| T::default()).collect() }
//! // What the port is made of: slices on the heap, links in clear.
//! enum Boxed {}
//! impl Storage for Boxed {
//!     type Slice<T: 'static> = Box<[T]>;
//! }
//! enum InMemory {}
//! impl Port for InMemory {
//!     type Storage = Boxed;
//!     type Cipher = Plain;
//!     type Endpoint = SocketAddrV4;
//! }
//!
//! /// The bytes on their way to the other end. This port has no datagrams.
//! struct Wire(Vec<u8>);
//! impl Mailman<SocketAddrV4> for Wire {
//!     fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
//!         self.0.extend(slices.concat());
//!         Ok(slices.iter().map(|slice| slice.len()).sum())
//!     }
//!     fn send_to(&mut self, _: SocketAddrV4, _: &[u8]) -> bool { false }
//!     fn broadcast(&mut self, _: &[u8]) -> bool { false }
//! }
//!
//! struct End {
//!     hub: Hub<InMemory>,
//!     session: Session<InMemory>,
//!     functions: FunctionList<Boxed, ()>,
//!     buffers: Pool<Boxed>,
//!     wire: Wire,
//!     replied: Option<i64>,
//! }
//!
//! impl End {
//!     /// Does all that can be done now with the bytes that have come; true if anything was.
//!     fn work(&mut self, now: Instant, arrived: &mut [u8]) -> bool {
//!         let Self { hub, session, functions, buffers, wire, replied } = self;
//!         let mut arguments = Parameters::<256>::sized();
//!         let (mut start, mut worked) = (0, false);
//!         loop {
//!             // What the hub wants of other links; here there is none, and what it dials is connected already.
//!             while let Some(Command::Dial { .. }) = hub.node.poll(now, wire, &Plain) {}
//!             let mut cx = Context { now, mailman: wire, buffers, functions, access: None, hub, keys: &mut () };
//!             // What is due comes before what has arrived.
//!             let (mut consumed, lent) = (0, &mut arrived[start..]);
//!             let event = session.poll(&mut cx).or_else(|| {
//!                 let receipt = session.receive(&mut cx, lent, Some(&mut arguments));
//!                 consumed = receipt.consumed;
//!                 receipt.event
//!             });
//!             start += consumed;
//!             worked |= consumed > 0;
//!             match event {
//!                 None if consumed == 0 => return worked,
//!                 None | Some(Event::Joined | Event::ListChanged | Event::Acknowledged { .. }) => {}
//!                 Some(Event::Incoming(call)) => {
//!                     let n: i64 = arguments.variable("n").expect("the request was checked");
//!                     arguments.clear();
//!                     arguments.add_int("twice", 1).expect("there is room");
//!                     arguments.set_value("twice", 2 * n).expect("it is an int");
//!                     session.answer(&mut cx, call.ticket, Ok(&arguments)).expect("there is a buffer");
//!                 }
//!                 Some(Event::Reply(_, outcome)) => {
//!                     let results = outcome.and_then(|results| session.results(&results, lent));
//!                     let mut into = Parameters::<256>::sized();
//!                     into.add_int("twice", 1).expect("there is room");
//!                     results.expect("it was served").read_into(&mut into).expect("they are the results");
//!                     *replied = into.variable("twice").ok();
//!                 }
//!                 Some(event) => panic!("unexpected: {event:?}"),
//!             }
//!         }
//!     }
//! }
//! # fn end(now: Instant, identity: Identity, target: Target<SocketAddrV4>, dialed: bool) -> End {
//! #     let constraints = Constraints::S_UNIT;
//! #     let config = NodeConfig {
//! #         identity, fleet: Fleet(1), epoch: Epoch(1), target, tcp_port: 0, udp_port: 0, constraints,
//! #         seed: 1 + u64::from(dialed),
//! #     };
//! #     let storage = NodeStorage { nodes: slice(4), order: slice(4), links: slice(1), findings: slice(4) };
//! #     let mut node = Node::new(now, config, storage);
//! #     let address = SocketAddrV4::new(Ipv4Addr::new(192, 0, 2, 1), 7000);
//! #     let nonce = node.nonce();
//! #     let config = SessionConfig { link: LinkId(0), dialed, address, nonce, constraints };
//! #     let storage = SessionStorage {
//! #         small: slice(512), pending: slice(4), running: slice(4), publications: slice(4),
//! #         their_functions: (0..4).map(|_| Entry::empty()).collect(), their_signatures: slice(256),
//! #     };
//! #     let mut end = End {
//! #         hub: Hub { node, publications: Publications::new(slice(4), slice(4)) },
//! #         session: Session::new(now, config, Plain, storage),
//! #         functions: FunctionList::new((0..4).map(|_| Entry::empty()).collect(), slice(256)),
//! #         buffers: Pool::new((0..4).map(|_| Some(slice(2_048))).collect()),
//! #         wire: Wire(Vec::new()),
//! #         replied: None,
//! #     };
//! #     if dialed { end.hub.node.dialing(None, LinkId(0)); }
//! #     end
//! # }
//! # fn connect(end: &mut End, now: Instant) {
//! #     let End { hub, session, functions, buffers, wire, .. } = end;
//! #     session.connected(&mut Context { now, mailman: wire, buffers, functions, access: None, hub, keys: &mut () });
//! # }
//! # let now = Instant::START;
//! # let identity = Identity::m_unit("depot", 1)?;
//! # let manager = cara_core::distribution::hello::Manager::new("depot", 1)?;
//! # let mut depot = end(now, identity, Target::Everybody, false);
//! # let mut agv = end(now, Identity::s_unit("agv", 7)?, Target::Manager(manager), true);
//! // The vehicle offers a function, and their streams are carried to and fro until nothing moves.
//! let slot = agv.functions.add_function(&Definition::parse("double(n: int) -> (twice: int)")?, Attributes::default(), ())?;
//! agv.hub.publications.publish_to_all(slot)?;
//! # connect(&mut depot, now);
//! # connect(&mut agv, now);
//! let carry = |depot: &mut End, agv: &mut End| loop {
//!     let (mut to_agv, mut to_depot) = (std::mem::take(&mut depot.wire.0), std::mem::take(&mut agv.wire.0));
//!     if !(agv.work(now, &mut to_agv) | depot.work(now, &mut to_depot)) { break }
//! };
//! carry(&mut depot, &mut agv);
//!
//! let mut arguments = Parameters::<256>::sized();
//! arguments.add_int("n", 1)?;
//! arguments.set_value("n", 21)?;
//! {
//!     let End { hub, session, functions, buffers, wire, .. } = &mut depot;
//!     let mut cx = Context { now, mailman: wire, buffers, functions, access: None, hub, keys: &mut () };
//!     session.request(&mut cx, "double".into(), &arguments, &RequestOptions::default(), true)?;
//! }
//! carry(&mut depot, &mut agv);
//! assert_eq!(depot.replied, Some(42));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod access;
pub mod call;
mod calls;
pub mod event;
pub mod heart;
pub mod hub;
pub mod lease;
mod own_list;
pub mod publications;
pub mod requests;
mod run_times;
pub mod session;
pub mod stream;
pub mod typed;

pub use crate::host::port::Port;
pub use calls::{RunningCall, Ticket, slots_for};

use crate::distribution::function_list::{Function, FunctionList, Generation, Slot};
use crate::distribution::hello::Hello;
use crate::distribution::latch::LatchWord;
use crate::error::Error;
use crate::host::mailman::Mailman;
use crate::host::secure::Secure;
use crate::storage::{Buffers, Storage};
use crate::time::Instant;
use lease::Service;

/// What a port lends to each call of a [`Session`](session::Session).
pub struct Context<'c, P: Port> {
    /// The time now.
    pub now: Instant,
    /// Writes to links and sends datagrams.
    pub mailman: &'c mut dyn Mailman<P::Endpoint>,
    /// The unit's message buffers.
    pub buffers: &'c mut dyn Buffers<P::Storage>,
    /// The unit's own functions.
    pub functions: &'c dyn OwnFunctions,
    /// The access table; without one, a joined node may do everything.
    pub access: Option<&'c dyn access::Access>,
    /// The state that the unit's links share.
    pub hub: &'c mut dyn hub::Door<P>,
    /// The keys of the unit's pairs; `()` in plain mode.
    pub keys: &'c mut dyn Keys<P>,
}

impl<'c, P: Port> Context<'c, P> {
    /// The access table, on ports that have access control.
    pub(crate) const fn table(&self) -> Option<&'c dyn access::Access> {
        if P::HAS_ACCESS { self.access } else { None }
    }
}

/// Looks up the key of a pair.
pub trait Keys<P: Port> {
    /// The key of this unit and the peer that a hello names, with fresh random bytes; `None` if there is none. The hello is not
    /// authenticated.
    fn credentials(&mut self, hello: &Hello) -> Option<<P::Cipher as Secure>::Credentials>;
}

impl<P: Port> Keys<P> for () {
    fn credentials(&mut self, _: &Hello) -> Option<<P::Cipher as Secure>::Credentials> {
        None
    }
}

/// A unit's own [`FunctionList`], whatever type its handlers have.
pub trait OwnFunctions {
    /// [`FunctionList::function`]
    fn function(&self, slot: Slot) -> Option<Function<'_, dyn Service>>;
    /// The function that a request names, or why there is none.
    fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, dyn Service>, Error>;
    /// [`FunctionList::generation`]
    fn generation(&self, slot: Slot) -> Option<Generation>;
    /// How many slots there are, empty ones included.
    fn places(&self) -> u16;
    /// [`FunctionList::stopped`]
    fn stopped(&self) -> &LatchWord;
}

impl<S: Storage, H: Service + 'static> OwnFunctions for FunctionList<S, H> {
    fn function(&self, slot: Slot) -> Option<Function<'_, dyn Service>> {
        Self::function(self, slot).map(erased)
    }

    fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, dyn Service>, Error> {
        Self::lookup(self, slot, generation).map(erased)
    }

    fn generation(&self, slot: Slot) -> Option<Generation> {
        Self::generation(self, slot)
    }

    fn places(&self) -> u16 {
        Self::places(self)
    }

    fn stopped(&self) -> &LatchWord {
        Self::stopped(self)
    }
}

fn erased<H: Service + 'static>(function: Function<'_, H>) -> Function<'_, dyn Service> {
    let Function { slot, generation, signature, attributes, handler } = function;
    Function { slot, generation, signature, attributes, handler }
}
