//! A unit behind scripts: the core's machines, driven as the front page of `cara_core::services` says, checked after each step.

mod motors;
pub(crate) mod services;

use std::collections::{BTreeMap, BTreeSet};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::rc::Rc;

use cara_core::config::{Constraints, LINK_BUFFER_BYTES, Mode};
use cara_core::distribution::authenticator::Authenticator as _;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::{ClaimEvent, Command, Node, NodeConfig, NodeStorage, Target};
use cara_core::distribution::datagram::{Datagram, for_session};
use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::distribution::hello::{Hello, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::services::access::{Access, Decision, Principal, Rule, Verb, Verbs, Who, decide};
use cara_core::services::hub::Hub;
use cara_core::services::publications::Publications;
use cara_core::services::session::{
    Event, Incoming, Publication, Session, SessionConfig, SessionStorage, buffer_bytes,
};
use cara_core::services::{Context, Keys, Port, slots_for};
use cara_core::storage::{Buffers as _, Pool};
use cara_core::time::{Duration, Instant};
use cara_secure::keyring::{Codes, Keyring as _};
use cara_secure::link::{Cipher, Credentials};
use cara_sim::{Boxed, Ring};
use motors::Motor;
use services::{FUNCTIONS, Handler};

/// The fleet of all units.
pub(crate) const FLEET: Fleet = Fleet(7);
/// Most links of a unit.
pub(crate) const LINKS: usize = 3;
/// The roots of the fleet's keys, and of another one.
pub(crate) const ROOTS: [u8; 2] = [1, 2];
/// Bytes of the longest message, and of the variables of a call.
const MESSAGE_BYTES: u32 = 1_024;
const BUFFERS: usize = 5;
/// More rounds than anything that comes to rest needs.
const ROUNDS: usize = 20_000;

/// The port.
pub(crate) enum Fuzzed {}

impl Port for Fuzzed {
    type Storage = Boxed;
    type Cipher = Cipher;
    type Endpoint = SocketAddrV4;
}

/// Where what the unit writes and sends goes.
#[derive(Default)]
pub(crate) struct Mail {
    /// Bytes that each link's stream takes until its peer reads it.
    pub(crate) capacity: usize,
    pub(crate) streams: [Vec<u8>; LINKS],
    pub(crate) datagrams: Vec<(SocketAddrV4, Vec<u8>)>,
    broadcasts: Vec<Vec<u8>>,
    nonce: Option<u64>,
}

impl Mail {
    /// The nonce of the last question, as everybody on the network hears it.
    pub(crate) fn asked(&self) -> Option<u64> {
        self.nonce
    }

    fn note(&mut self, datagram: &[u8], codes: &Codes<Ring>) {
        if let Ok(Datagram::WhoHas(search)) = Datagram::decode(datagram, FLEET, codes) {
            self.nonce = Some(search.nonce);
        }
    }
}

impl Mailman<SocketAddrV4> for Mail {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let stream = &mut self.streams[usize::from(link.0)];
        let before = stream.len();
        for slice in slices {
            let count = slice.len().min(self.capacity.saturating_sub(stream.len()));
            stream.extend_from_slice(&slice[..count]);
        }
        Ok(stream.len() - before)
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        self.datagrams.push((to, datagram.to_vec()));
        true
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.broadcasts.push(datagram.to_vec());
        true
    }
}

/// The unit's keys.
pub(crate) struct Keyed {
    pub(crate) codes: Codes<Ring>,
    drawn: u8,
}

impl Keyed {
    pub(crate) fn new(mode: Mode, root: u8, own: Identity) -> Self {
        let codes = match mode {
            Mode::Plain => Codes::Plain,
            Mode::Secured => Codes::Keyed(Ring::new(root, own, FLEET)),
        };
        Self { codes, drawn: 0 }
    }

    pub(crate) fn credentials_for(&mut self, peer: &Identity) -> Option<Credentials> {
        let Codes::Keyed(ring) = &self.codes else { return None };
        self.drawn = self.drawn.wrapping_add(1);
        ring.credentials(peer, [self.drawn; 32])
    }
}

impl Keys<Fuzzed> for Keyed {
    fn credentials(&mut self, hello: &Hello) -> Option<Credentials> {
        self.credentials_for(&hello.identity)
    }
}

