//! The parts of a pair: constraints, storage, hellos, handlers.

use core::cell::Cell;
use std::rc::Rc;
use std::vec;

use super::super::{Publication, SessionStorage, buffer_bytes};
use super::net::DATAGRAM_PORT;
use super::side::Tested;
use crate::config::{Constraints, LINK_BUFFER_BYTES, Priority};
use crate::distribution::connection_handler::{Node, NodeConfig, NodeStorage, Target};
use crate::distribution::function::{Attributes, Definition};
use crate::distribution::function_list::{Entry, FunctionList};
use crate::distribution::hello::Manager;
use crate::distribution::identity::{Epoch, Fleet, Identity};
use crate::distribution::parameters::ParametersView;
use crate::error::Error;
use crate::services::hub::Hub;
use crate::services::lease::{Lease, Service};
use crate::services::publications::Publications;
use crate::services::slots_for;
use crate::storage::{Boxed, Pool};
use crate::time::{Duration, Instant};

/// The parameters of a pair.
pub(super) struct Setup {
    pub(super) manager: Constraints,
    pub(super) agv: Constraints,
    /// The ends announce UDP ports to each other.
    pub(super) datagrams: bool,
    /// Buffers of each end's pool, and their size.
    pub(super) buffers: usize,
    pub(super) buffer_size: usize,
    /// Capacity for functions of the other end.
    pub(super) their_functions: usize,
    /// How many calls of the other end run side by side.
    pub(super) running: usize,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            manager: Constraints::M_UNIT,
            agv: Constraints { message_size: 32 * 1024, ..Constraints::S_UNIT },
            datagrams: true,
            buffers: 6,
            buffer_size: buffer_bytes(32 * 1024, 0),
            their_functions: 8,
            running: 64,
        }
    }
}

/// A service of a test.
pub(super) struct Handler {
    pub(super) run: Run,
    pub(super) lease: Option<Rc<Lease>>,
    /// Whether the lease is one that motors can read. Otherwise only the unit knows of it.
    pub(super) has_word: Cell<bool>,
    /// The values of a stream.
    #[cfg(feature = "streams")]
    pub(super) values: Option<super::streams::Values>,
}

/// When a service answers.
#[derive(Clone, Copy)]
pub(super) enum Run {
    /// At once.
    Now(fn(&mut ParametersView) -> Result<(), Error>),
    /// When the test answers it.
    Held,
}

impl Handler {
    pub(super) fn new(run: Run, lease: Option<Rc<Lease>>) -> Self {
        Self {
            run,
            lease,
            has_word: Cell::new(true),
            #[cfg(feature = "streams")]
            values: None,
        }
    }
}

impl Service for Handler {
    fn lease(&self) -> Option<&Lease> {
        self.lease.as_deref().filter(|_| self.has_word.get())
    }

    #[cfg(feature = "streams")]
    fn stream(&self) -> Option<&dyn crate::services::stream::Source> {
        self.values.as_ref().map(|values| values as &dyn crate::services::stream::Source)
    }
}

/// The attributes of a function with this definition: `stop` and `emergency` are emergency services.
pub(super) fn attributes(definition: &Definition, lease_millis: u64) -> Attributes {
    let lease = (lease_millis > 0).then(|| Duration::from_millis(lease_millis));
    let is_emergency = ["stop", "emergency"].contains(&definition.signature().name());
    let priority = if is_emergency { Priority::Emergency } else { Priority::Normal };
    Attributes { lease, priority, ..Attributes::default() }
}

pub(super) fn nonce(agv: bool) -> u64 {
    if agv { 0xA61 } else { 0x3A6A6E2 }
}

/// The hub of an end whose manager has this name.
pub(super) fn hub<const WHOLE: bool>(
    agv: bool,
    manager: &str,
    constraints: Constraints,
    datagrams: bool,
) -> Hub<Tested<WHOLE>> {
    let target = if agv { Target::Manager(Manager::new(manager, 1).unwrap()) } else { Target::Everybody };
    let identity = if agv { Identity::s_unit("agv-01", 1) } else { Identity::m_unit(manager, 1) }.unwrap();
    // The hub decides about admission, the link about the limits in a hello.
    let constraints = Constraints { maximum_nodes: Constraints::M_UNIT.maximum_nodes, ..constraints };
    let config = NodeConfig {
        identity,
        fleet: Fleet(1),
        epoch: Epoch(1),
        target,
        tcp_port: 0,
        udp_port: if datagrams { DATAGRAM_PORT } else { 0 },
        constraints,
        seed: 1,
    };
    let storage = NodeStorage {
        nodes: vec![None; 4].into_boxed_slice(),
        order: vec![Default::default(); 4].into_boxed_slice(),
        links: vec![None; 4].into_boxed_slice(),
        findings: vec![None; 4].into_boxed_slice(),
    };
    let publications = Publications::new(vec![false; 16].into_boxed_slice(), vec![None; 16].into_boxed_slice());
    Hub { node: Node::new(Instant::START, config, storage), publications }
}

pub(super) fn storage(running: usize, their_functions: usize) -> SessionStorage<Boxed> {
    SessionStorage {
        small: vec![0; LINK_BUFFER_BYTES].into_boxed_slice(),
        pending: vec![None; 128].into_boxed_slice(),
        running: vec![None; slots_for(running)].into_boxed_slice(),
        publications: vec![Publication::default(); 16].into_boxed_slice(),
        their_functions: (0..their_functions).map(|_| Entry::empty()).collect(),
        their_signatures: vec![0; 2048].into_boxed_slice(),
    }
}

pub(super) fn functions() -> FunctionList<Boxed, Handler> {
    FunctionList::new((0..16).map(|_| Entry::empty()).collect(), vec![0; 4096].into_boxed_slice())
}

pub(super) fn pool(count: usize, size: usize) -> Pool<Boxed> {
    Pool::new((0..count).map(|_| Some(vec![0; size].into_boxed_slice())).collect())
}
