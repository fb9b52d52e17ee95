//! A manager and a vehicle whose frames and datagrams go through the attacker's hands.

use std::collections::VecDeque;
use std::net::SocketAddr;

use cara_core::config::{Constraints, Mode, Priority};
use cara_core::distribution::connection_handler::{NodeConfig, Target};
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::{Entry, FunctionList};
use cara_core::distribution::hello::{Hello, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::distribution::parameters::Parameters;
use cara_core::error::CloseReason;
use cara_core::host::connections::LinkCounter;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::services::heart::Renew;
use cara_core::services::hub::Hub;
use cara_core::services::lease::{ActuatorState, Lease, Service};
use cara_core::services::session::{Event, RequestOptions, Session, SessionConfig, SessionStorage, buffer_bytes};
use cara_core::services::{Context, Keys, Port};
use cara_core::storage::Pool;
use cara_core::time::{Duration, Instant};
use cara_secure::keys::{PairKey, RootKey};
use cara_secure::link::{Cipher, Credentials};
use cara_sim::{Boxed, hub};

const FLEET: Fleet = Fleet(7);
const BUFFERS: usize = 6;
/// What is drawn for later proofs differs by this from what was drawn for the first one.
const LATER: u8 = 0x40;
/// How old keys become in a conversation in which they are made anew.
const RENEWAL: Duration = Duration::from_secs(2);

/// What an end has sent.
#[derive(Default)]
struct Sent {
    stream: Vec<u8>,
    datagrams: VecDeque<Vec<u8>>,
    /// The network takes nothing more into the stream.
    full: bool,
}

impl Mailman<SocketAddr> for Sent {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let bytes = if self.full { Vec::new() } else { slices.concat() };
        self.stream.extend(&bytes);
        Ok(bytes.len())
    }

    fn send_to(&mut self, _: SocketAddr, datagram: &[u8]) -> bool {
        self.datagrams.push_back(datagram.to_vec());
        true
    }

    fn broadcast(&mut self, _: &[u8]) -> bool {
        false
    }
}

/// These ends, as the core's port.
pub(crate) enum Attacked {}

impl Port for Attacked {
    type Storage = Boxed;
    type Cipher = Cipher;
    type Endpoint = SocketAddr;
}

/// The keys of an end.
pub(crate) struct Ring {
    /// The key that it proves, and one that it takes as well. Without one it refuses.
    pub(crate) keys: Option<(PairKey, Option<PairKey>)>,
    /// What it draws for the first proof of its link, and for each later one.
    draws: [u8; 2],
}

impl Keys<Attacked> for Ring {
    fn credentials(&mut self, _: &Hello) -> Option<Credentials> {
        let [drawn, later] = self.draws;
        self.draws = [later, later];
        let (key, other) = self.keys.clone()?;
        Some(Credentials::new(key, [drawn; 32]).or(other))
    }
}

/// What a service moves, if anything.
pub(crate) struct Moves(Option<Lease>);

impl Service for Moves {
    fn lease(&self) -> Option<&Lease> {
        self.0.as_ref()
    }
}

/// One end.
pub(crate) struct End {
    pub(crate) session: Session<Attacked>,
    functions: FunctionList<Boxed, Moves>,
    pool: Pool<Boxed>,
    sent: Sent,
    now: Instant,
    pub(crate) ring: Ring,
    hub: Hub<Attacked>,
    /// Services that ran.
    pub(crate) ran: u32,
    pub(crate) closed: Option<CloseReason>,
}

macro_rules! context {
    ($end:expr) => {
        &mut Context {
            now: $end.now,
            mailman: &mut $end.sent,
            buffers: &mut $end.pool,
            functions: &$end.functions,
            access: None,
            hub: &mut $end.hub,
            keys: &mut $end.ring,
        }
    };
}

fn names() -> [Identity; 2] {
    [Identity::m_unit("depot", 1), Identity::s_unit("agv", 17)].map(|name| name.expect("a name"))
}

/// The key of the two.
pub(crate) fn key() -> PairKey {
    let [manager, agv] = names();
    RootKey::new([1; 32]).pair(FLEET, 1, &manager, &agv)
}

