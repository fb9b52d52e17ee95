//! What a unit has counted: in discovery, on each link, over all links that it ever had, and in the port itself.
//!
//! A link's counters are added to those of the links before it when it ends, so that a sum never goes back. The lock of
//! the sums is taken before any other.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use cara_core::counters::{Counter, Counters};
use cara_core::host::connections::LinkCounter;

use super::access::Guard;
use super::events::Events;
use super::hub::SharedHub;
use super::link::LinkCell;
use super::links::Links;
use super::noting::Notes;
use super::peer_cell::{LinkCounters, PeerCell};
use super::peers::Nodes;
use crate::latch::Keeper;
use crate::locks::Rank;
use crate::pool::MessagePool;

/// What outlives the links, and what is counted outside of the core.
#[derive(Default)]
pub(crate) struct Accounts {
    /// Of links that have ended.
    ended: Mutex<LinkCounters>,
    connections_refused: AtomicU64,
    hooks_late: Arc<AtomicU64>,
}

/// One number about a unit or a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reading {
    pub(crate) group: Group,
    pub(crate) name: &'static str,
    /// What is counted, in a sentence.
    pub(crate) help: &'static str,
    /// It tells how it is now, so it goes down as well.
    pub(crate) gauge: bool,
    pub(crate) value: u64,
}

/// What a number is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Group {
    /// Discovery and membership.
    Node,
    /// All links together, those that have ended included.
    Links,
    /// The port: tables, buffers, threads.
    Unit,
    /// The links to one node.
    Link,
}

/// The parts that count for themselves, or are counted.
pub(super) struct Parts<'e> {
    pub(super) links: &'e Links,
    pub(super) hub: &'e SharedHub,
    pub(super) nodes: &'e Nodes,
    pub(super) pool: &'e MessagePool,
    pub(super) events: &'e Events,
    pub(super) guard: &'e Guard,
    /// This manager leads.
    pub(super) leads: bool,
    pub(super) latch: &'e Keeper,
    pub(super) notes: &'e Notes,
}

/// What the links hold now.
#[derive(Default)]
struct Held {
    links: u64,
    calls: u64,
    in_flight: u64,
}

impl Accounts {
    /// A connection found no room.
    pub(super) fn connection_refused(&self) {
        self.connections_refused.fetch_add(1, Ordering::Relaxed);
    }

    /// Everything that is counted for the unit as a whole.
    pub(super) fn readings(&self, parts: &Parts<'_>) -> Vec<Reading> {
        let (links, held) = self.sum(parts.links);
        let node = parts.hub.lock().hub.node.counters.clone();
        let mut readings: Vec<_> = of(Group::Node, &node).chain(of(Group::Links, &links)).collect();
        readings.extend(self.of_port(parts, &held));
        readings
    }

    /// What all links have counted.
    pub(crate) fn counted(&self, links: &Links, counter: LinkCounter) -> u64 {
        self.sum(links).0.value(counter)
    }

    /// What the links to a node have counted.
    pub(crate) fn of_peer(&self, peer: &PeerCell) -> Vec<Reading> {
        let _accounts = Rank::Accounts.lock(&self.ended);
        let mut counters = peer.earlier();
        if let Some(link) = peer.link() {
            let state = link.lock();
            if !state.retired {
                counters.merge(state.session.counters());
            }
        }
        of(Group::Link, &counters).collect()
    }

    /// A link has ended: what it has counted is kept.
    pub(super) fn retire(&self, link: &LinkCell) {
        let mut ended = Rank::Accounts.lock(&self.ended);
        let mut state = link.lock();
        if !std::mem::replace(&mut state.retired, true) {
            ended.merge(state.session.counters());
            if let Some(peer) = link.peer.get() {
                peer.keep(state.session.counters());
            }
        }
    }

    fn sum(&self, links: &Links) -> (LinkCounters, Held) {
        let ended = Rank::Accounts.lock(&self.ended);
        let (mut sum, mut held) = (ended.clone(), Held::default());
        for link in links.all() {
            let state = link.lock();
            if !state.retired {
                sum.merge(state.session.counters());
                held.links += 1;
                held.calls += u64::from(state.session.calls_held());
                held.in_flight += state.session.calls_in_flight() as u64;
            }
        }
        (sum, held)
    }

    /// Where safe hooks count that they took long.
    pub(crate) fn hooks_late(&self) -> Arc<AtomicU64> {
        self.hooks_late.clone()
    }

    fn of_port(&self, parts: &Parts<'_>, held: &Held) -> [Reading; 17] {
        let pool = parts.pool.counters();
        let connected = parts.nodes.read().connected().count() as u64;
        let file = &parts.guard.file;
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        [
            count("EventsLost", "Events that a subscriber lost because it did not keep up.", parts.events.lost()),
            count(
                "ConnectionsRefused",
                "Connections dropped because as many links were open as may be.",
                load(&self.connections_refused),
            ),
            count(
                "AuditLinesLost",
                "Lines of the audit log that its disk did not take, or not in time.",
                parts.notes.lines_lost(),
            ),
            count("HooksLate", "Safe hooks that took longer than 100 ms.", load(&self.hooks_late)),
            count("LatchesUnkept", "Times that a stop or its end could not be written.", parts.latch.failed()),
            count(
                "BuffersRefused",
                "Times that all message buffers were in use when one was asked for.",
                pool.exhausted,
            ),
            count(
                "OperatorForbidden",
                "Questions of the operator that the access table does not allow.",
                parts.guard.operator_refused(),
            ),
            count("AccessReloads", "Times that the access table was taken over from its file.", load(&file.reloads)),
            count(
                "AccessMistakes",
                "Times that the access table's file could not be taken over because of a mistake.",
                load(&file.mistakes),
            ),
            gauge(
                "AccessFileWrong",
                "Whether the access table's file has a mistake, so that an earlier table is in force.",
                u64::from(file.is_wrong.load(Ordering::Relaxed)),
            ),
            gauge("BuffersInUse", "Message buffers in use.", pool.in_use as u64),
            gauge("BuffersPeak", "Most message buffers that were in use at a time.", pool.peak as u64),
            gauge("LinksOpen", "Links that are open, those that have not joined yet included.", held.links),
            gauge(
                "Leading",
                "Whether this manager leads: it has its authority's key, and has claimed under it.",
                u64::from(parts.leads),
            ),
            gauge("NodesConnected", "Nodes that are connected.", connected),
            gauge("CallsHeld", "Calls of other nodes that run or wait here.", held.calls),
            gauge("CallsInFlight", "Calls of this unit that wait for a reply.", held.in_flight),
        ]
    }
}

fn of<C: Counter, const N: usize>(group: Group, counters: &Counters<C, N>) -> impl Iterator<Item = Reading> {
    C::ALL.iter().map(move |&counter| Reading {
        group,
        name: counter.name(),
        help: counter.help(),
        gauge: false,
        value: counters.value(counter),
    })
}

const fn count(name: &'static str, help: &'static str, value: u64) -> Reading {
    Reading { group: Group::Unit, name, help, gauge: false, value }
}

const fn gauge(name: &'static str, help: &'static str, value: u64) -> Reading {
    Reading { group: Group::Unit, name, help, gauge: true, value }
}

/// Readings as the API shows them: name and number.
pub(crate) fn pairs(readings: Vec<Reading>) -> Vec<(&'static str, u64)> {
    readings.into_iter().map(|reading| (reading.name, reading.value)).collect()
}
