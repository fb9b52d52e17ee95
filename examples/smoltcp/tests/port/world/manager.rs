//! The manager of these tests: the core's two machines over smoltcp, with a few links.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use cara_core::config::{Constraints, LINK_BUFFER_BYTES, Mode, PLAIN_PORT};
use cara_core::distribution::connection_handler::{Command, Node, NodeConfig, NodeStorage, Target};
use cara_core::distribution::datagram;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::host::secure::Plain;
use cara_core::services::hub::Hub;
use cara_core::services::publications::Publications;
use cara_core::services::requests::CallId;
use cara_core::services::session::{Event, RequestOptions, Session, SessionConfig, SessionStorage, buffer_bytes};
use cara_core::services::{Context, Port};
use cara_core::storage::Pool;
use cara_core::time::Instant;
use cara_sim::Boxed;
use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet};
use smoltcp::socket::{tcp, udp};
use smoltcp::wire::{EthernetAddress, HardwareAddress, IpCidr, Ipv4Cidr};

use super::Cable;

/// The last part of its addresses, unless it moves.
pub(crate) const HOST: u8 = 250;
const TCP_PORT: u16 = 7_000;
/// Links, each with a socket that listens as long as it has none.
const LINKS: usize = 8;
const FUNCTIONS: usize = 8;
const CALLS: usize = 16;

pub(crate) fn address() -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, HOST), TCP_PORT)
}

pub(crate) fn mac(host: u8) -> [u8; 6] {
    [2, 0, 0, 0, 0, host]
}

/// Parameters with one number, which both ends' functions take, and texts.
pub(crate) fn number(value: i64) -> Parameters<2048> {
    let mut parameters = Parameters::sized();
    parameters.add_string("report", 900).unwrap();
    parameters.add_int("number", 1).unwrap();
    parameters.add_string("text", 400).unwrap();
    parameters.set_value("number", [value]).unwrap();
    parameters
}

/// A host with an allocator, as the core's port.
enum OnHost {}

impl Port for OnHost {
    type Storage = Boxed;
    type Cipher = Plain;
    type Endpoint = SocketAddrV4;
}

pub(crate) struct Manager {
    pub(crate) cable: Cable,
    net: Net,
    hub: Hub<OnHost>,
    sessions: Vec<Option<Session<OnHost>>>,
    functions: FunctionList<Boxed, ()>,
    buffers: Pool<Boxed>,
    arguments: Box<Parameters<4096>>,
    /// (link, id, outcome) of calls that have ended.
    pub(crate) replies: Vec<(usize, CallId, Result<i64, Error>)>,
    /// Links that were live and have ended.
    pub(crate) left: Vec<(Instant, CloseReason)>,
    pub(crate) served: usize,
    live: [bool; LINKS],
    due: Instant,
}

struct Net {
    interface: Interface,
    sockets: SocketSet<'static>,
    streams: Vec<SocketHandle>,
    datagrams: SocketHandle,
}

impl Mailman<SocketAddrV4> for Net {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let stream = self.sockets.get_mut::<tcp::Socket>(self.streams[usize::from(link.0)]);
        let mut written = 0;
        for slice in slices {
            let taken = stream.send_slice(slice).map_err(|_| CloseReason::Reset)?;
            written += taken;
            if taken < slice.len() {
                break;
            }
        }
        Ok(written)
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        self.sockets.get_mut::<udp::Socket>(self.datagrams).send_slice(datagram, to).is_ok()
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.send_to(SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 255), PLAIN_PORT), datagram)
    }
}

impl Net {
    fn new(now: Instant, cable: &mut Cable, host: u8, seed: u64) -> Self {
        let mut config = Config::new(HardwareAddress::Ethernet(EthernetAddress(mac(host))));
        config.random_seed = seed;
        let mut interface = Interface::new(config, cable, smol(now));
        interface.update_ip_addrs(|addresses| {
            addresses.push(IpCidr::Ipv4(Ipv4Cidr::new(Ipv4Addr::new(10, 0, 0, host), 24))).unwrap();
        });
        let bytes = |count| vec![0; count];
        let packets = || udp::PacketBuffer::new(vec![udp::PacketMetadata::EMPTY; 64], bytes(32 * 1024));
        let mut datagrams = udp::Socket::new(packets(), packets());
        datagrams.bind(PLAIN_PORT).unwrap();
        let mut sockets = SocketSet::new(Vec::new());
        let datagrams = sockets.add(datagrams);
        let stream = || {
            let buffer = || tcp::SocketBuffer::new(bytes(8 * 1024));
            let mut socket = tcp::Socket::new(buffer(), buffer());
            socket.set_nagle_enabled(false);
            socket
        };
        let streams = (0..LINKS).map(|_| sockets.add(stream())).collect();
        Self { interface, sockets, streams, datagrams }
    }

    fn stream(&mut self, index: usize) -> &mut tcp::Socket<'static> {
        self.sockets.get_mut(self.streams[index])
    }
}