/// An access table.
pub(crate) struct Table(Vec<Rule>);

impl Access for Table {
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        decide(&self.0, who, function, verb)
    }
}

/// One link.
pub(crate) struct Link {
    pub(crate) session: Session<Fuzzed>,
    /// Bytes that have come and were not consumed.
    pub(crate) inbox: Vec<u8>,
    /// Calls whose handlers have not answered, and how often their motors were stopped when they began.
    pub(crate) held: Vec<(Incoming, Stops)>,
    unanswered: Vec<(Incoming, Result<i64, Error>, Option<Stops>)>,
    /// The unit's own calls that have not ended, and whether each waits for a reply.
    pub(crate) asked: BTreeMap<u32, bool>,
    /// By call: the latest time at which the peer can have wanted it, as it said.
    pub(crate) said: BTreeMap<u32, Instant>,
    /// Bytes have come that need not be what the peer has said: then anything may have been wanted when something came last.
    pub(crate) is_loose: bool,
    came: Instant,
    /// Calls that moved something when the peer released them, with their functions: ids of two classes may be equal.
    pub(crate) released: BTreeSet<(u32, Slot)>,
    pub(crate) joined: bool,
}

impl Link {
    /// Until when the peer can have wanted a call.
    fn wanted(&self, call: u32, slot: Slot) -> Instant {
        if self.inbox.is_empty() && self.released.contains(&(call, slot)) {
            return Instant::START;
        }
        let said = self.said.get(&call).copied().unwrap_or(Instant::START);
        if self.is_loose { said.max(self.came) } else { said }
    }
}

/// How often each motor had been stopped.
type Stops = [u32; services::LEASES.len()];

/// The variables of a call.
pub(crate) type Arguments = Parameters<512>;

/// A unit.
pub(crate) struct Unit {
    pub(crate) now: Instant,
    pub(crate) hub: Hub<Fuzzed>,
    pub(crate) functions: FunctionList<Boxed, Handler>,
    pub(crate) pool: Pool<Boxed>,
    pub(crate) starved: Vec<Box<[u8]>>,
    pub(crate) table: Option<Table>,
    pub(crate) keys: Keyed,
    pub(crate) mail: Mail,
    pub(crate) links: [Option<Link>; LINKS],
    pub(crate) motors: Vec<Motor>,
    /// Where it wants to dial.
    pub(crate) dials: Vec<(SocketAddrV4, Option<Identity>)>,
    /// Whether claims can be stored.
    pub(crate) stores: bool,
    /// The highest claim that it has made, and those that it has obeyed of `identity(1)` and `identity(3)`.
    highest: [Claim; 3],
    /// Lent to each call.
    arguments: Option<Box<Arguments>>,
}

/// The identities of all units: a vehicle, its manager, and others.
pub(crate) fn identity(index: u8) -> Identity {
    match index {
        0 => Identity::s_unit("agv", 7),
        1 => Identity::m_unit("depot", 1),
        2 => Identity::s_unit("agv-2", 8),
        3 => Identity::m_unit("other", 2),
        4 => Identity::s_unit("agv", 9),
        _ => Identity::s_unit("agv-5", u32::from(index)),
    }
    .expect("the names are valid")
}

pub(crate) fn manager() -> Manager {
    Manager::new("depot", 1).expect("the name is valid")
}

pub(crate) fn address(host: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(192, 0, 2, host), 7_000)
}

