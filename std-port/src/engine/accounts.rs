//! What a unit has counted: in discovery, on each link, over all links that it ever had, and in the port itself.
//!
//! A link's counters are added to those of the links before it when it ends, so that a sum never goes back. The lock of
//! the sums is taken before any other.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use cara_core::counters::{Counter, Counters};
use cara_core::host::connections::LinkCounter;

use super::Engine;
use super::link::LinkCell;
use super::peer_cell::{LinkCounters, PeerCell};
use crate::locks::Rank;

/// What outlives the links, and what is counted outside of the core.
#[derive(Default)]
pub(crate) struct Accounts {
    /// Of links that have ended.
    ended: Mutex<LinkCounters>,
    connections_refused: AtomicU64,
    hooks_late: Arc<AtomicU64>,
}

impl Accounts {
    /// A connection found no room. Returns how many did so before.
    pub(super) fn connection_refused(&self) {
        self.connections_refused.fetch_add(1, Ordering::Relaxed);
    }
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

/// What the links hold now.
#[derive(Default)]
struct Held {
    links: u64,
    calls: u64,
    in_flight: u64,
}

impl<T: Send + 'static> Engine<T> {
    /// Everything that is counted for the unit as a whole.
    pub(crate) fn readings(&self) -> Vec<Reading> {
        let (links, held) = self.sum_links();
        let node = self.hub.lock().hub.node.counters.clone();
        let mut readings: Vec<_> = of(Group::Node, &node).chain(of(Group::Links, &links)).collect();
        readings.extend(self.port_readings(&held));
        readings
    }

    /// What all links have counted.
    pub(crate) fn counted(&self, counter: LinkCounter) -> u64 {
        self.sum_links().0.value(counter)
    }

    /// What the links to a node have counted.
    pub(crate) fn peer_readings(&self, peer: &PeerCell) -> Vec<Reading> {
        let _accounts = Rank::Accounts.lock(&self.accounts.ended);
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
        let mut ended = Rank::Accounts.lock(&self.accounts.ended);
        let mut state = link.lock();
        if !std::mem::replace(&mut state.retired, true) {
            ended.merge(state.session.counters());
            if let Some(peer) = link.peer.get() {
                peer.keep(state.session.counters());
            }
        }
    }

    fn sum_links(&self) -> (LinkCounters, Held) {
        let ended = Rank::Accounts.lock(&self.accounts.ended);
        let (mut sum, mut held) = (ended.clone(), Held::default());
        for link in self.links.all() {
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
        self.accounts.hooks_late.clone()
    }

    fn port_readings(&self, held: &Held) -> [Reading; 16] {
        // One that is stuck has not counted itself.
        let functions = self.functions();
        let actuators = functions.iter().filter_map(|function| function.handler.actuator.as_ref());
        actuators.for_each(|actuator| actuator.safe.look());
        let pool = self.pool.counters();
        let connected = self.nodes.read().connected().count() as u64;
        let file = &self.guard.file;
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        [
            count("EventsLost", "Events that a subscriber lost because it did not keep up.", self.events.lost()),
            count(
                "ConnectionsRefused",
                "Connections dropped because as many links were open as may be.",
                load(&self.accounts.connections_refused),
            ),
            count(
                "AuditLinesLost",
                "Lines of the audit log that its disk did not take, or not in time.",
                self.audit_lines_lost(),
            ),
            count("HooksLate", "Safe hooks that took longer than 100 ms.", load(&self.accounts.hooks_late)),
            count("LatchesUnkept", "Times that a stop or its end could not be written.", self.latch.failed()),
            count(
                "BuffersRefused",
                "Times that all message buffers were in use when one was asked for.",
                pool.exhausted,
            ),
            count(
                "OperatorForbidden",
                "Questions of the operator that the access table does not allow.",
                self.guard.operator_refused(),
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
