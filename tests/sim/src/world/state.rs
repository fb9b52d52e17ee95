//! One simulated unit: what it is in every life, and the core's machines of this one.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::rc::Rc;

use cara_core::config::{Constraints, Mode};
use cara_core::counters::Counters;
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::connection_handler::{Command, NodeConfig, Target};
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::host::connections::LinkCounter;
use cara_core::host::mailman::LinkId;
use cara_core::host::secure::Seal;
use cara_core::random::Random;
use cara_core::services::session::{Session, SessionConfig, SessionStorage, buffer_bytes};
use cara_core::services::slots_for;
use cara_core::time::Instant;

use super::handle::UnitHandle;
use super::keys::{Given, Keys};
use super::links::Links;
use super::mail::{LazyPool, SimMailman};
use super::service::boxed_parameters;
use super::{LogEvent, UnitEvent};
use crate::event::{HostId, StreamId};
use crate::hub::hub;
use crate::network::Network;
use crate::storage::Boxed;

/// The TCP port on which m_units listen.
const TCP_PORT: u16 = 7_000;
/// The timer of the node; those of links follow it.
pub(super) const NODE_TIMER: u64 = 0;
/// Calls in flight to one peer, and calls of one peer that run here, where the constraints say less.
const CALLS: usize = 64;
/// Bytes of signatures for each function of a list.
const SIGNATURE_BYTES: usize = 96;

pub(super) type Program = Rc<dyn Fn(&UnitHandle)>;
type EventHook = Rc<dyn Fn(&UnitHandle, &UnitEvent)>;
pub(super) type LinkCounters = Counters<LinkCounter, { LinkCounter::COUNT }>;

/// What a unit is, in every life.
#[derive(Clone)]
pub(super) struct Settings {
    pub(super) identity: Identity,
    pub(super) fleet: Fleet,
    pub(super) target: Target<SocketAddr>,
    /// The m_units that an m_unit connects to, if not all.
    pub(super) m_units: Option<Box<[Identity]>>,
    pub(super) constraints: Constraints,
    pub(super) message_buffers: usize,
    pub(super) calls_running: Option<usize>,
    pub(super) links: usize,
    pub(super) functions: usize,
    pub(super) boot_seed: Option<u64>,
    pub(super) given: Given,
    pub(super) program: Option<Program>,
    /// What it has stored before its first life.
    pub(super) claims: Stored,
    /// Whether it can store anything.
    pub(super) storing: Storing,
    pub(super) takes_over: bool,
    pub(super) stands_by: bool,
    pub(super) expects: u16,
}

/// What a unit stores of claims.
#[derive(Clone, Debug, Default)]
pub(super) struct Stored {
    pub(super) own: Claim,
    pub(super) obeyed: BTreeMap<Identity, TaggedClaim>,
    /// The manager of a vehicle that was handed over: the one it was configured with, and the present one.
    pub(super) handed: Option<(Identity, Identity)>,
}

/// What becomes of what a unit stores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storing {
    /// It is stored at once.
    Works,
    /// It fails at once.
    Fails,
    /// It hangs.
    Hangs,
}

/// A unit with its log, and with its machine while it lives.
pub(super) struct UnitState {
    pub(super) host: HostId,
    pub(super) settings: Settings,
    pub(super) life: u32,
    /// What it stores of claims.
    pub(super) claims: Stored,
    pub(super) machine: Option<Machine>,
    pub(super) log: Vec<(Instant, LogEvent)>,
    pub(super) hooks: Vec<EventHook>,
    /// Of the links that have ended.
    pub(super) counters: LinkCounters,
}

/// One life of a unit.
pub(super) struct Machine {
    pub(super) links: Links,
    pub(super) constraints: Constraints,
    calls_running: Option<usize>,
    node_timer: Instant,
}

impl Settings {
    fn keys(&self, network: &mut Network) -> Keys {
        // Runs in plain mode draw what they always drew.
        let seed = match self.given.mode {
            Mode::Plain => 0,
            Mode::Secured => self.boot_seed.unwrap_or_else(|| network.random().bits()),
        };
        Keys::new(self.given.clone(), self.identity.clone(), self.fleet, Random::new(seed))
    }
}

impl UnitState {
    pub(super) fn new(host: HostId, settings: Settings) -> Self {
        Self {
            host,
            life: 0,
            claims: settings.claims.clone(),
            settings,
            machine: None,
            log: Vec::new(),
            hooks: Vec::new(),
            counters: Counters::new(),
        }
    }

