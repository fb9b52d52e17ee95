//! Keys and limits for units of tests. The root of the keys is made of the fleet's number alone, so that all processes of a test have
//! the same one.

use cara_std::keys::{FleetKeys, KeyRing, RootKey};
use cara_std::{Builder, CommunicationSystem, Constraints, Duration, Fleet, Identity, MUnit, Role, SUnit, Unit};

/// The limits of an m_unit of a test: a call that names no time-out ends after longer than a thread waits for its turn on a busy
/// machine. A test that sets other limits sets this too where it depends on it.
#[allow(dead_code, reason = "some tests have limits of their own")]
pub(crate) const M_UNIT: Constraints = Constraints { request_timeout: Duration::from_secs(20), ..Constraints::M_UNIT };
/// Those of an s_unit.
#[allow(dead_code, reason = "some tests have limits of their own")]
pub(crate) const S_UNIT: Constraints = Constraints {
    request_timeout: M_UNIT.request_timeout,
    message_size: M_UNIT.message_size,
    chunk_size: M_UNIT.chunk_size,
    ..Constraints::S_UNIT
};

/// The ring of a unit of a test's fleet, which meets these others.
pub(crate) fn ring(fleet: u32, own: &Identity, others: &[Identity]) -> KeyRing {
    let mut root = [0; 32];
    root[..4].copy_from_slice(&fleet.to_le_bytes());
    let mut keys = FleetKeys::of_root(Fleet(fleet), RootKey::new(root));
    let all = [others, std::slice::from_ref(own)].concat();
    let m_units = all.iter().filter(|node| node.role() == Role::MUnit).cloned().collect::<Vec<_>>();
    keys.add_all(&all, if m_units.len() < all.len() { &m_units } else { &[] }).unwrap();
    keys.ring(own).unwrap()
}

/// Gives a unit its fleet and its keys.
pub(crate) fn keyed<R>(builder: Builder<(), R>, fleet: u32, own: &Identity, others: &[Identity]) -> Builder<(), R> {
    builder.fleet(fleet).keys(ring(fleet, own, others))
}

/// `manager/1` and its `agv/7`.
#[allow(dead_code, reason = "some tests have more units, and name them themselves")]
pub(crate) fn pair(fleet: u32) -> (Builder<(), MUnit>, Builder<(), SUnit>) {
    let nodes = [Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap()];
    let manager = CommunicationSystem::builder("manager", 1).unwrap().constraints(M_UNIT);
    let agv = Unit::builder("agv", 7, "manager", 1).unwrap().constraints(S_UNIT);
    (keyed(manager, fleet, &nodes[0], &nodes), keyed(agv, fleet, &nodes[1], &nodes))
}
