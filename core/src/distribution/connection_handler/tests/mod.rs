//! Nodes without a network: a mailman that keeps datagrams, and hellos made by hand.
#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

mod admission;
mod chaos;
mod claims;
mod discovery;
mod fleet;
#[cfg(feature = "hand-over")]
mod hand_over;
mod hostile;
mod invariants;
mod load;
mod network;
mod ordering;
mod restart;
mod standby;
mod table;

use core::net::SocketAddr;
use std::boxed::Box;
use std::vec::Vec;

use super::*;
use crate::config::Mode;
use crate::distribution::datagram::{Announce, SEARCH_BYTES, WhoHas};
use crate::host::port::InMemory;
use crate::host::secure::Plain;
use crate::time::Duration;

pub(super) const FLEET: Fleet = Fleet(7);
pub(super) const MANAGER: &str = "depot";
pub(super) const MANAGER_ID: u32 = 5;

impl Node<InMemory> {
    /// Takes a datagram in plain mode.
    pub(super) fn hear(&mut self, now: Instant, from: SocketAddr, bytes: &[u8]) {
        self.datagram(now, from, bytes, &Plain);
    }

    /// Takes an answer to this node's own question.
    pub(super) fn answered(&mut self, now: Instant, from: SocketAddr, announce: &Announce) {
        let answer = Announce { nonce: self.search.nonce, ..announce.clone() };
        self.hear(now, from, &announce_bytes(&answer));
    }
}

/// Keeps datagrams instead of sending them.
#[derive(Default)]
pub(super) struct Outbox {
    pub(super) broadcasts: Vec<Vec<u8>>,
    pub(super) sent: Vec<(SocketAddr, Vec<u8>)>,
}

impl Mailman<SocketAddr> for Outbox {
    fn write(&mut self, _: LinkId, _: &[&[u8]]) -> Result<usize, CloseReason> {
        panic!("a node never writes to links")
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.sent.push((to, datagram.to_vec()));
        true
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.broadcasts.push(datagram.to_vec());
        true
    }
}

pub(super) fn at(millis: u64) -> Instant {
    Instant::from_micros(millis * 1_000)
}

pub(super) fn address(host: u32, port: u16) -> SocketAddr {
    let [_, b, c, d] = host.to_be_bytes();
    SocketAddr::from(([10, b, c, d], port))
}

pub(super) fn manager() -> Manager {
    Manager::new(MANAGER, MANAGER_ID).unwrap()
}

pub(super) fn m_unit(name: &str, id: u32) -> NodeConfig<SocketAddr> {
    NodeConfig {
        identity: Identity::m_unit(name, id).unwrap(),
        fleet: FLEET,
        epoch: Epoch(100),
        target: Target::Everybody,
        tcp_port: 7_000,
        udp_port: 7_001,
        constraints: Constraints::M_UNIT,
        seed: u64::from(id),
    }
}

pub(super) fn s_unit(name: &str, id: u32) -> NodeConfig<SocketAddr> {
    NodeConfig {
        identity: Identity::s_unit(name, id).unwrap(),
        fleet: FLEET,
        epoch: Epoch(u64::from(id)),
        target: Target::Manager(manager()),
        tcp_port: 0,
        udp_port: 7_001,
        constraints: Constraints::S_UNIT,
        seed: u64::from(id) << 20,
    }
}

pub(super) fn slice<T: Default>(count: usize) -> Box<[T]> {
    (0..count).map(|_| T::default()).collect()
}

pub(super) fn storage<P: Port<Storage = crate::storage::Boxed, Endpoint = SocketAddr>>(nodes: usize) -> NodeStorage<P> {
    NodeStorage { nodes: slice(nodes), order: slice(nodes), links: slice(nodes * 2), findings: slice(4) }
}

/// A node that was made at the start of the clock.
pub(super) fn node(config: NodeConfig<SocketAddr>) -> Node<InMemory> {
    Node::new(Instant::START, config, storage(16))
}

pub(super) fn depot() -> Node<InMemory> {
    node(m_unit(MANAGER, MANAGER_ID))
}

