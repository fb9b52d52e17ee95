//! Keys of units on Linux. Which units a scenario has shows while it runs, and rings are made before: so each fleet has
//! keys for all nodes that any scenario names.

use std::collections::BTreeMap;

use cara_core::distribution::identity::{Fleet, Identity, Role};
use cara_std::keys::{FleetKeys, KeyRing};

const M_UNITS: [(&str, u32); 10] = [
    ("manager", 1),
    ("manager", 2),
    ("manager", 9),
    ("one", 1),
    ("two", 2),
    ("station", 2),
    ("boss", 1),
    ("a", 1),
    ("b", 2),
    ("twin", 1),
];
const S_UNITS: [&str; 11] =
    ["agv", "one", "two", "three", "other", "quick", "newcomer", "late", "bystander", "bad", "gone"];
const IDS: [u32; 13] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 20, 30, 99];
/// Units that scenarios number.
const NUMBERED: u32 = 8;

/// The keys of the fleets of one scenario.
#[derive(Default)]
pub(super) struct Keys(BTreeMap<u32, FleetKeys>);

impl Keys {
    /// The ring of a unit.
    pub(super) fn ring(&mut self, fleet: u32, own: &Identity) -> KeyRing {
        let keys = self.0.entry(fleet).or_insert_with(|| draw(Fleet(fleet)));
        keys.ring(own).unwrap_or_else(|_| panic!("{own} has no keys: name it in {}", file!()))
    }
}

fn draw(fleet: Fleet) -> FleetKeys {
    let mut keys = FleetKeys::draw(fleet).expect("the system gives random numbers");
    let m_units: Vec<_> = all().filter(|node| node.role() == Role::MUnit).collect();
    keys.add_all(&all().collect::<Vec<_>>(), &m_units).expect("all have managers");
    keys
}

fn all() -> impl Iterator<Item = Identity> {
    let m_units = M_UNITS.into_iter().map(|(name, id)| Identity::m_unit(name, id));
    let m_units = m_units.chain((0..NUMBERED).map(|id| Identity::m_unit(&format!("caller-{id}"), id)));
    let s_units = S_UNITS.into_iter().flat_map(|name| IDS.map(|id| Identity::s_unit(name, id)));
    let s_units = s_units.chain((0..NUMBERED).map(|id| Identity::s_unit(&format!("agv-{id}"), 10 + id)));
    m_units.chain(s_units).map(|identity| identity.expect("a short name"))
}
