//! The keys with which a survey asks secured fleets, and tells whose datagrams are.

use std::collections::BTreeSet;
use std::path::Path;

use cara_core::distribution::authenticator::CODE_BYTES;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_secure::keyring::{Codes, Keyring};
use cara_secure::mac::Authenticates;

use super::Standing;
use crate::keys::{DiscoveryKey, FleetKeys, KeyError, KeyRing, PairKey, Store, location};

/// Most files that are read.
const FILES: usize = 1024;
/// Most keys that are kept: each datagram may be checked with all of one fleet.
const KEYS: usize = 64;
/// Generations before the newest one that a root is asked for.
const OLD: u32 = 16;
/// Most files that are told as refused.
const REFUSED: usize = 8;

/// Discovery keys of fleets. Each proves membership in the fleet; none of them opens a link.
#[derive(Debug, Default)]
pub struct SurveyKeys {
    keys: Vec<Known>,
    /// Sources of keys so far.
    sources: u32,
    refused: Vec<KeyError>,
}

#[derive(Debug)]
struct Known {
    fleet: Fleet,
    generation: u32,
    key: DiscoveryKey,
    /// Its source, or the last one that has a key in common with it.
    root: u32,
    /// Units of the fleet speak with it, as far as is known here.
    in_use: bool,
}

impl SurveyKeys {
    /// All that this user has in the places where keys are looked for ([`location`]): rings of units, and roots.
    pub fn gather() -> Self {
        let mut keys = Self::default();
        location::rings().into_iter().take(FILES).for_each(|path| keys.add_file(&path));
        for folder in location::folders() {
            for fleet in Store::fleets(&folder) {
                match Store::peek(&folder, fleet) {
                    Ok(root) => keys.add_root(&root),
                    Err(error) => keys.refuse(error),
                }
            }
        }
        keys
    }

    /// Those of one unit's file.
    pub fn of_file(path: &Path) -> Result<Self, KeyError> {
        let mut keys = Self::default();
        keys.add_ring(&KeyRing::load(path)?);
        Ok(keys)
    }

    /// Adds those of one unit's file, or what is wrong with it to the [refused](Self::refused).
    pub fn add_file(&mut self, path: &Path) {
        match KeyRing::load(path) {
            Ok(ring) => self.add_ring(&ring),
            Err(error) => self.refuse(error),
        }
    }

    /// Adds those of a unit's ring.
    pub(crate) fn add_ring(&mut self, ring: &KeyRing) {
        self.sources += 1;
        for (generation, key) in ring.discoveries() {
            self.add(ring.fleet(), generation, key.clone(), generation == ring.generation());
        }
    }

    /// Adds those of a fleet's root: of generations that are over as well, so that a unit that was left behind is known.
    pub(crate) fn add_root(&mut self, root: &FleetKeys) {
        let (fleet, used) = (root.members().fleet(), root.members().generation());
        self.sources += 1;
        let newest = root.members().generations().max().unwrap_or(used);
        for generation in newest.saturating_sub(OLD).max(1)..=newest {
            self.add(fleet, generation, root.discovery(generation), generation == used);
        }
    }

    /// Whether there are any of a fleet.
    pub fn has(&self, fleet: Fleet) -> bool {
        self.of(fleet).next().is_some()
    }

    /// The fleets of which there are any.
    pub fn fleets(&self) -> BTreeSet<Fleet> {
        self.keys.iter().map(|known| known.fleet).collect()
    }

    /// Files with keys that were found and not taken, those of other users left out.
    pub fn refused(&self) -> &[KeyError] {
        &self.refused
    }

    /// The standing of the sender of a fleet's search or announce, from all its bytes.
    pub(super) fn standing(&self, fleet: Fleet, datagram: &[u8]) -> Standing {
        let Some((signed, code)) = datagram.split_last_chunk::<CODE_BYTES>().filter(|_| self.has(fleet)) else {
            return Standing::Unchecked;
        };
        let made = self.of(fleet).find(|known| known.key.is_code(&[signed], code));
        made.map_or(Standing::OtherKeys, |known| Standing::Proven { generation: known.generation, root: known.root })
    }

    /// What signs a question to a fleet, for each key that its units may speak with.
    pub(super) fn signers(&self, fleet: Fleet) -> impl Iterator<Item = Codes<Signer<'_>>> {
        self.of(fleet).filter(|known| known.in_use).map(|known| Codes::Keyed(Signer(&known.key)))
    }

    fn of(&self, fleet: Fleet) -> impl Iterator<Item = &Known> {
        self.keys.iter().filter(move |known| known.fleet == fleet)
    }

    fn add(&mut self, fleet: Fleet, generation: u32, key: DiscoveryKey, in_use: bool) {
        let same = |known: &&mut Known| known.fleet == fleet && known.key.expose() == key.expose();
        let full = self.keys.len() >= KEYS;
        match self.keys.iter_mut().find(same) {
            Some(known) => {
                known.in_use |= in_use;
                let merged = known.root;
                let of_it = self.keys.iter_mut().filter(|known| known.root == merged);
                of_it.for_each(|known| known.root = self.sources);
            }
            None if full => {}
            None => self.keys.push(Known { fleet, generation, key, root: self.sources, in_use }),
        }
    }

    /// What belongs to another user, or cannot be opened, is no mistake: a host's units have users of their own.
    fn refuse(&mut self, error: KeyError) {
        let is_mistake = !matches!(error, KeyError::Foreign { .. } | KeyError::System { .. });
        let is_reported = self.refused.iter().any(|known| known.to_string() == error.to_string());
        if is_mistake && !is_reported && self.refused.len() < REFUSED {
            self.refused.push(error);
        }
    }
}