/// The hello of a unit, as its node would make it.
pub(super) fn hello_of(config: &NodeConfig<SocketAddr>) -> Hello {
    node(config.clone()).hello(Instant::START, LinkId(0), 1)
}

pub(super) fn search_of(config: &NodeConfig<SocketAddr>, sequence: u32) -> WhoHas {
    let wanted = match &config.target {
        Target::Everybody => None,
        Target::Manager(manager) | Target::Fixed(manager, _) => Some(manager.clone()),
    };
    WhoHas {
        identity: config.identity.clone(),
        epoch: config.epoch,
        sequence,
        nonce: 77,
        wanted,
        tcp_port: config.tcp_port,
        expected: 1,
        known: heapless::Vec::new(),
        standby: false,
        skipped: 0,
    }
}

pub(super) fn announce_of(config: &NodeConfig<SocketAddr>, sequence: u32, nonce: u64) -> Announce {
    Announce {
        identity: config.identity.clone(),
        epoch: config.epoch,
        claim: None,
        obeyed: None,
        sequence,
        nonce,
        tcp_port: config.tcp_port,
        room: 10,
        expected: 10,
        skipped: 0,
    }
}

pub(super) fn who_has_bytes(who_has: &WhoHas) -> Vec<u8> {
    who_has.encode(FLEET, &Plain, &mut [0; SEARCH_BYTES]).unwrap().to_vec()
}

pub(super) fn announce_bytes(announce: &Announce) -> Vec<u8> {
    announce.encode(FLEET, &Plain, None, &mut [0; SEARCH_BYTES]).unwrap().to_vec()
}

pub(super) fn read(bytes: &[u8]) -> Datagram<'_> {
    Datagram::decode(bytes, FLEET, &Plain).unwrap()
}

pub(super) fn as_who_has(bytes: &[u8]) -> WhoHas {
    match read(bytes) {
        Datagram::WhoHas(who_has) => who_has,
        other => panic!("not a search: {other:?}"),
    }
}

pub(super) fn as_announce(bytes: &[u8]) -> Announce {
    match read(bytes) {
        Datagram::Announce(announce) => announce,
        other => panic!("not an answer: {other:?}"),
    }
}

/// Polls at each deadline up to `end`; returns the commands and when each came.
pub(super) fn run(node: &mut Node<InMemory>, end: Instant, outbox: &mut Outbox) -> Vec<(Instant, Command<SocketAddr>)> {
    let mut actions = Vec::new();
    for _ in 0..100_000 {
        let now = node.next_deadline();
        if now > end {
            return actions;
        }
        while let Some(action) = node.poll(now, outbox, &Plain) {
            actions.push((now, action));
        }
        assert!(node.next_deadline() > now, "nothing due remains after a poll");
    }
    panic!("the node never rests");
}

/// The commands that are due now.
pub(super) fn due(node: &mut Node<InMemory>, now: Instant) -> Vec<Command<SocketAddr>> {
    core::iter::from_fn(|| node.poll(now, &mut Outbox::default(), &Plain)).collect()
}

/// A directive to a link.
pub(super) fn notify(link: u16, directive: Directive) -> Command<SocketAddr> {
    Command::Notify(LinkId(link), directive)
}

/// Lets a unit join.
pub(super) fn join(node: &mut Node<InMemory>, now: Instant, link: u16, config: &NodeConfig<SocketAddr>) {
    let from = address(config.identity.id(), 40_000);
    assert_eq!(node.admit(now, LinkId(link), from, &hello_of(config)), Admission::Accept);
}

/// Lets an s_unit be found by its manager's answer; returns where it dials.
pub(super) fn dial_manager(node: &mut Node<InMemory>, now: Instant, sequence: u32) -> SocketAddr {
    let announce = announce_of(&m_unit(MANAGER, MANAGER_ID), sequence, 0);
    node.answered(now, address(1, 7_001), &announce);
    let actions = run(node, now + Duration::from_millis(200), &mut Outbox::default());
    match actions.as_slice() {
        [(_, Command::Dial { to, identity: Some(identity) })] if manager().is(identity) => *to,
        other => panic!("one dial of the manager was expected: {other:?}"),
    }
}