impl Unit {
    /// A unit that starts: a manager, or a vehicle of that manager.
    pub(crate) fn new(now: Instant, role: Role, mode: Mode, seed: u64) -> Self {
        let is_manager = role == Role::MUnit;
        let identity = identity(u8::from(is_manager));
        let target = if is_manager { Target::Everybody } else { Target::Manager(manager()) };
        let constraints = if is_manager { Constraints::M_UNIT } else { Constraints::S_UNIT };
        let constraints =
            Constraints { maximum_nodes: 2, message_size: MESSAGE_BYTES, calls_per_peer: 6, ..constraints };
        let config = NodeConfig {
            identity: identity.clone(),
            fleet: FLEET,
            epoch: Epoch(9),
            target,
            tcp_port: if is_manager { 7_000 } else { 0 },
            udp_port: 7_000,
            constraints,
            seed,
        };
        let storage = NodeStorage {
            nodes: Boxed::slice(5),
            order: Boxed::slice(5),
            links: Boxed::slice(LINKS),
            findings: Boxed::slice(2),
        };
        let mut node = Node::new(now, config, storage);
        node.store_claims();
        let publications = Publications::new(Boxed::slice(FUNCTIONS + 1), Boxed::slice(4));
        let motors = Motor::all();
        let leases: Vec<_> = motors.iter().map(|motor| Rc::clone(&motor.lease)).collect();
        let buffer = buffer_bytes(MESSAGE_BYTES, 16);
        let mut unit = Self {
            now,
            hub: Hub { node, publications },
            functions: services::functions(&leases),
            pool: Pool::new((0..BUFFERS).map(|_| Some(Boxed::slice(buffer))).collect()),
            starved: Vec::new(),
            table: None,
            keys: Keyed::new(mode, ROOTS[0], identity),
            mail: Mail { capacity: 1 << 16, ..Mail::default() },
            links: std::array::from_fn(|_| None),
            motors,
            dials: Vec::new(),
            stores: true,
            highest: [Claim::NONE; 3],
            arguments: None,
        };
        for slot in 0..FUNCTIONS {
            unit.hub.publications.publish_to_all(Slot(slot as u16)).expect("the table has capacity");
        }
        unit
    }

    pub(crate) fn mode(&self) -> Mode {
        self.keys.codes.mode()
    }

