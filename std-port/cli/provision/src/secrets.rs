//! A board's keys, from the file of its node.

use std::path::Path;

use cara_core::distribution::identity::Identity;
use cara_settings::keys::{KEYS_BYTES, Keys, KeysError};
use cara_std::keys::{DeviceSecret, KeyRing, Owner, draw, full_name};
use zeroize::Zeroizing;

use cara_tools::exit::Ended;
use cara_tools::keys::failed;

/// Most peers that are looked for when keys are shown, more than a copy has room for.
const PEERS: usize = KEYS_BYTES / 32;

/// Keys as they stand in flash, wiped when they are dropped.
#[derive(Clone)]
pub(super) struct Secrets(Zeroizing<Vec<u8>>);

impl Secrets {
    /// A board's keys, those with its managers if it has any, and with a secret that is drawn now.
    pub(super) fn draw(ring: &KeyRing, managers: &[Identity]) -> anyhow::Result<Self> {
        let secret = DeviceSecret::new(*draw().map_err(failed)?);
        let mut keys = Keys::<PEERS>::new(secret, ring.generation(), ring.discovery().clone());
        fill(&mut keys, ring, managers).map_err(|error| Ended::usage(error.to_string()))?;
        // All of it at once: a list that grows leaves keys behind.
        let mut bytes = Zeroizing::new([0; KEYS_BYTES]);
        let length = keys.encode(&mut bytes).map_err(|error| Ended::usage(error.to_string()))?;
        Ok(Self(Zeroizing::new(bytes.get(..length).unwrap_or_default().to_vec())))
    }

    /// Those that a board holds already.
    pub(super) fn kept(bytes: &[u8]) -> Self {
        Self(Zeroizing::new(bytes.to_vec()))
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.0
    }
}

/// A vehicle gets the keys with its managers alone, whatever else its file has.
fn fill<const N: usize>(keys: &mut Keys<N>, ring: &KeyRing, managers: &[Identity]) -> Result<(), KeysError> {
    let peers = if managers.is_empty() { ring.peers() } else { managers.iter().collect() };
    for (generation, discovery) in ring.discoveries() {
        if generation != ring.generation() {
            keys.push_beside(generation, discovery.clone())?;
        }
        for peer in &peers {
            let key = ring.pair_in(generation, peer).cloned();
            key.map_or(Ok(()), |key| keys.push_pair(generation, peer, key))?;
        }
    }
    Ok(())
}

/// What may be shown of a board's keys.
pub(super) struct Shown {
    pub(super) generations: Vec<u32>,
    pub(super) peers: Vec<String>,
}

impl Shown {
    fn of(keys: &Keys<PEERS>) -> Self {
        let generations = keys.discoveries().map(|(number, _)| number).collect();
        Self { generations, peers: keys.peers().map(full_name).collect() }
    }
}

/// What may be shown of the keys in the text of an emulated board.
pub(super) fn given_by(text: &str) -> Result<Option<Shown>, KeysError> {
    Ok(cara_settings::keys::of_text(text)?.as_ref().map(Shown::of))
}

/// What may be shown of the keys in a page.
pub(super) fn given(page: &[u8]) -> Result<Option<Shown>, KeysError> {
    match cara_settings::keys::newest(page, &[]) {
        Ok((_, keys)) => Ok(Some(Shown::of(&keys))),
        Err(KeysError::Absent) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Whose keys the newest copy of a board has.
pub(super) fn owner(first: &[u8], second: &[u8]) -> Option<Owner> {
    let (settings, _) = cara_settings::keys::newest::<PEERS>(first, second).ok()?;
    Some(Owner { identity: settings.identity, fleet: settings.fleet })
}

/// The file with a board's keys.
pub(super) fn load(file: &Path) -> anyhow::Result<KeyRing> {
    KeyRing::load(file).map_err(failed)
}