macro_rules! context {
    ($manager:expr, $now:expr) => {
        &mut Context {
            now: $now,
            mailman: &mut $manager.net,
            buffers: &mut $manager.buffers,
            functions: &$manager.functions,
            access: None,
            hub: &mut $manager.hub,
            keys: &mut (),
        }
    };
}

impl Manager {
    pub(crate) fn new(now: Instant, mut cable: Cable, host: u8, seed: u64) -> Self {
        let config = NodeConfig {
            identity: Identity::m_unit("manager", 1).unwrap(),
            fleet: Fleet(0),
            epoch: Epoch(seed.wrapping_mul(31) + now.as_micros()),
            target: Target::Everybody,
            tcp_port: TCP_PORT,
            udp_port: PLAIN_PORT,
            constraints: Constraints::M_UNIT,
            seed: seed ^ 0x5EED,
        };
        let storage = NodeStorage {
            nodes: Boxed::slice(2 * LINKS),
            order: Boxed::slice(2 * LINKS),
            links: Boxed::slice(LINKS),
            findings: Boxed::slice(8),
        };
        let mut functions = FunctionList::new(Boxed::slice(FUNCTIONS), Boxed::slice(FUNCTIONS * 96));
        let mechanic = Definition::parse("mechanic(number: int) -> (number: int)").unwrap();
        let slot = functions.add_function(&mechanic, Attributes::default(), ()).unwrap();
        let mut publications = Publications::new(Boxed::slice(FUNCTIONS), Boxed::slice(0));
        publications.publish_to_all(slot).unwrap();
        let size = buffer_bytes(Constraints::M_UNIT.message_size, 0);
        Self {
            net: Net::new(now, &mut cable, host, seed),
            cable,
            hub: Hub { node: Node::new(now, config, storage), publications },
            sessions: (0..LINKS).map(|_| None).collect(),
            functions,
            buffers: Pool::new((0..8).map(|_| Some(Boxed::slice(size))).collect()),
            arguments: Box::new(Parameters::sized()),
            replies: Vec::new(),
            left: Vec::new(),
            served: 0,
            live: [false; LINKS],
            due: now,
        }
    }

    /// When it is to be polled.
    pub(crate) fn next(&self) -> Instant {
        let arrival = self.cable.switch.borrow().next_arrival(self.cable.port);
        self.due.min(arrival.unwrap_or(Instant::FAR_FUTURE))
    }

    pub(crate) fn joined(&self) -> usize {
        self.hub.node.number_of_s_units()
    }

    pub(crate) fn keep_alives_missed(&self) -> u64 {
        let missed = cara_core::host::connections::LinkCounter::KeepAlivesMissed;
        self.sessions.iter().flatten().map(|session| session.counters().value(missed)).sum()
    }

    /// Indices of the links that are live.
    pub(crate) fn links(&self) -> Vec<usize> {
        let live = |session: &Option<Session<OnHost>>| session.as_ref().is_some_and(Session::is_live);
        (0..LINKS).filter(|&index| live(&self.sessions[index])).collect()
    }

    /// Calls a vehicle.
    pub(crate) fn call(&mut self, now: Instant, link: usize, function: &str, value: i64) -> Result<CallId, Error> {
        self.request(now, link, function, value, &RequestOptions::default(), true)
    }

    pub(crate) fn request(
        &mut self,
        now: Instant,
        link: usize,
        function: &str,
        value: i64,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        let session = self.sessions[link].as_mut().ok_or(Error::NotConnected)?;
        self.due = Instant::START;
        session.request(context!(self, now), function.into(), &number(value), options, wants_reply)
    }

    pub(crate) fn poll(&mut self, now: Instant) {
        for index in 0..LINKS {
            self.poll_session(now, index);
        }
        self.net.interface.poll(smol(now), &mut self.cable, &mut self.net.sockets);
        self.take_datagrams(now);
        for index in 0..LINKS {
            self.work(now, index);
        }
        while let Some(command) = self.hub.node.poll(now, &mut self.net, &Plain) {
            self.act(now, command);
        }
        self.net.interface.poll(smol(now), &mut self.cable, &mut self.net.sockets);
        let due = self.net.interface.poll_at(smol(now), &self.net.sockets);
        let due = due.map_or(Instant::FAR_FUTURE, |due| Instant::from_micros(due.total_micros() as u64));
        let sessions = self.sessions.iter().flatten().map(Session::deadline).min();
        self.due = due.min(sessions.unwrap_or(Instant::FAR_FUTURE)).min(self.hub.node.next_deadline());
    }

    fn take_datagrams(&mut self, now: Instant) {
        let mut bytes = [0; 2_048];
        loop {
            let received = self.net.sockets.get_mut::<udp::Socket>(self.net.datagrams).recv_slice(&mut bytes);
            let Ok((length, from)) = received else { return };
            let SocketAddr::V4(from) = from.endpoint.into() else { continue };
            let for_session = datagram::for_session(&mut bytes[..length], Mode::Plain, self.hub.node.fleet());
            if let Some((LinkId(link), nonce, body)) = for_session
                && let Some(Some(session)) = self.sessions.get_mut(usize::from(link))
            {
                let event = session.datagram(context!(self, now), from, nonce, body);
                self.happened(now, usize::from(link), event, &[]);
            } else {
                self.hub.node.datagram(now, from, &bytes[..length], &Plain);
            }
        }
    }

