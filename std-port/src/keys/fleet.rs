//! A fleet's root and its nodes, and the ring of each.

use cara_core::distribution::identity::{Fleet, Identity, Role};
use cara_secure::keys::{DiscoveryKey, FINGERPRINT_BYTES, RootKey};

use super::members::{Member, Members};
use super::ring::Generation;
use super::{FleetError, KeyError, KeyRing, draw};

/// A fleet's root and its nodes. Its holder can speak as every node.
#[derive(Debug)]
pub struct FleetKeys {
    root: RootKey,
    members: Members,
}

impl FleetKeys {
    /// Draws the root of a fleet without nodes.
    pub fn draw(fleet: Fleet) -> Result<Self, KeyError> {
        Ok(Self::of_root(fleet, RootKey::new(*draw()?)))
    }

    /// A fleet without nodes whose root is kept, and was drawn, elsewhere.
    pub fn of_root(fleet: Fleet, root: RootKey) -> Self {
        Self::new(root, Members::new(fleet))
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

    /// As [`add`](Self::add) for several nodes: m_units first, so that others can belong to them. `managers` are those of the
    /// s_units.
    pub fn add_all(&mut self, nodes: &[Identity], managers: &[Identity]) -> Result<(), FleetError> {
        let (m_units, s_units): (Vec<_>, Vec<_>) = nodes.iter().partition(|node| node.role() == Role::MUnit);
        // Without s_units, managers can only be meant for the m_units, which is an error to report.
        let of_m_units = if s_units.is_empty() { managers } else { &[] };
        m_units.into_iter().try_for_each(|node| self.add(node, of_m_units))?;
        s_units.into_iter().try_for_each(|node| self.add(node, managers))
    }

    /// Takes nodes out of all rings, and [begins](Self::rotate) a generation without them. Until the change is
    /// [finished](Self::finish) they can still make discovery messages that pass for the fleet's, but no link with them
    /// is opened. If one of them is not in the fleet, nothing changes; nodes that were revoked already stay so.
    pub fn revoke(&mut self, identities: &[Identity]) -> Result<(), FleetError> {
        self.members.revoke(identities)
    }

    /// Begins a generation. Nodes go on speaking with the one in use, and take the new one as well.
    pub fn rotate(&mut self) -> Result<(), FleetError> {
        self.members.rotate()
    }

    /// Uses the generation that has begun: when all nodes take it. They take the one before as well.
    pub fn switch(&mut self) -> Result<(), FleetError> {
        self.members.switch()
    }

    /// Ends the generation before: when all nodes use the new one. A node that does not is locked out.
    pub fn finish(&mut self) -> Result<(), FleetError> {
        self.members.finish()
    }

    /// The key for discovery of a generation, of one that is over as well.
    pub fn discovery(&self, generation: u32) -> DiscoveryKey {
        self.root.discovery(self.members.fleet(), generation)
    }

    /// The ring of a node.
    pub fn ring(&self, identity: &Identity) -> Result<KeyRing, FleetError> {
        let node = self.members.node(identity)?;
        let used = self.generation(node, self.members.generation());
        let beside = self.members.beside().map(|number| self.generation(node, number));
        Ok(KeyRing::new(self.members.fleet(), identity.clone(), used, beside))
    }

    fn generation(&self, node: &Member, number: u32) -> Generation {
        let fleet = self.members.fleet();
        let itself = (node.identity.role() == Role::MUnit && node.since <= number).then_some(node);
        let peers = || self.members.peers(node).chain(itself).filter(|peer| peer.since.max(node.since) <= number);
        let mut pairs = Vec::with_capacity(peers().count());
        pairs.extend(peers().map(|Member { identity, .. }| {
            (identity.clone(), self.root.pair(fleet, number, &node.identity, identity))
        }));
        pairs.sort_unstable_by(|(one, _), (other, _)| one.cmp(other));
        Generation { number, discovery: self.discovery(number), pairs }
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

    /// Whether a node that speaks with the first of its keys is understood by another one, and so the other way round.
    fn understand(one: &KeyRing, other: &KeyRing) -> bool {
        let hears = |listener: &KeyRing, speaker: &KeyRing| {
            let said = speaker.pair(listener.identity()).map(|key| *key.expose());
            let pairs: Vec<_> = listener.pairs(speaker.identity()).map(|(_, key)| *key.expose()).collect();
            let discovery = listener.discoveries().any(|(_, key)| key.expose() == speaker.discovery().expose());
            said.is_some_and(|said| pairs.contains(&said)) && discovery
        };
        hears(one, other) && hears(other, one)
    }

    /// A file of one step works with one of the next, in whatever order the nodes get theirs.
    #[test]
    fn a_change_of_keys_locks_nobody_out_in_whatever_order_files_come() {
        let mut keys = fleet();
        let rings = |keys: &FleetKeys| [depot(), agv(1)].map(|node| keys.ring(&node).unwrap());
        let mut steps = vec![rings(&keys)];
        keys.rotate().unwrap();
        steps.push(rings(&keys));
        keys.switch().unwrap();
        steps.push(rings(&keys));
        keys.finish().unwrap();
        steps.push(rings(&keys));
        keys.revoke(&[agv(2)]).unwrap();
        steps.push(rings(&keys));
        for pair in steps.windows(2) {
            let [before, after] = pair else { unreachable!("pairs") };
            for (manager, vehicle) in [(before, before), (before, after), (after, before), (after, after)] {
                assert!(understand(&manager[0], &vehicle[1]));
            }
        }
        assert!(!understand(&steps[0][0], &steps[3][1]), "two steps at once lock out");
        let used: Vec<_> = steps.iter().map(|[manager, _]| generations(manager, &agv(1))).collect();
        assert_eq!(used, [vec![1], vec![1, 2], vec![2, 1], vec![2], vec![2, 3]]);
    }

    #[test]
    fn who_is_revoked_shares_no_key_with_anybody() {
        let mut keys = fleet();
        let stolen = keys.ring(&agv(1)).unwrap();
        keys.revoke(&[agv(1)]).unwrap();
        assert_eq!(keys.ring(&agv(1)).map(drop), Err(FleetError::Revoked(Fleet(7), agv(1))));
        let manager = keys.ring(&depot()).unwrap();
        assert!(manager.pair(&agv(1)).is_none());
        assert_eq!(generations(&manager, &agv(2)), [1, 2]);
        // Its successor has none of its pair keys, and can speak with all its peers.
        keys.add(&agv(1), &[]).unwrap();
        let (manager, successor) = (keys.ring(&depot()).unwrap(), keys.ring(&agv(1)).unwrap());
        assert_eq!((generations(&manager, &agv(1)), generations(&successor, &depot())), (vec![2], vec![2]));
        assert_ne!(successor.pair(&depot()).unwrap().expose(), stolen.pair(&depot()).unwrap().expose());
        assert!(understand(&manager, &successor) && !understand(&manager, &stolen));
        keys.switch().unwrap();
        keys.finish().unwrap();
        let manager = keys.ring(&depot()).unwrap();
        assert!(manager.discoveries().all(|(_, key)| key.expose() != stolen.discovery().expose()));
    }

    #[test]
    fn nothing_of_the_root_is_shown() {
        let members = Members::new(Fleet(7));
        let keys = FleetKeys::new(RootKey::new([0xC7; 32]), members);
        let shown = format!("{keys:?}");
        assert!(!shown.contains("199, 199") && !shown.to_lowercase().contains("c7c7"), "{shown}");
    }
}
