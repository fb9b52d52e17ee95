//! How a unit is described before it starts.

use std::net::SocketAddr;
use std::rc::{Rc, Weak};

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::connection_handler::Target;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::time::Duration;

use super::Shared;
use super::handle::UnitHandle;
use super::keys::Given;
use super::state::{Program, Settings, Stored, Storing, UnitState};

/// A unit that has not started; made by [`World::m_unit`](super::World::m_unit) and
/// [`World::s_unit`](super::World::s_unit).
#[must_use = "it does nothing until it is started"]
pub struct NewUnit {
    shared: Weak<Shared>,
    settings: Settings,
    segment: u8,
    ahead: Duration,
}

impl NewUnit {
    pub(super) fn m_unit(shared: &Rc<Shared>, name: &str, id: u32) -> Self {
        let identity = Identity::m_unit(name, id).expect("a name has 1 to 32 bytes");
        Self::new(shared, identity, Constraints::M_UNIT)
    }

    pub(super) fn s_unit(shared: &Rc<Shared>, name: &str, id: u32) -> Self {
        let identity = Identity::s_unit(name, id).expect("a name has 1 to 32 bytes");
        Self::new(shared, identity, Constraints::S_UNIT)
    }

    fn new(shared: &Rc<Shared>, identity: Identity, constraints: Constraints) -> Self {
        let (mode, seals) = shared.with(|inner| (inner.mode, inner.seals.clone()));
        let settings = Settings {
            identity,
            fleet: Fleet(0),
            target: Target::Everybody,
            m_units: None,
            constraints,
            message_buffers: 16,
            calls_running: None,
            links: usize::from(constraints.maximum_nodes) + 4,
            functions: 64,
            boot_seed: None,
            given: Given::new(mode, seals),
            program: None,
            claims: Stored::default(),
            storing: Storing::Works,
            takes_over: false,
            stands_by: false,
            expects: u16::MAX,
        };
        Self { shared: Rc::downgrade(shared), settings, segment: 0, ahead: Duration::ZERO }
    }

    /// The manager that an s_unit belongs to.
    pub fn joins(mut self, name: &str, id: u32) -> Self {
        self.settings.target = Target::Manager(manager(name, id));
        self
    }

    /// The manager that an s_unit belongs to, dialled at a fixed address without broadcasts.
    pub fn joins_at(mut self, name: &str, id: u32, address: SocketAddr) -> Self {
        self.settings.target = Target::Fixed(manager(name, id), address);
        self
    }

    /// Of all m_units an m_unit connects to these alone, by name and id.
    pub fn m_units(mut self, m_units: &[(&str, u32)]) -> Self {
        let identity = |&(name, id): &(&str, u32)| Identity::m_unit(name, id).expect("a name has 1 to 32 bytes");
        self.settings.m_units = Some(m_units.iter().map(identity).collect());
        self
    }

    /// Units of different fleets do not meet; 0 if not set.
    pub fn fleet(mut self, fleet: u32) -> Self {
        self.settings.fleet = Fleet(fleet);
        self
    }

    /// Its limits, instead of the defaults of its role.
    pub fn constraints(mut self, constraints: Constraints) -> Self {
        self.settings.constraints = constraints;
        self.settings.links = usize::from(constraints.maximum_nodes) + 4;
        self
    }

    /// How many message buffers its links share (16).
    pub fn message_buffers(mut self, count: usize) -> Self {
        self.settings.message_buffers = count;
        self
    }

    /// Calls of one peer that run at the same time; others wait. As many as may wait or run, if it is not said.
    pub fn calls_running(mut self, count: usize) -> Self {
        self.settings.calls_running = Some(count);
        self
    }

    /// Functions that its own list and its view of each peer's list hold (64).
    pub fn functions(mut self, count: usize) -> Self {
        self.settings.functions = count;
        self
    }

    /// Every life of it draws the same random numbers, as a board without a source of noise does.
    pub fn boot_seed(mut self, seed: u64) -> Self {
        self.settings.boot_seed = Some(seed);
        self
    }

    /// Plain or secured, whatever the world's other units are.
    pub fn mode(mut self, mode: Mode) -> Self {
        self.settings.given.mode = mode;
        self
    }

    /// Its keys come from this root instead of 0, so it has none in common with units of another root.
    pub fn keys_of_root(mut self, root: u8) -> Self {
        self.settings.given.root = root;
        self
    }

    /// It has no key for units of this name.
    pub fn without_key_for(mut self, name: &str) -> Self {
        self.settings.given.missing.insert(name.to_owned());
        self
    }

    /// Links that it opens are rekeyed this often, instead of every 12 h.
    pub fn renews_every(mut self, span: Duration) -> Self {
        self.settings.given.renews_every = Some(span);
        self
    }

    /// The segment of the network that hears its broadcasts.
    pub fn in_segment(mut self, segment: u8) -> Self {
        self.segment = segment;
        self
    }

    /// The term of the claim that an m_unit has stored; none unless set. It claims above it in each of its lives.
    pub fn kept_term(mut self, term: u64) -> Self {
        self.settings.claims.own = Claim { term, claimant: 1 << 63 };
        self
    }

    /// A claim of its manager that a vehicle has obeyed and stored, with its tag.
    pub fn has_obeyed(mut self, name: &str, id: u32, tagged: TaggedClaim) -> Self {
        let manager = Identity::m_unit(name, id).expect("a name has 1 to 32 bytes");
        self.settings.claims.obeyed.insert(manager, tagged);
        self
    }

    /// What becomes of what it stores; it works unless set.
    pub fn storing(mut self, storing: Storing) -> Self {
        self.settings.storing = storing;
        self
    }

    /// It raises its claim until that was the highest once.
    pub fn takes_over(mut self) -> Self {
        self.settings.takes_over = true;
        self
    }

    /// It stands by, and does so again when it has stepped down.
    pub fn stands_by(mut self) -> Self {
        self.settings.stands_by = true;
        self
    }

    /// It knows of so many nodes that it is to meet.
    pub fn expects(mut self, nodes: u16) -> Self {
        self.settings.expects = nodes;
        self
    }

    /// Its own clock is so far ahead of the virtual time; what it is told comes in virtual time all the same.
    pub fn clock(mut self, ahead: Duration) -> Self {
        self.ahead = ahead;
        self
    }

    /// What it does when it starts, in this life and after each restart: add services, publish, spawn futures. State
    /// that is made in here is lost in a crash, as in a real program.
    pub fn program(mut self, program: impl Fn(&UnitHandle) + 'static) -> Self {
        let program: Program = Rc::new(program);
        self.settings.program = Some(program);
        self
    }

    /// Starts it.
    ///
    /// # Panics
    /// For an s_unit without a manager.
    pub fn start(self) -> UnitHandle {
        let shared = self.shared.upgrade().expect("the world outlives its units");
        let manages = self.settings.identity.role() == cara_core::distribution::identity::Role::MUnit;
        assert!(manages || self.settings.target != Target::Everybody, "an s_unit joins a manager");
        let host = shared.with(|inner| {
            let host = inner.network.add_host_in(self.segment);
            inner.network.set_clock(host, self.ahead);
            inner.units.push(UnitState::new(host, self.settings));
            inner.start(&shared, host);
            host
        });
        let handle = UnitHandle::new(Rc::downgrade(&shared), host);
        shared.run_urgent();
        handle
    }
}

fn manager(name: &str, id: u32) -> Manager {
    Manager::new(name, id).expect("a manager's name has 1 to 32 bytes")
}
