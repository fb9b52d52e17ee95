//! Configuration of a unit before it starts.

use cara_core::config::{CHUNK_BYTES, Constraints, MINIMUM_CHUNK_BYTES};
use cara_core::distribution::connection_handler::Target;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::error::Error;
use cara_core::host::secure::DATAGRAM_OVERHEAD;
use cara_core::services::access::Access;
use cara_core::services::unit::buffer_bytes;
use core::fmt;
use core::net::SocketAddr;

use crate::security::{OVERHEAD, Security};

/// Most that a session datagram adds to what a message in chunks takes, sealed or not.
const DATAGRAM_SLACK: usize = 8 + if cfg!(feature = "secure") { DATAGRAM_OVERHEAD } else { 0 };

/// Bytes that `MESSAGE` of [`Resources`](crate::Resources) needs for messages of `message_size`, sealed if the crate has its
/// feature `secure`.
pub const fn message_buffer(message_size: u32) -> usize {
    buffer_bytes(message_size, OVERHEAD) + DATAGRAM_SLACK
}

/// Identity and limits of a unit.
#[derive(Debug)]
pub struct Config {
    pub(crate) identity: Identity,
    pub(crate) target: Target,
    pub(crate) fleet: Fleet,
    pub(crate) constraints: Constraints,
    pub(crate) security: Security,
    pub(crate) seed: u64,
    pub(crate) epoch: u64,
    pub(crate) tcp_port: u16,
    pub(crate) access: Table,
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
        Ok(Self::new(Identity::s_unit(name, id)?, Target::Manager(manager), Constraints::S_UNIT, security))
    }

    /// An m_unit.
    pub fn m_unit(name: &str, id: u32, security: Security) -> Result<Self, Error> {
        let constraints = Constraints { maximum_nodes: 4, ..Constraints::S_UNIT };
        Ok(Self::new(Identity::m_unit(name, id)?, Target::Everybody, constraints, security))
    }

    fn new(identity: Identity, target: Target, constraints: Constraints, mut security: Security) -> Self {
        let seed = security.0.seed();
        Self {
            identity,
            target,
            fleet: Fleet(0),
            constraints,
            seed,
            epoch: seed,
            tcp_port: security.0.mode().port(),
            security,
            access: Table(None),
        }
    }

    /// Units of different fleets on one network do not meet; 0 unless set.
    pub fn fleet(mut self, fleet: u32) -> Self {
        self.fleet = Fleet(fleet);
        self
    }

    /// The limits to begin with; those of an s_unit unless set, with four nodes for an m_unit.
    pub fn constraints(mut self, constraints: Constraints) -> Self {
        self.constraints = constraints;
        self
    }

    /// This life of the unit, if it is not to be drawn, or the seed of an insecure one: a count of starts, on a board
    /// without a source of noise.
    pub fn epoch(mut self, epoch: u64) -> Self {
        self.epoch = epoch;
        self
    }

    /// The TCP port on which an m_unit takes connections; that of discovery unless set.
    pub fn tcp_port(mut self, port: u16) -> Self {
        self.tcp_port = port;
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

    /// An s_unit's manager is at this address: it is dialled, and nothing is broadcast.
    pub fn manager_address(mut self, address: SocketAddr) -> Self {
        if let Target::Manager(manager) = self.target {
            self.target = Target::Fixed(manager, address);
        }
        self
    }
}

/// [`Error::BadConstraint`] for constraints that so much memory cannot hold.
pub(crate) fn check(constraints: &Constraints, links: usize, buffer: usize) -> Result<(), Error> {
    let chunk = usize::from(constraints.chunk_size);
    let sound = constraints.maximum_nodes > 0
        && usize::from(constraints.maximum_nodes) <= links
        && message_buffer(constraints.message_size) <= buffer
        && (MINIMUM_CHUNK_BYTES..=CHUNK_BYTES).contains(&chunk)
        && (cara_core::config::SHORTEST_KEEP_ALIVE..=cara_core::config::LONGEST_KEEP_ALIVE)
            .contains(&constraints.keep_alive)
        && constraints.calls_per_peer > 0;
    if sound { Ok(()) } else { Err(Error::BadConstraint) }
}

#[cfg(test)]
mod tests {
    use super::{DATAGRAM_OVERHEAD, message_buffer};
    use cara_core::distribution::datagram::SESSION_HEADER_BYTES;
    use cara_core::distribution::message::{REQUEST_BYTES, SessionBody};

    #[test]
    fn a_message_in_one_datagram_fits_the_buffers_of_datagrams() {
        let sealed = if cfg!(feature = "secure") { DATAGRAM_OVERHEAD } else { 0 };
        let around = SESSION_HEADER_BYTES + SessionBody::message_prefix(0).len() + REQUEST_BYTES + sealed;
        for size in 0..2_000 {
            assert!(message_buffer(size) >= around + size as usize, "{size}");
        }
    }
}
