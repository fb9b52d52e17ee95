//! Configuration of a unit before it starts.

use cara_core::config::Constraints;
use cara_core::distribution::claim::{Claim, StoredClaim};
use cara_core::distribution::connection_handler::{NodeConfig, Target};
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::error::Error;
use cara_core::services::access::Access;
use core::fmt;
use core::net::SocketAddrV4;

use crate::security::Security;

/// Identity of a unit, and constraints unless they follow from its [`Limits`](crate::Limits).
#[derive(Debug)]
pub struct Config {
    pub(crate) node: NodeConfig<SocketAddrV4>,
    pub(crate) constraints: Option<Constraints>,
    pub(crate) security: Security,
    pub(crate) access: Table,
    pub(crate) claim: Claim,
    pub(crate) store_own: Option<fn(Claim) -> bool>,
    pub(crate) obeyed: StoredClaim,
    pub(crate) store: Option<fn(&StoredClaim) -> bool>,
    pub(crate) starts_stopped: Option<u16>,
}

/// The access table, if there is one.
#[derive(Clone, Copy, Default)]
pub(crate) struct Table(pub(crate) Option<&'static dyn Access>);

impl fmt::Debug for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "set" } else { "none" })
    }
}

impl Config {
    /// An s_unit, which joins the manager of the given name and id and no other.
    pub fn s_unit(name: &str, id: u32, manager_name: &str, manager_id: u32, security: Security) -> Result<Self, Error> {
        let manager = Manager::new(manager_name, manager_id)?;
        Ok(Self::new(Identity::s_unit(name, id)?, Target::Manager(manager), security))
    }

    /// An m_unit.
    #[cfg(feature = "manager")]
    pub fn m_unit(name: &str, id: u32, security: Security) -> Result<Self, Error> {
        let unit = Self::new(Identity::m_unit(name, id)?, Target::Everybody, security);
        let port = unit.node.udp_port;
        Ok(unit.tcp_port(port))
    }

    fn new(identity: Identity, target: Target<SocketAddrV4>, mut security: Security) -> Self {
        let (seed, udp_port) = (security.0.seed(), security.0.mode().port());
        let (fleet, epoch, constraints) = (Fleet(0), Epoch(seed), Constraints::S_UNIT);
        let node = NodeConfig { identity, fleet, epoch, target, tcp_port: 0, udp_port, constraints, seed };
        let (claim, obeyed) = (Claim::NONE, StoredClaim::default());
        let access = Table(None);
        Self {
            node,
            constraints: None,
            security,
            access,
            claim,
            store_own: None,
            obeyed,
            store: None,
            starts_stopped: None,
        }
    }

    /// The manager of an s_unit.
    pub(crate) fn manager(&self) -> Option<Identity> {
        match &self.node.target {
            Target::Everybody => None,
            Target::Manager(manager) | Target::Fixed(manager, _) => Identity::m_unit(&manager.name, manager.id).ok(),
        }
    }

    /// Units of different fleets on one network do not meet; 0 unless set.
    pub fn fleet(mut self, fleet: u32) -> Self {
        self.node.fleet = Fleet(fleet);
        self
    }

    /// The constraints to begin with; [`Limits::constraints`](crate::Limits::constraints) unless set. A `const` of
    /// [`Limits::check`](crate::Limits::check) fits the memory.
    pub fn constraints(mut self, constraints: Constraints) -> Self {
        self.constraints = Some(constraints);
        self
    }

    /// The epoch of this start, instead of a drawn one (or one from the seed of an insecure unit): for example a count of
    /// starts, on a board without a source of noise.
    pub fn epoch(mut self, epoch: u64) -> Self {
        self.node.epoch = Epoch(epoch);
        self
    }

    /// The TCP port on which an m_unit takes connections; that of discovery unless set.
    pub fn tcp_port(mut self, port: u16) -> Self {
        if self.node.identity.role() == Role::MUnit {
            self.node.tcp_port = port;
        }
        self
    }

    /// The access table; without one, a joined node may do everything. A `static`, or a `const` array of
    /// [`Rule`](cara_core::services::access::Rule)s:
    ///
    /// ```
    /// use cara_core::services::access::{Functions, Rule, Verbs, Who};
    /// use cara_embassy::{Config, Security};
    ///
    /// const RULES: [Rule; 2] = [
    ///     Rule::new(Who::node("AGV_manager", 1), Functions::All, Verbs::CALL),
    ///     Rule::new(Who::M_UNITS, Functions::Named(&["pos_info"]), Verbs::CALL),
    /// ];
    /// let config = Config::s_unit("agv-07", 7, "AGV_manager", 1, Security::insecure(0x5EED))?.access(&RULES);
    /// # Ok::<(), cara_core::error::Error>(())
    /// ```
    pub fn access(mut self, table: &'static dyn Access) -> Self {
        self.access = Table(Some(table));
        self
    }

    /// The claim that the board has stored in an earlier life, and what stores another one; the default is none. `store` is called before
    /// the first moving call under another claim and while no order is live, so that it may write to flash; it returns whether it
    /// is stored, and must not use the unit. Without this, and in plain mode, a board that restarts forgets which managers it has
    /// to refuse.
    pub fn obeyed_claim(mut self, stored: StoredClaim, store: fn(&StoredClaim) -> bool) -> Self {
        (self.obeyed, self.store) = (stored, Some(store));
        self
    }

    /// The claim of an m_unit: [raised](Claim::raised) above the last one, and stored, before this; and what stores a higher one, which
    /// returns whether it is stored, and is called while no order of this unit lives. Without this an m_unit begins with the first term in each life.
    pub fn claim(mut self, claim: Claim, store: fn(Claim) -> bool) -> Self {
        (self.claim, self.store_own) = (claim, Some(store));
        self
    }

    /// All that the unit moves starts stopped, for this reason ([`Error::Inhibited`]), until a service resets it: for a board that has
    /// kept that it was stopped, or that cannot keep it.
    pub fn starts_stopped(mut self, reason: u16) -> Self {
        self.starts_stopped = Some(reason);
        self
    }

    /// An s_unit's manager is at this address: it is dialled, and nothing is broadcast.
    pub fn manager_address(mut self, address: SocketAddrV4) -> Self {
        if let Target::Manager(manager) = self.node.target {
            self.node.target = Target::Fixed(manager, address);
        }
        self
    }
}