/// Signs for a fleet with its discovery key only; it has no pair keys.
#[derive(Debug)]
pub(super) struct Signer<'k>(&'k DiscoveryKey);

impl Keyring for Signer<'_> {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        (self.0, None)
    }

    fn pair(&self, _peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    fn depot() -> Identity {
        Identity::m_unit("depot", 1).unwrap()
    }

    fn fleet(number: u32) -> FleetKeys {
        let mut keys = FleetKeys::draw(Fleet(number)).unwrap();
        keys.add(&depot(), &[]).unwrap();
        keys
    }

    fn proven(generation: u32, root: u32) -> Standing {
        Standing::Proven { generation, root }
    }

    fn signed(key: &DiscoveryKey) -> Vec<u8> {
        let mut datagram = b"a datagram".to_vec();
        let code: [u8; CODE_BYTES] = key.code(&[&datagram]);
        datagram.extend(code);
        datagram
    }

    #[test]
    fn a_code_shows_the_fleet_its_generation_or_nothing() {
        let mut root = fleet(7);
        let old = root.ring(&depot()).unwrap();
        root.rotate().unwrap();
        let ring = root.ring(&depot()).unwrap();
        let mut keys = SurveyKeys::default();
        assert_eq!(keys.standing(Fleet(7), &signed(ring.discovery())), Standing::Unchecked);
        keys.add_ring(&ring);
        assert_eq!(keys.standing(Fleet(7), &signed(ring.discovery())), proven(1, 1));
        assert_eq!(keys.standing(Fleet(7), &signed(ring.discovery_in(2).unwrap())), proven(2, 1));
        let other = fleet(7).ring(&depot()).unwrap();
        assert_eq!(keys.standing(Fleet(7), &signed(other.discovery())), Standing::OtherKeys);
        assert_eq!(keys.standing(Fleet(8), &signed(ring.discovery())), Standing::Unchecked);
        assert_eq!(keys.standing(Fleet(7), b"short"), Standing::Unchecked);
        // One that was left behind is known by the root alone.
        root.switch().unwrap();
        root.finish().unwrap();
        let mut ours = SurveyKeys::default();
        ours.add_ring(&root.ring(&depot()).unwrap());
        assert_eq!(ours.standing(Fleet(7), &signed(old.discovery())), Standing::OtherKeys);
        ours.add_root(&root);
        assert_eq!(ours.standing(Fleet(7), &signed(old.discovery())), proven(1, 2));
        assert_eq!(ours.signers(Fleet(7)).count(), 1, "nobody is asked with a key that is over");
    }

    #[test]
    fn keys_are_of_one_root_if_one_source_has_both() {
        let (mut root, other) = (fleet(7), fleet(7).ring(&depot()).unwrap());
        let old = root.ring(&depot()).unwrap();
        root.rotate().unwrap();
        root.switch().unwrap();
        let both = root.ring(&depot()).unwrap();
        root.finish().unwrap();
        let new = root.ring(&depot()).unwrap();
        let mut keys = SurveyKeys::default();
        [&old, &new, &other].iter().for_each(|ring| keys.add_ring(ring));
        let standings =
            |keys: &SurveyKeys| [&old, &new, &other].map(|ring| keys.standing(Fleet(7), &signed(ring.discovery())));
        assert_eq!(standings(&keys), [proven(1, 1), proven(2, 2), proven(1, 3)]);
        keys.add_ring(&both);
        assert_eq!(standings(&keys), [proven(1, 4), proven(2, 4), proven(1, 3)]);
    }

    #[test]
    fn a_file_that_others_can_read_is_told_and_not_taken() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::create(folder.path(), fleet(7)).unwrap();
        store.save().unwrap();
        let path = store.file_of(&depot());
        assert!(SurveyKeys::of_file(&path).unwrap().has(Fleet(7)));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        let mut keys = SurveyKeys::default();
        keys.add_file(&path);
        assert!(matches!(keys.refused(), [KeyError::Open { .. }]) && keys.fleets().is_empty());
        keys.add_file(&folder.path().join("absent"));
        assert_eq!(keys.refused().len(), 1);
    }

    #[test]
    fn the_keys_that_are_kept_are_bounded() {
        let mut keys = SurveyKeys::default();
        (0..KEYS as u32 + 9).for_each(|number| keys.add_ring(&fleet(number).ring(&depot()).unwrap()));
        assert_eq!(keys.keys.len(), KEYS);
    }
}