fn config_of(identity: Identity, target: Target<SocketAddr>) -> NodeConfig<SocketAddr> {
    let constraints = Constraints { message_size: 1_024, chunk_size: 1_024, calls_per_peer: 4, ..Constraints::M_UNIT };
    NodeConfig { identity, fleet: FLEET, epoch: Epoch(1), target, tcp_port: 0, udp_port: 7_001, constraints, seed: 1 }
}

impl End {
    fn new(agv: bool, run: u8, key: PairKey, fresh: u8) -> Self {
        Self::with_cipher(agv, run, key, fresh, Cipher::new(Mode::Secured))
    }

    fn with_cipher(agv: bool, run: u8, key: PairKey, fresh: u8, cipher: Cipher) -> Self {
        let constraints = Constraints { chunk_size: 1_024, ..Constraints::S_UNIT };
        let storage = SessionStorage {
            small: Boxed::slice(512),
            pending: Boxed::slice(8),
            running: Boxed::slice(9),
            publications: Boxed::slice(4),
            their_functions: (0..4).map(|_| Entry::empty()).collect(),
            their_signatures: Boxed::slice(256),
        };
        let config = SessionConfig {
            link: LinkId(u16::from(agv)),
            dialed: agv,
            address: SocketAddr::from(([10, 0, 0, 1], 7_001)),
            nonce: 0x1_0000 + u64::from(run) * 2 + u64::from(agv),
            constraints,
        };
        let now = Instant::START + Duration::from_secs(5);
        let size = buffer_bytes(1_024, 16);
        let mut functions = FunctionList::new((0..4).map(|_| Entry::empty()).collect(), Boxed::slice(512));
        let stop = Definition::parse("stop(n: int)").expect("a signature");
        let slot = functions.add_function(&stop, Attributes::default(), Moves(None)).expect("room for it");
        let hub = {
            let [manager, _] = names();
            let (target, identity) = match agv {
                true => {
                    (Target::Manager(Manager::new(manager.name(), manager.id()).expect("a name")), names()[1].clone())
                }
                false => (Target::Everybody, manager),
            };
            let mut hub = hub(now, config_of(identity, target), 2, 4);
            hub.publications.publish_to_all(slot).expect("room for it");
            hub
        };
        Self {
            session: Session::new(now, config, cipher, storage),
            functions,
            pool: Pool::new((0..BUFFERS).map(|_| Some(Boxed::slice(size))).collect()),
            sent: Sent::default(),
            now,
            ring: Ring { keys: Some((key, None)), draws: [fresh, fresh ^ LATER] },
            hub,
            ran: 0,
            closed: None,
        }
    }

    /// Takes bytes of the stream, whole or not.
    pub(crate) fn hear(&mut self, bytes: &[u8]) {
        let mut bytes = bytes.to_vec();
        let mut arguments = Parameters::<256>::sized();
        loop {
            let receipt = self.session.receive(context!(self), &mut bytes, Some(&mut arguments));
            let quiet = receipt.consumed == 0 && receipt.event.is_none();
            let consumed = receipt.consumed;
            if let Some(Event::Incoming(call)) = receipt.event {
                self.ran += 1;
                let _ = self.session.answer(context!(self), call.ticket, Ok(&arguments));
            }
            bytes.drain(..consumed);
            if quiet {
                break;
            }
        }
        self.work();
    }

    /// Takes a datagram, if it is for this end's link.
    pub(crate) fn hear_datagram(&mut self, datagram: &[u8]) {
        let mut body = datagram.get(24..).unwrap_or(&[]).to_vec();
        let from = self.session.address();
        let nonce = datagram.get(16..24).and_then(|nonce| nonce.try_into().ok()).map_or(0, u64::from_le_bytes);
        let _ = self.session.datagram(context!(self), from, nonce, &mut body);
        self.work();
    }

    /// The hub has accepted the peer, which has proven its identity.
    pub(crate) fn greeted(&self) -> bool {
        self.hub.node.connected() > 0
    }

    fn work(&mut self) {
        let mut arguments = Parameters::<256>::sized();
        while let Some(call) = self.session.next_call(context!(self), &mut arguments) {
            self.ran += 1;
            let _ = self.session.answer(context!(self), call.ticket, Ok(&arguments));
        }
        while let Some(event) = self.session.poll(context!(self)) {
            if let Event::Closed(reason) = event {
                self.closed = Some(reason);
            }
        }
    }

