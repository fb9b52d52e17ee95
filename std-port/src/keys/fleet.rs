//! A fleet's root and its nodes, and the ring of each.

use cara_core::distribution::identity::{Fleet, Identity};
use cara_secure::keys::{FINGERPRINT_BYTES, RootKey};

use super::members::{Member, Members};
use super::ring::Generation;
use super::{FleetError, KeyError, KeyRing, draw};

/// A fleet's root and its nodes. Whoever has it can speak as every node.
#[derive(Debug)]
pub struct FleetKeys {
    root: RootKey,
    members: Members,
}

impl FleetKeys {
    /// Draws the root of a fleet without nodes.
    pub fn draw(fleet: Fleet) -> Result<Self, KeyError> {
        Ok(Self::new(RootKey::new(*draw()?), Members::new(fleet)))
    }

    pub(super) fn new(root: RootKey, members: Members) -> Self {
        Self { root, members }
    }

    pub(super) fn root(&self) -> &RootKey {
        &self.root
    }

    /// The nodes.
    pub fn members(&self) -> &Members {
        &self.members
    }

    /// What may be shown of the root.
    pub fn fingerprint(&self) -> [u8; FINGERPRINT_BYTES] {
        self.root.fingerprint()
    }

    /// Adds a node. An s_unit belongs to `managers`, or where none are named to the only m_unit of the fleet; one that is
    /// there already belongs to others from now on, if any are named. A node that was revoked comes back with keys that
    /// it never had.
    pub fn add(&mut self, identity: &Identity, managers: &[Identity]) -> Result<(), FleetError> {
        self.members.add(identity, managers)
    }

    /// Takes nodes out of all rings, and begins a generation that they have nothing of. Until older generations are
    /// [finished](Self::finish) they can still make discovery messages that others take for the fleet's; nobody opens a
    /// link to them. Where one of them is no node of the fleet, nothing changes.
    pub fn revoke(&mut self, identities: &[Identity]) -> Result<(), FleetError> {
        self.members.revoke(identities)
    }

    /// Begins a generation. Those before it stay in use until they are [finished](Self::finish).
    pub fn rotate(&mut self) -> Result<(), FleetError> {
        self.members.rotate()
    }

    /// Ends all generations but the newest. A node that has not been given that one is locked out.
    pub fn finish(&mut self) -> Result<(), FleetError> {
        self.members.finish()
    }

    /// The ring of a node.
    pub fn ring(&self, identity: &Identity) -> Result<KeyRing, FleetError> {
        let node = self.members.node(identity)?;
        let older = self.members.generations().skip(1).filter(|number| *number >= node.since);
        let older = older.map(|number| self.generation(node, number)).collect();
        let newest = self.generation(node, self.members.generation());
        Ok(KeyRing::new(self.members.fleet(), identity.clone(), newest, older))
    }

    fn generation(&self, node: &Member, number: u32) -> Generation {
        let fleet = self.members.fleet();
        let peers = || self.members.peers(node).filter(|peer| peer.since <= number);
        let mut pairs = Vec::with_capacity(peers().count());
        pairs.extend(peers().map(|Member { identity, .. }| {
            (identity.clone(), self.root.pair(fleet, number, &node.identity, identity))
        }));
        Generation { number, discovery: self.root.discovery(fleet, number), pairs }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    fn depot() -> Identity {
        Identity::m_unit("depot", 1).unwrap()
    }

    fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    fn fleet() -> FleetKeys {
        let mut keys = FleetKeys::draw(Fleet(7)).unwrap();
        [depot(), agv(1), agv(2)].iter().for_each(|node| keys.add(node, &[]).unwrap());
        keys
    }

    fn generations(ring: &KeyRing, peer: &Identity) -> Vec<u32> {
        ring.pairs(peer).map(|(number, _)| number).collect()
    }

    #[test]
    fn both_ends_have_the_same_keys_and_no_third_one_has_them() {
        let keys = fleet();
        let rings = [depot(), agv(1), agv(2)].map(|node| keys.ring(&node).unwrap());
        let [ours, one, two] = &rings;
        assert_eq!(ours.pair(&agv(1)).unwrap().expose(), one.pair(&depot()).unwrap().expose());
        assert_eq!(ours.pair(&agv(2)).unwrap().expose(), two.pair(&depot()).unwrap().expose());
        assert_ne!(one.pair(&depot()).unwrap().expose(), two.pair(&depot()).unwrap().expose());
        assert!(one.pair(&agv(2)).is_none() && two.pair(&agv(1)).is_none());
        assert_eq!(HashSet::from(rings.each_ref().map(|ring| *ring.discovery().expose())).len(), 1);
        assert_ne!(fleet().fingerprint(), keys.fingerprint(), "roots are drawn");
    }

    /// At every moment of a change each two nodes have a generation in common, whoever of them has been given its ring.
    #[test]
    fn a_change_of_keys_locks_nobody_out_before_it_is_finished() {
        let mut keys = fleet();
        let rings = |keys: &FleetKeys| [depot(), agv(1)].map(|node| keys.ring(&node).unwrap());
        let mut states = vec![rings(&keys)];
        keys.rotate().unwrap();
        states.push(rings(&keys));
        assert_eq!(states[1][0].generations().collect::<Vec<_>>(), [2, 1]);
        for (manager, vehicle) in [(0, 1), (1, 0), (1, 1)] {
            let (manager, vehicle) = (&states[manager][0], &states[vehicle][1]);
            let common: Vec<_> =
                manager.pairs(&agv(1)).filter(|(number, _)| vehicle.pair_in(*number, &depot()).is_some()).collect();
            assert!(!common.is_empty());
            for (number, key) in common {
                assert_eq!(key.expose(), vehicle.pair_in(number, &depot()).unwrap().expose());
                assert_eq!(
                    manager.discovery_in(number).unwrap().expose(),
                    vehicle.discovery_in(number).unwrap().expose()
                );
            }
        }
        keys.finish().unwrap();
        let [manager, _] = rings(&keys);
        assert_eq!((generations(&manager, &agv(1)), manager.discovery_in(1).is_none()), (vec![2], true));
    }

    #[test]
    fn who_is_revoked_shares_no_key_with_anybody() {
        let mut keys = fleet();
        let stolen = keys.ring(&agv(1)).unwrap();
        keys.revoke(&[agv(1)]).unwrap();
        assert_eq!(keys.ring(&agv(1)).map(drop), Err(FleetError::Unknown(agv(1))));
        let manager = keys.ring(&depot()).unwrap();
        assert!(manager.pair(&agv(1)).is_none());
        assert_eq!(generations(&manager, &agv(2)), [2, 1]);
        assert_ne!(manager.discovery().expose(), stolen.discovery().expose());
        // Its successor has nothing that it had.
        keys.add(&agv(1), &[]).unwrap();
        let (manager, successor) = (keys.ring(&depot()).unwrap(), keys.ring(&agv(1)).unwrap());
        assert_eq!((generations(&manager, &agv(1)), generations(&successor, &depot())), (vec![2], vec![2]));
        assert_eq!(successor.generations().collect::<Vec<_>>(), [2]);
        assert_ne!(successor.pair(&depot()).unwrap().expose(), stolen.pair(&depot()).unwrap().expose());
    }

    #[test]
    fn nothing_of_the_root_is_shown() {
        let members = Members::new(Fleet(7));
        let keys = FleetKeys::new(RootKey::new([0xC7; 32]), members);
        let shown = format!("{keys:?}");
        assert!(!shown.contains("199, 199") && !shown.to_lowercase().contains("c7c7"), "{shown}");
    }
}