    /// Does something to a link, if it is there.
    pub(crate) fn with<R>(
        &mut self,
        link: usize,
        act: impl FnOnce(&mut Link, &mut Context<'_, Fuzzed>) -> R,
    ) -> Option<R> {
        let Self { now, hub, functions, pool, table, keys, mail, links, .. } = self;
        let access = table.as_ref().map(|table| table as &dyn Access);
        let mut cx = Context { now: *now, mailman: mail, buffers: pool, functions, access, hub, keys };
        links.get_mut(link)?.as_mut().map(|link| act(link, &mut cx))
    }

    /// A stream is open, dialled by the unit or by its peer.
    pub(crate) fn open(&mut self, index: usize, dialed: bool, host: u8, identity: Option<&Identity>) {
        let nonce = self.hub.node.nonce();
        let link = LinkId(index as u16);
        let constraints = *self.hub.node.constraints();
        let config = SessionConfig { link, dialed, address: address(host), nonce, constraints };
        let storage = SessionStorage {
            small: Boxed::slice(LINK_BUFFER_BYTES),
            pending: Boxed::slice(4),
            running: Boxed::slice(slots_for(3)),
            publications: (0..FUNCTIONS + 1).map(|_| Publication::default()).collect(),
            their_functions: (0..6).map(|_| cara_core::distribution::function_list::Entry::empty()).collect(),
            their_signatures: Boxed::slice(256),
        };
        let session = Session::new(self.now, config, Cipher::new(self.mode()), storage);
        self.mail.streams[index].clear();
        self.links[index] = Some(Link {
            session,
            inbox: Vec::new(),
            held: Vec::new(),
            unanswered: Vec::new(),
            asked: BTreeMap::new(),
            said: BTreeMap::new(),
            is_loose: false,
            came: self.now,
            released: BTreeSet::new(),
            joined: false,
        });
        if dialed {
            self.hub.node.dialing(identity, link);
        }
        self.with(index, |link, cx| link.session.connected(cx));
    }

    /// Does all that can be done now.
    pub(crate) fn settle(&mut self) {
        for round in 0.. {
            assert!(round < ROUNDS, "the unit never comes to rest");
            let mut worked = false;
            for index in 0..LINKS {
                worked |= self.work(index);
            }
            worked |= self.work_node();
            if !worked {
                break;
            }
        }
        self.look_at_motors();
        self.check();
    }

    /// What must hold whenever the unit is at rest.
    fn check(&mut self) {
        let node = &self.hub.node;
        let makes = node.identity().role() == Role::MUnit && !node.is_standby();
        let made = if makes { node.claim() } else { self.highest[0] };
        let claims = [made, node.obeyed(&identity(1)), node.obeyed(&identity(3))];
        let become_lower = claims.iter().zip(&self.highest).any(|(claim, highest)| claim < highest);
        assert!(!become_lower, "a claim becomes lower");
        self.highest = claims;
        for link in self.links.iter().flatten() {
            assert!(link.session.deadline() > self.now, "a deadline passes and stays");
            assert!(!link.joined || !link.session.is_ended(), "a link has ended without an event");
            let held = link.held.len() + link.unanswered.len();
            assert!(usize::from(link.session.calls_held()) >= held, "a call runs and is not counted");
        }
        // A link may have them all: what is received takes the last one.
        if self.links.iter().all(Option::is_none) {
            assert_eq!(self.pool.free() + self.starved.len(), BUFFERS, "buffers are missing");
        }
        assert!(self.hub.node.next_deadline() > self.now, "a deadline of the node passes and stays");
        assert!(self.hub.node.nodes().count() <= 5);
    }

    fn work_node(&mut self) -> bool {
        let mut worked = false;
        loop {
            let Self { hub, mail, keys, now, .. } = self;
            let Some(command) = hub.node.poll(*now, mail, &keys.codes) else { break };
            worked = true;
            match command {
                Command::Dial { to, identity } => self.dials.push((to, identity)),
                Command::Notify(LinkId(link), directive) => {
                    let link = usize::from(link);
                    if let Some(Some(event)) = self.with(link, |link, cx| link.session.direct(cx, directive)) {
                        self.happened(link, event);
                    }
                }
            }
        }
        self.hear_questions();
        while let Some(event) = self.hub.node.take_claim_event() {
            worked = true;
            self.claim(event);
        }
        worked
    }

    /// Looks at what the unit has sent to all, and to addresses without a link.
    fn hear_questions(&mut self) {
        let Self { mail, keys, .. } = self;
        for datagram in std::mem::take(&mut mail.broadcasts) {
            mail.note(&datagram, &keys.codes);
        }
        for at in 0..mail.datagrams.len() {
            let datagram = std::mem::take(&mut mail.datagrams[at].1);
            mail.note(&datagram, &keys.codes);
            mail.datagrams[at].1 = datagram;
        }
        if mail.datagrams.len() > 64 {
            mail.datagrams.clear();
        }
    }

    fn claim(&mut self, event: ClaimEvent) {
        match event {
            ClaimEvent::Keep(manager, tagged) => {
                let stores = self.stores;
                self.hub.node.claim_kept(&manager, tagged.claim, stores);
            }
            ClaimEvent::Raise(above) if self.stores => {
                let claim = above.raised(5);
                let tagged = claim.tagged(&self.hub.node.identity().clone(), &self.keys.codes);
                self.hub.node.set_claim(tagged.unwrap_or_default());
                for index in 0..LINKS {
                    self.with(index, |link, cx| link.session.announce_claim(cx));
                }
            }
            ClaimEvent::Lead(above) => {
                let claim = self.highest[0].max(above).raised(6);
                let tagged = claim.tagged(&self.hub.node.identity().clone(), &self.keys.codes);
                let now = self.now;
                self.hub.node.lead(now, tagged.unwrap_or_default());
            }
            ClaimEvent::StepDown(_) => {
                for index in 0..LINKS {
                    self.with(index, |link, cx| link.session.close(cx, CloseReason::StoppedHere));
                }
            }
            _ => {}
        }
    }

    /// Lets a session do what is due; whether there was anything.
    fn poll(&mut self, index: usize) -> bool {
        let mut worked = false;
        while let Some(Some(event)) = self.with(index, |link, cx| link.session.poll(cx)) {
            worked = true;
            self.happened(index, event);
        }
        worked
    }

    /// Lets a link do what it can; whether there was anything.
    fn work(&mut self, index: usize) -> bool {
        let mut worked = false;
        loop {
            worked |= self.poll(index);
            let mut arguments = std::mem::take(&mut self.arguments).unwrap_or_default();
            let receipt = self.with(index, |link, cx| {
                link.came = if link.inbox.is_empty() { link.came } else { cx.now };
                link.session.receive(cx, &mut link.inbox, Some(&mut arguments))
            });
            self.arguments = Some(arguments);
            let Some(receipt) = receipt else { break };
            if let Some(event) = receipt.event {
                self.happened(index, event);
            }
            if let Some(link) = &mut self.links[index] {
                assert!(receipt.consumed <= link.inbox.len());
                link.inbox.drain(..receipt.consumed);
            }
            let more = receipt.consumed > 0 || receipt.event.is_some();
            worked |= more;
            if receipt.paused || !more {
                break;
            }
        }
        self.run_calls(index) | worked | self.answer_again(index)
    }

    fn run_calls(&mut self, index: usize) -> bool {
        let mut worked = false;
        loop {
            worked |= self.poll(index);
            let mut arguments = std::mem::take(&mut self.arguments).unwrap_or_default();
            let call = self.with(index, |link, cx| link.session.next_call(cx, &mut *arguments)).flatten();
            self.arguments = Some(arguments);
            let Some(call) = call else { return worked };
            worked = true;
            self.happened(index, Event::Incoming(call));
        }
    }

    fn answer_again(&mut self, index: usize) -> bool {
        let Some(link) = &mut self.links[index] else { return false };
        let unanswered = std::mem::take(&mut link.unanswered);
        let count = unanswered.len();
        for (call, result, stops) in unanswered {
            self.answer(index, call, result, stops);
        }
        self.links[index].as_ref().is_some_and(|link| link.unanswered.len() < count)
    }

    /// A handler answers: with `x` and everything else that its function returns, or with an error.
    pub(crate) fn answer(&mut self, index: usize, call: Incoming, result: Result<i64, Error>, stops: Option<Stops>) {
        let Some(function) = self.functions.function(call.slot) else { return };
        let (motor, resets) = (function.handler.motor, function.attributes.reset);
        let mut results = Arguments::sized();
        for spec in function.signature.arguments().chain(function.signature.results()) {
            let _ = results.add_spec(spec);
        }
        if let Ok(x) = result {
            let _ = results.set_value("x", x);
        }
        let lent = result.map(|_| results.as_view());
        let answered = self.with(index, |link, cx| link.session.answer(cx, call.ticket, lent));
        // Only results for a reset that was made after the last stop end a latch, also while they wait for capacity.
        if answered.is_some() && resets && result.is_ok() {
            for (at, reset) in self.motors.iter_mut().enumerate() {
                let is_meant = motor.is_none_or(|motor| motor == at);
                if is_meant && stops.is_none_or(|stops| stops[at] == reset.stops) {
                    reset.is_stopped = reset.lease.is_inhibited();
                }
            }
        }
        if let (Some(Err(_)), Some(link)) = (answered, &mut self.links[index]) {
            link.unanswered.push((call, result, stops));
        }
    }

    /// Something has happened on a link.
    fn happened(&mut self, index: usize, event: Event) {
        let now = self.now;
        match event {
            Event::Incoming(call) => self.started(index, call),
            Event::LeaseExpired(slot) => {
                let motor = self.functions.function(slot).and_then(|function| function.handler.motor);
                self.motors[motor.expect("only what moves has a lease")].made_safe(index, now);
            }
            Event::Joined => {
                let link = self.links[index].as_mut().expect("it is there");
                assert!(!link.joined && link.session.is_proven(), "it joins twice, or without a proof");
                link.joined = true;
            }
            Event::Reply(id, outcome) => {
                let link = self.links[index].as_mut().expect("it is there");
                assert_eq!(link.asked.remove(&id.0), Some(true), "a reply to a call that has ended");
                if let Ok(results) = outcome
                    && let Ok(block) = link.session.results(&results, &link.inbox)
                {
                    let _ = block.read_into(&mut Arguments::sized());
                }
            }
            Event::Failed(id, _) => {
                let link = self.links[index].as_mut().expect("it is there");
                assert_ne!(link.asked.remove(&id.0), Some(true), "a call that waits for its reply has another outcome");
            }
            Event::Closed(reason) => self.closed(index, reason),
            _ => {}
        }
    }

    fn started(&mut self, index: usize, call: Incoming) {
        let function = self.functions.function(call.slot).expect("only what is there is called");
        let (motor, attributes, is_slow) = (function.handler.motor, *function.attributes, function.handler.is_slow);
        let is_leased = attributes.lease.is_some();
        assert_eq!(is_leased, call.order.is_some(), "what moves has an order, and nothing else");
        if let Some((order, motor)) = call.order.zip(motor) {
            self.motors[motor].began(order, index, call.slot, self.now);
        }
        for (at, stopped) in self.motors.iter_mut().enumerate() {
            // A motor that no function moves inherits the unit's latch with its next one.
            let is_there =
                || self.functions.iter().any(|it| it.attributes.lease.is_some() && it.handler.motor == Some(at));
            if attributes.stop && motor.is_none_or(|motor| motor == at) && is_there() {
                assert!(!stopped.lease.is_live(self.now), "a motor moves while its stop is handled");
                stopped.stop();
                assert!(stopped.lease.is_inhibited(), "a stop inhibits nothing");
            }
        }
        let stops = std::array::from_fn(|at| self.motors[at].stops);
        if is_slow {
            self.links[index].as_mut().expect("it is there").held.push((call, stops));
        } else {
            self.answer(index, call, Ok(1), None);
        }
    }

    /// The link has ended: nothing moves for it, and every call has its outcome.
    fn closed(&mut self, index: usize, reason: CloseReason) {
        let link = self.links[index].take().expect("it is there");
        for motor in &self.motors {
            assert!(motor.open.is_none_or(|open| open.link != index), "a link ends before the safe hook of its order");
        }
        let waiting = link.asked.values().filter(|waits| **waits).count();
        assert_eq!(waiting, 0, "calls have no outcome");
        drop(link.session.into_storage(&mut self.pool));
        self.hub.node.left(self.now, LinkId(index as u16), reason);
    }

    /// Time passes, from deadline to deadline.
    pub(crate) fn pass(&mut self, span: Duration) {
        let end = self.now + span;
        for _ in 0..64 {
            let links = self.links.iter().flatten().map(|link| link.session.deadline());
            let next = links.chain([self.hub.node.next_deadline()]).min().unwrap_or(end).min(end);
            self.now = next.max(self.now);
            self.settle();
            if self.now >= end {
                return;
            }
        }
        self.now = end;
        self.settle();
    }

    /// A datagram has come.
    pub(crate) fn datagram(&mut self, from: SocketAddrV4, bytes: &mut [u8]) {
        crate::saw("datagram", "", bytes);
        let mode = self.mode();
        if let Some((LinkId(link), nonce, body)) = for_session(bytes, mode, FLEET)
            && self.links.get(usize::from(link)).is_some_and(Option::is_some)
        {
            let index = usize::from(link);
            let event = self.with(index, |link, cx| {
                link.came = cx.now;
                link.session.datagram(cx, from, nonce, body)
            });
            if let Some(Some(event)) = event {
                self.happened(index, event);
            }
            return;
        }
        let Self { hub, keys, now, .. } = self;
        hub.node.datagram(*now, from, bytes, &keys.codes);
    }

    /// Everything is allowed, nothing, everything but seldom, or a little.
    pub(crate) fn set_table(&mut self, kind: u8) {
        use cara_core::services::access::{Functions, Rate};
        let slow = Rate::new(1, Duration::from_millis(100));
        self.table = match kind {
            0 => None,
            1 => Some(Table(Vec::new())),
            2 => Some(Table(vec![Rule::new(Who::ANYBODY, Functions::All, Verbs::ALL).at(slow)])),
            _ => Some(Table(vec![Rule::new(
                Who::ANYBODY,
                Functions::Named(&["go", "stop", "now"]),
                Verbs::LIST.and(Verbs::CALL),
            )])),
        };
        for index in 0..LINKS {
            self.with(index, |link, cx| link.session.access_changed(cx));
        }
    }

    /// All links end, and everything is back where it was.
    pub(crate) fn end(mut self) {
        for index in 0..LINKS {
            self.with(index, |link, _| link.session.disconnected(CloseReason::Stopped));
        }
        self.settle();
        assert!(self.links.iter().all(Option::is_none), "a link that has ended reports it");
        for buffer in std::mem::take(&mut self.starved) {
            self.pool.give(buffer);
        }
        assert_eq!(self.pool.free(), BUFFERS, "a buffer is lost");
        assert!(self.motors.iter().all(|motor| motor.open.is_none() && !motor.lease.is_live(self.now)));
    }
}