    /// Requests `stop` of the peer; an emergency goes as a datagram as well.
    pub(crate) fn call(&mut self, priority: Priority) {
        let mut parameters = Parameters::<64>::sized();
        parameters.add_int("n", 1).expect("room for it");
        let options = RequestOptions { priority: Some(priority), ..RequestOptions::default() };
        let _ = self.session.request(context!(self), "stop".into(), &parameters, &options, false);
        self.session.flush_gathered(context!(self));
    }

    /// Offers a function, before the ends meet.
    fn offer(&mut self, signature: &str, attributes: Attributes, moves: Moves) {
        let definition = Definition::parse(signature).expect("a signature");
        let slot = self.functions.add_function(&definition, attributes, moves).expect("room for it");
        self.hub.publications.publish_to_all(slot).expect("room for it");
    }

    /// Asks for `function`, and renews it if it has a lease, until [`Self::give_up`].
    pub(crate) fn order(&mut self, function: &str) {
        let options = RequestOptions::renewing(Renew::Process);
        let asked = self.session.request(context!(self), function.into(), &Parameters::<64>::sized(), &options, false);
        assert!(asked.is_ok(), "{function}: {asked:?}");
        self.session.flush_gathered(context!(self));
    }

    /// Wants what it has asked for last no longer.
    pub(crate) fn give_up(&mut self) {
        let (_, call) = self.session.last_order().expect("it has asked for something");
        self.session.cancel(context!(self), call);
    }

    /// What the vehicle moves, as its motors see it.
    pub(crate) fn drive(&self) -> Drive {
        let lease = self.functions.iter().find_map(|function| function.handler.lease()).expect("it moves something");
        let left = lease.left(self.now).filter(|_| lease.is_live(self.now));
        Drive { left, state: lease.state(), ran: self.ran }
    }

    /// The network takes nothing more into the stream, and all room for frames of the protocol itself is in use.
    pub(crate) fn clog(&mut self) {
        self.sent.full = true;
        while self.session.ping(context!(self)).is_ok() {}
    }

    /// The network goes on.
    pub(crate) fn unclog(&mut self) {
        self.sent.full = false;
        self.session.writable(context!(self));
    }

    pub(crate) fn wait(&mut self, span: Duration) {
        self.now = self.now + span;
        self.work();
    }

    pub(crate) fn counted(&self, counter: LinkCounter) -> u64 {
        self.session.counters().value(counter)
    }

    pub(crate) fn has_all_buffers(&self) -> bool {
        self.pool.free() == BUFFERS
    }

    /// The next whole frame that it has sent.
    fn next_frame(&mut self) -> Option<Vec<u8>> {
        let length = usize::from(u16::from_le_bytes(*self.sent.stream.first_chunk()?)) + 2;
        (self.sent.stream.len() >= length).then(|| self.sent.stream.drain(..length).collect())
    }
}

/// How the vehicle's drive stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Drive {
    /// How long it moves on, if it does.
    pub(crate) left: Option<Duration>,
    pub(crate) state: ActuatorState,
    pub(crate) ran: u32,
}

/// Something on its way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Carried {
    pub(crate) to_manager: bool,
    pub(crate) datagram: bool,
    pub(crate) bytes: Vec<u8>,
}

/// Both ends.
pub(crate) struct Ends {
    pub(crate) manager: End,
    pub(crate) agv: End,
    steps: usize,
}

impl Ends {
    /// Two ends of the right key whose connection is open. The random numbers of each run are its own.
    pub(crate) fn new(run: u8) -> Self {
        Self::with_keys(run, key(), key())
    }

    /// As [`Self::new`], of whom the manager, the vehicle, both or neither offer AES.
    pub(crate) fn offering(run: u8, manager: bool, agv: bool) -> Self {
        let cipher = |aes| if aes { Cipher::new(Mode::Secured).offering_aes() } else { Cipher::new(Mode::Secured) };
        let manager = End::with_cipher(false, run, key(), run, cipher(manager));
        Self::made(manager, End::with_cipher(true, run, key(), run | 0x80, cipher(agv)))
    }

