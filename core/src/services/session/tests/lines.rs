//! The core does not need IP: two units find each other and communicate over serial lines, with numbers as addresses.

use core::fmt;
use std::vec;
use std::vec::Vec;

use super::setup::{self, Handler};
use crate::config::{Constraints, Mode};
use crate::distribution::connection_handler::{Command, Node, NodeConfig, NodeStorage, Target};
use crate::distribution::datagram::for_session;
use crate::distribution::function_list::FunctionList;
use crate::distribution::hello::Manager;
use crate::distribution::identity::{Epoch, Fleet, Identity};
use crate::error::CloseReason;
use crate::host::connections::LinkCounter;
use crate::host::endpoint::Endpoint;
use crate::host::mailman::{LinkId, Mailman};
use crate::host::secure::Plain;
use crate::services::hub::Hub;
use crate::services::publications::Publications;
use crate::services::session::{Event, Session, SessionConfig};
use crate::services::{Context, Port};
use crate::storage::{Boxed, Pool};
use crate::time::{Duration, Instant};

const FLEET: Fleet = Fleet(1);
/// The ports for streams and datagrams.
const STREAM: u8 = 1;
const DATAGRAMS: u8 = 2;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Line {
    number: u8,
    port: u8,
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {}, port {}", self.number, self.port)
    }
}

impl Endpoint for Line {
    fn port(&self) -> u16 {
        self.port.into()
    }

    fn at_port(&self, port: u16) -> Self {
        Self { number: self.number, port: u8::try_from(port).unwrap() }
    }

    fn is_of_host(&self, other: &Self) -> bool {
        self.number == other.number
    }

    fn is_loopback(&self) -> bool {
        false
    }

    fn host_bits(&self) -> u32 {
        self.number.into()
    }
}

enum Serial {}

impl Port for Serial {
    type Storage = Boxed;
    type Cipher = Plain;
    type Endpoint = Line;
}

/// Bytes and datagrams in flight; a datagram without a receiver is a broadcast.
#[derive(Default)]
struct Wire {
    stream: Vec<u8>,
    datagrams: Vec<(Option<Line>, Vec<u8>)>,
}

impl Mailman<Line> for Wire {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.stream.extend(slices.concat());
        Ok(slices.iter().map(|slice| slice.len()).sum())
    }

    fn send_to(&mut self, to: Line, datagram: &[u8]) -> bool {
        self.datagrams.push((Some(to), datagram.to_vec()));
        true
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.datagrams.push((None, datagram.to_vec()));
        true
    }
}

struct End {
    number: u8,
    hub: Hub<Serial>,
    session: Option<Session<Serial>>,
    functions: FunctionList<Boxed, Handler>,
    pool: Pool<Boxed>,
    wire: Wire,
    joined: bool,
}

impl End {
    fn new(number: u8, identity: Identity, target: Target<Line>) -> Self {
        let config = NodeConfig {
            identity,
            fleet: FLEET,
            epoch: Epoch(1),
            target,
            tcp_port: STREAM.into(),
            udp_port: DATAGRAMS.into(),
            constraints: Constraints::S_UNIT,
            seed: number.into(),
        };
        let storage = NodeStorage {
            nodes: vec![None; 4].into_boxed_slice(),
            order: vec![Default::default(); 4].into_boxed_slice(),
            links: vec![None; 1].into_boxed_slice(),
            findings: vec![None; 4].into_boxed_slice(),
        };
        let publications = Publications::new(vec![false; 16].into_boxed_slice(), vec![None; 4].into_boxed_slice());
        let node = Node::new(Instant::START, config, storage);
        Self {
            number,
            hub: Hub { node, publications },
            session: None,
            functions: setup::functions(),
            pool: setup::pool(4, 2_048),
            wire: Wire::default(),
            joined: false,
        }
    }

    fn with<R>(
        &mut self,
        now: Instant,
        act: impl FnOnce(&mut Session<Serial>, &mut Context<'_, Serial>) -> R,
    ) -> Option<R> {
        let Self { hub, session, functions, pool, wire, .. } = self;
        let mut cx = Context { now, mailman: wire, buffers: pool, functions, access: None, hub, keys: &mut () };
        session.as_mut().map(|session| act(session, &mut cx))
    }

    fn open(&mut self, now: Instant, address: Line, dialed: bool) {
        let nonce = self.hub.node.nonce();
        let config = SessionConfig { link: LinkId(0), dialed, address, nonce, constraints: Constraints::S_UNIT };
        self.session = Some(Session::new(now, config, Plain, setup::storage(4, 4)));
        self.with(now, |session, cx| session.connected(cx));
    }

    /// The address to dial, if any.
    fn poll(&mut self, now: Instant) -> Option<Line> {
        while self.with(now, |session, cx| session.poll(cx).is_some()) == Some(true) {}
        let Command::Dial { to, identity } = self.hub.node.poll(now, &mut self.wire, &Plain)? else { return None };
        self.hub.node.dialing(identity.as_ref(), LinkId(0));
        Some(to)
    }

    fn hear(&mut self, now: Instant, from: Line, bytes: &mut [u8]) {
        if let Some((_, nonce, body)) = for_session(bytes, Mode::Plain, FLEET) {
            self.with(now, |session, cx| session.datagram(cx, from, nonce, body).is_some());
        } else {
            self.hub.node.datagram(now, from, bytes, &Plain);
        }
    }

    fn read(&mut self, now: Instant, bytes: &mut [u8]) {
        let (mut start, mut joined) = (0, self.joined);
        self.with(now, |session, cx| {
            loop {
                let receipt = session.receive(cx, &mut bytes[start..], None);
                let (consumed, is_quiet) = (receipt.consumed, receipt.event.is_none());
                joined |= matches!(receipt.event, Some(Event::Joined));
                start += consumed;
                if consumed == 0 && is_quiet {
                    return;
                }
            }
        });
        self.joined = joined;
    }

    fn datagrams_received(&self) -> u64 {
        self.session.as_ref().unwrap().counters().value(LinkCounter::DatagramsReceived)
    }
}

fn carry(now: Instant, from: &mut End, to: &mut End) {
    let sender = Line { number: from.number, port: DATAGRAMS };
    for (receiver, mut bytes) in core::mem::take(&mut from.wire.datagrams) {
        assert!(receiver.is_none_or(|line| line == Line { number: to.number, port: DATAGRAMS }));
        to.hear(now, sender, &mut bytes);
    }
    to.read(now, &mut core::mem::take(&mut from.wire.stream));
}

#[test]
fn a_pair_meets_over_numbered_lines() {
    let mut manager = End::new(1, Identity::m_unit("depot", 1).unwrap(), Target::Everybody);
    let wanted = Target::Manager(Manager::new("depot", 1).unwrap());
    let mut agv = End::new(2, Identity::s_unit("agv", 1).unwrap(), wanted);
    for millis in 0..5_000 {
        let now = Instant::START + Duration::from_millis(millis);
        if let Some(to) = agv.poll(now) {
            assert_eq!(to, Line { number: 1, port: STREAM });
            agv.open(now, to, true);
            manager.open(now, Line { number: 2, port: 9 }, false);
        }
        assert_eq!(manager.poll(now), None);
        carry(now, &mut manager, &mut agv);
        carry(now, &mut agv, &mut manager);
    }
    assert!(manager.joined && agv.joined);
    assert!(manager.datagrams_received() > 0 && agv.datagrams_received() > 0, "keep-alives");
}