    fn work(&mut self, now: Instant, index: usize) {
        self.follow_stream(now, index);
        while self.receive(now, index) {}
        while let Some(session) = &mut self.sessions[index]
            && let Some(call) = session.next_call(context!(self, now), &mut *self.arguments)
        {
            self.happened(now, index, Some(Event::Incoming(call)), &[]);
        }
        self.poll_session(now, index);
    }

    fn follow_stream(&mut self, now: Instant, index: usize) {
        let stream = self.net.stream(index);
        let (state, open, room) = (stream.state(), stream.may_recv(), stream.can_send());
        match &mut self.sessions[index] {
            None if state == tcp::State::Closed => stream.listen(TCP_PORT).unwrap(),
            None if state == tcp::State::Established => self.open(now, index),
            None => {}
            Some(session) if !open => session.disconnected(CloseReason::Reset),
            Some(session) if room && session.wants_to_write() => session.writable(context!(self, now)),
            Some(_) => {}
        }
    }

    fn open(&mut self, now: Instant, index: usize) {
        let link = LinkId(index as u16);
        let SocketAddr::V4(address) = self.net.stream(index).remote_endpoint().unwrap().into() else { return };
        let nonce = self.hub.node.nonce();
        let storage = SessionStorage {
            small: Boxed::slice(LINK_BUFFER_BYTES),
            pending: Boxed::slice(CALLS),
            running: Boxed::slice(CALLS + 1),
            publications: Boxed::slice(FUNCTIONS),
            their_functions: Boxed::slice(FUNCTIONS),
            their_signatures: Boxed::slice(FUNCTIONS * 96),
        };
        let config = SessionConfig { link, dialed: false, address, nonce, constraints: Constraints::M_UNIT };
        let mut session = Session::new(now, config, Plain, storage);
        session.connected(context!(self, now));
        self.sessions[index] = Some(session);
    }

    fn receive(&mut self, now: Instant, index: usize) -> bool {
        let Some(session) = &mut self.sessions[index] else { return false };
        let mut lent = [0; 2_048];
        let stream = self.net.sockets.get_mut::<tcp::Socket>(self.net.streams[index]);
        let come = stream.peek(lent.len()).unwrap_or(&[]);
        let length = come.len();
        lent[..length].copy_from_slice(come);
        let receipt = session.receive(context!(self, now), &mut lent[..length], Some(&mut *self.arguments));
        let _ = self.net.stream(index).recv(|bytes| (receipt.consumed.min(bytes.len()), ()));
        self.happened(now, index, receipt.event, &lent);
        receipt.consumed > 0 || receipt.event.is_some()
    }

    fn poll_session(&mut self, now: Instant, index: usize) {
        while let Some(session) = &mut self.sessions[index]
            && let Some(event) = session.poll(context!(self, now))
        {
            self.happened(now, index, Some(event), &[]);
        }
    }

    fn happened(&mut self, now: Instant, index: usize, event: Option<Event>, lent: &[u8]) {
        match event {
            Some(Event::Joined) => self.live[index] = true,
            Some(Event::Incoming(call)) => {
                self.served += 1;
                let Some(session) = &mut self.sessions[index] else { return };
                session.answer(context!(self, now), call.ticket, Ok(&*self.arguments)).unwrap();
            }
            Some(Event::Reply(id, outcome)) => {
                let Some(session) = &self.sessions[index] else { return };
                let outcome = outcome.and_then(|places| {
                    let mut results = number(0);
                    session.results(&places, lent)?.read_into(&mut results)?;
                    results.variable::<[i64; 1]>("number").map(|[number]| number)
                });
                self.replies.push((index, id, outcome));
            }
            Some(Event::Closed(reason)) => self.leave(now, index, reason),
            _ => {}
        }
    }

    fn act(&mut self, now: Instant, command: Command<SocketAddrV4>) {
        let Command::Notify(link, directive) = command else { unreachable!("a lone manager dials nobody") };
        let index = usize::from(link.0);
        let Some(session) = &mut self.sessions[index] else { return };
        let event = session.direct(context!(self, now), directive);
        self.happened(now, index, event, &[]);
        self.poll_session(now, index);
    }

    fn leave(&mut self, now: Instant, index: usize, reason: CloseReason) {
        self.sessions[index] = None;
        self.net.stream(index).close();
        if std::mem::take(&mut self.live[index]) {
            self.left.push((now, reason));
        }
        self.hub.node.left(now, LinkId(index as u16), reason);
    }
}

fn smol(now: Instant) -> smoltcp::time::Instant {
    smoltcp::time::Instant::from_micros(now.as_micros() as i64)
}