    pub(super) fn boot(&mut self, network: &mut Network) {
        let settings = &self.settings;
        let listens = settings.identity.role() == Role::MUnit;
        if listens {
            network.listen(self.host, TCP_PORT);
        }
        let (epoch, seed) = (network.random().bits(), network.random().bits());
        let config = NodeConfig {
            identity: settings.identity.clone(),
            fleet: settings.fleet,
            epoch: Epoch(epoch),
            target: settings.target.clone(),
            tcp_port: if listens { TCP_PORT } else { 0 },
            udp_port: network.address(self.host).port(),
            constraints: settings.constraints,
            seed: settings.boot_seed.unwrap_or(seed),
        };
        let functions =
            FunctionList::new(Boxed::slice(settings.functions), Boxed::slice(settings.functions * SIGNATURE_BYTES));
        let message_size = settings.constraints.message_size;
        let keys = settings.keys(network);
        let buffers = LazyPool::new(buffer_bytes(message_size, keys.cipher().overhead()), settings.message_buffers);
        // A block reserves what its signature declares, which may be more than what it holds.
        let arguments = boxed_parameters(2 * message_size as usize + 1_024);
        let mut hub = hub(network.clock(self.host), config, settings.links, settings.functions);
        if let Some(m_units) = &settings.m_units {
            hub.node.choose(m_units.clone());
        }
        hub.node.expect(settings.expects);
        let now = network.clock(self.host);
        if listens && settings.stands_by {
            hub.node.stand_by(now);
        } else if listens {
            // Drawn anew for each life, without a draw of the network's.
            self.claims.own = self.claims.own.raised(epoch.rotate_left(23) ^ seed);
            let tagged = self.claims.own.tagged(&settings.identity, &keys.codes);
            hub.node.set_claim(tagged.unwrap_or_default());
            if settings.takes_over {
                hub.node.take_over(now);
            }
        }
        if settings.given.mode == Mode::Secured {
            self.claims.obeyed.iter().for_each(|(manager, tagged)| hub.node.keep_obeyed(now, manager, *tagged));
            if let Some((home, present)) = &self.claims.handed {
                hub.node.belong_to(home, present);
            }
            hub.node.store_claims();
        }
        self.machine = Some(Machine {
            links: Links::new(self.host, settings.links, functions, buffers, hub, keys, arguments),
            constraints: settings.constraints,
            calls_running: settings.calls_running,
            node_timer: Instant::FAR_FUTURE,
        });
    }
}

impl Machine {
    /// Makes the session of a link and gives it to the links.
    pub(super) fn open(
        &mut self,
        network: &mut Network,
        functions: usize,
        stream: StreamId,
        peer: SocketAddr,
        dialed: bool,
    ) -> Option<u16> {
        let index = self.links.free_index()?;
        let now = network.clock(self.links.host());
        let nonce = self.links.hub.node.nonce();
        let calls = CALLS.max(usize::from(self.constraints.calls_per_peer));
        let storage = SessionStorage {
            small: Boxed::slice(cara_core::config::LINK_BUFFER_BYTES),
            pending: Boxed::slice(calls),
            running: Boxed::slice(slots_for(self.calls_running.unwrap_or(calls))),
            publications: Boxed::slice(functions),
            their_functions: Boxed::slice(functions),
            their_signatures: Boxed::slice(functions * SIGNATURE_BYTES),
        };
        let link = LinkId(index);
        let config = SessionConfig { link, dialed, address: peer, nonce, constraints: self.constraints };
        let mut session = Session::new(now, config, self.links.keys.cipher(), storage);
        if let Some(span) = self.links.keys.renews_every {
            session.renew_every(span);
        }
        self.links.insert(index, session, stream);
        Some(index)
    }

    pub(super) fn poll_node(&mut self, network: &mut Network, host: HostId) -> Option<Command<SocketAddr>> {
        let now = network.clock(host);
        let Links { hub, keys, .. } = &mut self.links;
        hub.node.poll(now, &mut SimMailman { network, host, streams: &[] }, &keys.codes)
    }

    pub(super) fn arm_node(&mut self, network: &mut Network, host: HostId) {
        let due = self.links.hub.node.next_deadline();
        if due < self.node_timer || self.node_timer <= network.clock(host) {
            self.node_timer = due;
            if due != Instant::FAR_FUTURE {
                network.set_timer(host, network.time_of(host, due), NODE_TIMER);
            }
        }
    }
}