    pub(crate) fn with_keys(run: u8, manager: PairKey, agv: PairKey) -> Self {
        Self::made(End::new(false, run, manager, run), End::new(true, run, agv, run | 0x80))
    }

    /// Two ends of which the vehicle moves by `go()`, is stopped by `halt()` and reset by `free()`.
    pub(crate) fn moving(run: u8) -> Self {
        let mut agv = End::new(true, run, key(), run | 0x80);
        let plain = Attributes::default();
        let moves = Attributes { lease: Some(Duration::from_millis(400)), ..plain };
        agv.offer("go()", moves, Moves(Some(Lease::new())));
        agv.offer("halt()", Attributes { stop: true, priority: Priority::Emergency, ..plain }, Moves(None));
        agv.offer("free()", Attributes { reset: true, ..plain }, Moves(None));
        Self::made(End::new(false, run, key(), run), agv)
    }

    /// Two ends that draw the same numbers, the same in each run and for each proof; only the nonces of their hellos differ.
    pub(crate) fn repeating(run: u8) -> Self {
        let mut ends = Self::made(End::new(false, run, key(), 9), End::new(true, run, key(), 9));
        for end in [&mut ends.manager, &mut ends.agv] {
            end.ring.draws = [9; 2];
        }
        ends.with_renewal()
    }

    /// As [`Self::new`], in whose conversation the keys are made anew, and the manager calls twice more.
    pub(crate) fn renewing(run: u8) -> Self {
        Self::new(run).with_renewal()
    }

    fn with_renewal(mut self) -> Self {
        self.agv.session.renew_every(RENEWAL);
        self.steps = 8;
        self
    }

    fn made(manager: End, agv: End) -> Self {
        let mut ends = Self { manager, agv, steps: 4 };
        ends.manager.session.connected(context!(ends.manager));
        ends.agv.session.connected(context!(ends.agv));
        ends
    }

    pub(crate) fn end(&mut self, manager: bool) -> &mut End {
        if manager { &mut self.manager } else { &mut self.agv }
    }

    /// The next thing on its way: the vehicle's before the manager's, frames before datagrams.
    pub(crate) fn next(&mut self) -> Option<Carried> {
        for to_manager in [true, false] {
            if let Some(bytes) = self.end(!to_manager).next_frame() {
                return Some(Carried { to_manager, datagram: false, bytes });
            }
        }
        for to_manager in [true, false] {
            if let Some(bytes) = self.end(!to_manager).sent.datagrams.pop_front() {
                return Some(Carried { to_manager, datagram: true, bytes });
            }
        }
        None
    }

    pub(crate) fn deliver(&mut self, carried: &Carried) {
        let end = self.end(carried.to_manager);
        if carried.datagram { end.hear_datagram(&carried.bytes) } else { end.hear(&carried.bytes) }
    }

    /// A whole conversation: both join and publish, then the manager calls twice, once in an emergency. `carry` sees
    /// everything on its way, with its number, and delivers what it likes.
    pub(crate) fn converse(&mut self, mut carry: impl FnMut(&mut Self, usize, Carried)) {
        let mut number = 0;
        for step in 0..self.steps {
            match step {
                1 | 5 => self.manager.call(Priority::Normal),
                2 | 6 => self.manager.call(Priority::Emergency),
                3 | 4 | 7 => [true, false].into_iter().for_each(|end| self.end(end).wait(Duration::from_secs(1))),
                _ => {}
            }
            while let Some(carried) = self.next() {
                carry(self, number, carried);
                number += 1;
            }
        }
    }

    /// Carries everything that is on its way.
    pub(crate) fn carry(&mut self) {
        while let Some(carried) = self.next() {
            self.deliver(&carried);
        }
    }

    /// The same, undisturbed; all that was carried.
    pub(crate) fn recorded(run: u8) -> Vec<Carried> {
        Self::new(run).record()
    }

    /// All that is carried in an undisturbed conversation.
    pub(crate) fn record(mut self) -> Vec<Carried> {
        let mut record = Vec::new();
        self.converse(|ends, _, carried| {
            ends.deliver(&carried);
            record.push(carried);
        });
        assert!(self.manager.session.is_live() && self.agv.session.is_live());
        assert_eq!(self.agv.ran as usize, self.steps / 2, "each call ran once");
        record
    }
}
