//! The keys of a fleet, and all the keys that an attacker may have instead.

use cara_core::distribution::identity::{Fleet, Identity};
use cara_secure::keys::PairKey;
use cara_std::keys::{FleetKeys, KeyRing};

/// A fleet whose keys have been changed since its nodes got their first ones.
pub struct Ground {
    /// The fleet.
    pub fleet: Fleet,
    keys: FleetKeys,
    depot: KeyRing,
    earlier: KeyRing,
    elsewhere: KeyRing,
    next_door: KeyRing,
    vehicles: u32,
}

/// The keys that an attacker can try on the link between the manager and one vehicle.
#[derive(Clone, Debug)]
pub struct Keys {
    /// The right one.
    pub genuine: PairKey,
    /// Drawn from another root.
    pub wrong: PairKey,
    /// The manager's key with another vehicle: in the flash of one that was stolen.
    pub of_another_unit: PairKey,
    /// The right one until the fleet's keys were changed.
    pub revoked: PairKey,
    /// That of two units of the same names in another fleet.
    pub of_another_fleet: PairKey,
}

/// The manager of every fleet here.
pub fn depot() -> Identity {
    Identity::m_unit("depot", 1).expect("a short name")
}

/// A vehicle.
pub fn agv(id: u32) -> Identity {
    Identity::s_unit("agv", id).expect("a short name")
}

fn drawn(fleet: Fleet, vehicles: u32) -> FleetKeys {
    let mut keys = FleetKeys::draw(fleet).expect("the kernel has random numbers");
    keys.add(&depot(), &[]).expect("a new node");
    (1..=vehicles).for_each(|id| keys.add(&agv(id), &[]).expect("a new node"));
    keys
}

fn ring(keys: &FleetKeys, node: &Identity) -> KeyRing {
    keys.ring(node).expect("a node of the fleet")
}

impl Ground {
    /// A fleet of its own with vehicles 1 to `vehicles`.
    pub fn new(vehicles: u32) -> Self {
        let fleet = Fleet(cara_processes::random_fleet());
        let next = Fleet(fleet.0.wrapping_add(1));
        let mut keys = drawn(fleet, vehicles);
        let earlier = ring(&keys, &depot());
        for change in [FleetKeys::rotate, FleetKeys::switch, FleetKeys::finish] {
            change(&mut keys).expect("one step after the other");
        }
        Self {
            fleet,
            depot: ring(&keys, &depot()),
            keys,
            earlier,
            elsewhere: ring(&drawn(fleet, vehicles), &depot()),
            next_door: ring(&drawn(next, vehicles), &depot()),
            vehicles,
        }
    }

    /// The ring of a node.
    pub fn ring(&self, node: &Identity) -> KeyRing {
        ring(&self.keys, node)
    }

    /// The ring that a node had before the fleet's keys were changed.
    pub fn earlier(&self) -> &KeyRing {
        &self.earlier
    }

    /// The ring of a manager of the same name, of a root of its own.
    pub fn elsewhere(&self) -> &KeyRing {
        &self.elsewhere
    }

    /// The vehicle of a number, whatever the number.
    pub fn vehicle(&self, number: u32) -> u32 {
        number % self.vehicles + 1
    }

    /// The keys for the link with a vehicle.
    pub fn keys(&self, vehicle: u32) -> Keys {
        let of = |ring: &KeyRing, id| ring.pair(&agv(id)).expect("a vehicle of the fleet").clone();
        Keys {
            genuine: of(&self.depot, vehicle),
            wrong: of(&self.elsewhere, vehicle),
            of_another_unit: of(&self.depot, self.vehicle(vehicle)),
            revoked: of(&self.earlier, vehicle),
            of_another_fleet: of(&self.next_door, vehicle),
        }
    }
}
