//! The keys of a board, and their layout in flash: behind the settings, in the same copy, so that one checksum and one
//! generation cover both.
//!
//! | size | field |
//! |---|---|
//! | 32 | the secret for random numbers |
//! | 1 | g, how many generations of keys, 1 or 2 |
//! | 36 g | each generation, the one in use first: its number, little-endian, and the key for discovery |
//! | 1 | p, how many peers |
//! | … | each peer: role (0 m_unit, 1 s_unit), length of its name, name, id, little-endian; then for each generation 0, or 1 and 32 bytes of the pair's key |
//!
//! Keys are wiped when they are dropped and are never shown, neither by `Debug` nor in the text of the settings. Flash
//! holds them in clear: reading out one board's flash reveals that board's keys and no others.

use core::fmt;

use cara_core::distribution::identity::{Identity, Role};
use cara_secure::keyring::Keyring;
use cara_secure::keys::{DeviceSecret, DiscoveryKey, PairKey};
use heapless::Vec;
use zeroize::Zeroizing;

pub use crate::page::KEYS_BYTES;
use crate::page::{PageError, newest_found};
use crate::{Field, Settings, TextError, text};

/// Most generations of keys that a board holds: the one in use, and while a fleet changes its keys the one beside it.
pub const GENERATIONS: usize = 2;

/// The keys of a board with at most `PEERS` peers: one for a vehicle, which has one manager, and one more for each that it can be
/// handed over to.
#[derive(Debug)]
pub struct Keys<const PEERS: usize = 1> {
    secret: DeviceSecret,
    used: (u32, DiscoveryKey),
    beside: Option<(u32, DiscoveryKey)>,
    peers: Vec<Peer, PEERS>,
}

struct Peer {
    identity: Identity,
    /// In the order of generations.
    pairs: [Option<PairKey>; GENERATIONS],
}

impl fmt::Debug for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {} keys", self.identity, self.pairs.iter().flatten().count())
    }
}

/// Why a board has no keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeysError {
    /// The pages do not hold valid settings either.
    #[error("{0}")]
    Page(#[from] PageError),
    /// The page holds settings without keys.
    #[error("the page holds no keys: write them with `cara provision BOARD --keys FILE`")]
    Absent,
    /// The keys are not in the form that `cara provision` writes.
    #[error("the keys are not as `cara provision` writes them: write them again")]
    Unsound,
    /// More keys than fit into this board's table or into a copy.
    #[error(
        "a board holds {GENERATIONS} generations of keys, a vehicle with one peer unless its image can be handed over, any other with as many as fit"
    )]
    Full,
    /// The text of the settings cannot be parsed.
    #[error("{0}")]
    Text(#[from] TextError),
}

impl<const PEERS: usize> Keys<PEERS> {
    /// The generation in use, without peers yet. `secret` is drawn for this board and for nothing else.
    pub const fn new(secret: DeviceSecret, generation: u32, discovery: DiscoveryKey) -> Self {
        Self { secret, used: (generation, discovery), beside: None, peers: Vec::new() }
    }

    /// Adds the generation that is taken beside the one in use.
    pub fn push_beside(&mut self, generation: u32, discovery: DiscoveryKey) -> Result<(), KeysError> {
        if generation == self.used.0 || self.beside.is_some() {
            return Err(KeysError::Unsound);
        }
        self.beside = Some((generation, discovery));
        Ok(())
    }

    /// Adds the key with a peer of one of the generations that are there.
    pub fn push_pair(&mut self, generation: u32, peer: &Identity, key: PairKey) -> Result<(), KeysError> {
        let at = self.position(generation).ok_or(KeysError::Unsound)?;
        if !self.peers.iter().any(|known| known.identity == *peer) {
            let peer = Peer { identity: peer.clone(), pairs: [const { None }; GENERATIONS] };
            self.peers.push(peer).map_err(|_| KeysError::Full)?;
        }
        let known = self.peers.iter_mut().find(|known| known.identity == *peer);
        *known.and_then(|known| known.pairs.get_mut(at)).ok_or(KeysError::Unsound)? = Some(key);
        Ok(())
    }

    fn position(&self, generation: u32) -> Option<usize> {
        self.discoveries().position(|(number, _)| number == generation)
    }

    /// The secret from which the board draws its random numbers.
    pub const fn secret(&self) -> &DeviceSecret {
        &self.secret
    }

    /// All keys for discovery and their generations, the one in use first.
    pub fn discoveries(&self) -> impl Iterator<Item = (u32, &DiscoveryKey)> {
        core::iter::once(&self.used).chain(&self.beside).map(|(number, key)| (*number, key))
    }

    /// The key in use with a peer; `None` for a node that this one may not talk to.
    pub fn pair(&self, peer: &Identity) -> Option<&PairKey> {
        self.pairs(peer).next().map(|(_, key)| key)
    }

    /// All keys with a peer and their generations, the one in use first.
    pub fn pairs(&self, peer: &Identity) -> impl Iterator<Item = (u32, &PairKey)> {
        let known = self.peers.iter().find(|known| known.identity == *peer);
        let keys = known.into_iter().flat_map(|known| &known.pairs);
        self.discoveries().zip(keys).filter_map(|((number, _), key)| Some((number, key.as_ref()?)))
    }

    /// The peers that it has keys for.
    pub fn peers(&self) -> impl Iterator<Item = &Identity> {
        self.peers.iter().map(|peer| &peer.identity)
    }

    /// Encodes them as they are laid out in flash; the number of bytes. The caller wipes the buffer.
    pub fn encode(&self, bytes: &mut [u8; KEYS_BYTES]) -> Result<usize, KeysError> {
        let mut left = bytes.as_mut_slice();
        put(&mut left, self.secret.expose())?;
        let generations = self.discoveries().count();
        put(&mut left, &[generations as u8])?;
        for (number, key) in self.discoveries() {
            put(&mut left, &number.to_le_bytes())?;
            put(&mut left, key.expose())?;
        }
        put(&mut left, &[u8::try_from(self.peers.len()).map_err(|_| KeysError::Full)?])?;
        self.peers.iter().try_for_each(|peer| peer.encode(&mut left, generations))?;
        let left = left.len();
        Ok(KEYS_BYTES.saturating_sub(left))
    }

    /// Reads what [`encode`](Self::encode) has written, and nothing behind it.
    pub fn decode(mut bytes: &[u8]) -> Result<Self, KeysError> {
        let left = &mut bytes;
        let secret = DeviceSecret::new(*take(left)?);
        let [generations] = *take(left)?;
        if !(1..=GENERATIONS as u8).contains(&generations) {
            return Err(KeysError::Unsound);
        }
        let used = u32::from_le_bytes(*take(left)?);
        let mut keys = Self::new(secret, used, DiscoveryKey::new(*take(left)?));
        if usize::from(generations) == GENERATIONS {
            let beside = u32::from_le_bytes(*take(left)?);
            keys.push_beside(beside, DiscoveryKey::new(*take(left)?))?;
        }
        let [peers] = *take(left)?;
        for _ in 0..peers {
            let peer = Peer::decode(left, generations.into())?;
            if keys.peers().any(|known| *known == peer.identity) {
                return Err(KeysError::Unsound);
            }
            keys.peers.push(peer).map_err(|_| KeysError::Full)?;
        }
        if left.is_empty() { Ok(keys) } else { Err(KeysError::Unsound) }
    }
}

impl Peer {
    fn encode(&self, left: &mut &mut [u8], generations: usize) -> Result<(), KeysError> {
        let (name, role) = (self.identity.name().as_bytes(), self.identity.role());
        put(left, &[u8::from(role == Role::SUnit), name.len() as u8])?;
        put(left, name)?;
        put(left, &self.identity.id().to_le_bytes())?;
        for key in self.pairs.iter().take(generations) {
            put(left, &[u8::from(key.is_some())])?;
            key.iter().try_for_each(|key| put(left, key.expose()))?;
        }
        Ok(())
    }

    fn decode(left: &mut &[u8], generations: usize) -> Result<Self, KeysError> {
        let [role, length] = *take(left)?;
        let role = match role {
            0 => Role::MUnit,
            1 => Role::SUnit,
            _ => return Err(KeysError::Unsound),
        };
        let (name, rest) = left.split_at_checked(usize::from(length)).ok_or(KeysError::Unsound)?;
        *left = rest;
        let name = core::str::from_utf8(name).map_err(|_| KeysError::Unsound)?;
        let id = u32::from_le_bytes(*take(left)?);
        let identity = Identity::new(name, id, role).map_err(|_| KeysError::Unsound)?;
        let mut pairs = [const { None }; GENERATIONS];
        for pair in pairs.iter_mut().take(generations) {
            *pair = match *take(left)? {
                [0] => None,
                [1] => Some(PairKey::new(*take(left)?)),
                _ => return Err(KeysError::Unsound),
            };
        }
        Ok(Self { identity, pairs })
    }
}

impl<const PEERS: usize> Keyring for Keys<PEERS> {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        (&self.used.1, self.beside.as_ref().map(|(_, key)| key))
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        let mut keys = self.pairs(peer).map(|(_, key)| key.clone());
        keys.next().map(|key| (key, keys.next()))
    }

    fn peer(&self, index: usize) -> Option<&Identity> {
        self.peers.get(index).map(|peer| &peer.identity)
    }
}

fn put(left: &mut &mut [u8], bytes: &[u8]) -> Result<(), KeysError> {
    let (to, rest) = core::mem::take(left).split_at_mut_checked(bytes.len()).ok_or(KeysError::Full)?;
    to.copy_from_slice(bytes);
    *left = rest;
    Ok(())
}

/// The next bytes, where they stand: a copy of a key is made only in the place where it stays.
fn take<'b, const BYTES: usize>(left: &mut &'b [u8]) -> Result<&'b [u8; BYTES], KeysError> {
    let (bytes, rest) = left.split_first_chunk().ok_or(KeysError::Unsound)?;
    *left = rest;
    Ok(bytes)
}

/// The settings and the keys of the newest sound copy.
pub fn newest<const PEERS: usize>(first: &[u8], second: &[u8]) -> Result<(Settings, Keys<PEERS>), KeysError> {
    let found = newest_found(first, second)?;
    match found.keys.0 {
        [] => Err(KeysError::Absent),
        bytes => Ok((found.settings, Keys::decode(bytes)?)),
    }
}

/// The keys of the newest sound copy as they stand there, for the copy that comes after it; none if they are those of
/// another unit than `settings` tell, or if that is to be in plain mode.
pub fn kept<'p>(settings: &Settings, first: &'p [u8], second: &'p [u8]) -> Option<&'p [u8]> {
    let found = newest_found(first, second).ok()?;
    let same = found.settings.identity == settings.identity && found.settings.fleet == settings.fleet;
    (same && !settings.insecure && !found.keys.0.is_empty()).then_some(found.keys.0)
}

/// The keys in a text of settings, `keys=` and digits; none where it has no such word.
pub fn of_text<const PEERS: usize>(text: &str) -> Result<Option<Keys<PEERS>>, KeysError> {
    let Some(digits) = text::value_of(text, Field::Keys)? else { return Ok(None) };
    let wrong = KeysError::Text(TextError::Value(Field::Keys));
    let mut bytes = Zeroizing::new([0; KEYS_BYTES]);
    let used = bytes.get_mut(..digits.len() / 2).ok_or(KeysError::Full)?;
    hex::decode_to_slice(digits, used).map_err(|_| wrong)?;
    Keys::decode(used).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::{BYTES, encode_with};
    use cara_secure::keys::KEY_BYTES;
    use proptest::prelude::*;
    use std::format;
    use std::string::{String, ToString};

    fn named(name: &str, id: u32) -> Identity {
        Identity::m_unit(name, id).unwrap()
    }

    /// Keys in two generations with one peer.
    fn keys() -> Keys {
        let mut keys = Keys::new(DeviceSecret::new([0xA1; KEY_BYTES]), 2, DiscoveryKey::new([0xB2; KEY_BYTES]));
        keys.push_beside(1, DiscoveryKey::new([0xB1; KEY_BYTES])).unwrap();
        keys.push_pair(2, &named("depot", 1), PairKey::new([0xC2; KEY_BYTES])).unwrap();
        keys.push_pair(1, &named("depot", 1), PairKey::new([0xC1; KEY_BYTES])).unwrap();
        keys
    }

    fn bytes<const PEERS: usize>(keys: &Keys<PEERS>) -> std::vec::Vec<u8> {
        let mut bytes = [0; KEYS_BYTES];
        let length = keys.encode(&mut bytes).unwrap();
        bytes[..length].to_vec()
    }

    fn settings(id: u32) -> Settings {
        format!("name=agv id={id} manager=depot/1 fleet=7").parse().unwrap()
    }

    fn page(id: u32, keys: &[u8], generation: u32) -> [u8; BYTES] {
        let mut page = [0xFF; BYTES];
        encode_with(&settings(id), keys, generation, &mut page).unwrap();
        page
    }

    #[test]
    fn what_is_written_is_read() {
        let written = bytes(&keys());
        let read = Keys::<1>::decode(&written).unwrap();
        assert_eq!(bytes(&read), written);
        assert_eq!(read.secret().expose(), &[0xA1; KEY_BYTES]);
        assert_eq!(read.pair(&named("depot", 1)).unwrap().expose(), &[0xC2; KEY_BYTES]);
        let depot = named("depot", 1);
        let pairs = read.pairs(&depot).map(|(number, key)| (number, key.expose()[0]));
        assert_eq!(pairs.collect::<std::vec::Vec<_>>(), [(2, 0xC2), (1, 0xC1)]);
        let discoveries = read.discoveries().map(|(number, key)| (number, key.expose()[0]));
        assert_eq!(discoveries.collect::<std::vec::Vec<_>>(), [(2, 0xB2), (1, 0xB1)]);
        assert!(read.pair(&named("depot", 2)).is_none() && read.pair(&Identity::s_unit("depot", 1).unwrap()).is_none());
    }

    #[test]
    fn a_peer_may_lack_the_older_generation() {
        let mut keys = Keys::<2>::new(DeviceSecret::new([1; KEY_BYTES]), 9, DiscoveryKey::new([2; KEY_BYTES]));
        keys.push_beside(8, DiscoveryKey::new([3; KEY_BYTES])).unwrap();
        keys.push_pair(9, &named("new", 1), PairKey::new([4; KEY_BYTES])).unwrap();
        keys.push_pair(8, &named("old", 1), PairKey::new([5; KEY_BYTES])).unwrap();
        let read = Keys::<2>::decode(&bytes(&keys)).unwrap();
        let generations = |name| read.pairs(&named(name, 1)).map(|(number, _)| number).collect::<std::vec::Vec<_>>();
        assert_eq!([generations("new"), generations("old")], [[9], [8]]);
        assert_eq!(Keys::<1>::decode(&bytes(&keys)).map(drop), Err(KeysError::Full));
    }

    #[test]
    fn what_does_not_fit_is_told() {
        let mut keys = keys();
        let key = || PairKey::new([0; KEY_BYTES]);
        assert_eq!(keys.push_beside(3, DiscoveryKey::new([0; KEY_BYTES])), Err(KeysError::Unsound));
        assert_eq!(keys.push_pair(3, &named("depot", 1), key()), Err(KeysError::Unsound));
        assert_eq!(keys.push_pair(2, &named("other", 1), key()), Err(KeysError::Full));
        let mut many = Keys::<99>::new(DeviceSecret::new([0; KEY_BYTES]), 1, DiscoveryKey::new([0; KEY_BYTES]));
        assert_eq!(many.push_beside(1, DiscoveryKey::new([0; KEY_BYTES])), Err(KeysError::Unsound));
        (0..99).for_each(|id| many.push_pair(1, &named("manager", id), key()).unwrap());
        assert_eq!(many.encode(&mut [0; KEYS_BYTES]), Err(KeysError::Full));
    }

    /// With the longest names a copy holds this many peers.
    #[test]
    fn eight_peers_fit() {
        let mut keys = Keys::<8>::new(DeviceSecret::new([0; KEY_BYTES]), 2, DiscoveryKey::new([0; KEY_BYTES]));
        keys.push_beside(1, DiscoveryKey::new([0; KEY_BYTES])).unwrap();
        for (number, id) in [2, 1].into_iter().flat_map(|number| (0..8).map(move |id| (number, id))) {
            keys.push_pair(number, &named(&"n".repeat(32), id), PairKey::new([0; KEY_BYTES])).unwrap();
        }
        assert!(keys.encode(&mut [0; KEYS_BYTES]).unwrap() > 900);
    }

    /// Power may be cut, or a bit flip, anywhere in one copy: settings and keys of the other one count, never a mixture.
    #[test]
    fn every_flipped_bit_and_every_cut_leaves_the_other_copy() {
        let other = Keys::<1>::new(DeviceSecret::new([0xD1; KEY_BYTES]), 3, DiscoveryKey::new([0xD2; KEY_BYTES]));
        let (old, new) = (bytes(&keys()), bytes(&other));
        let (first, second) = (page(1, &old, 1), page(2, &new, 2));
        let used = encode_with(&settings(2), &new, 2, &mut [0; BYTES]).unwrap();
        let secret = |first: &[u8], second: &[u8]| {
            let (settings, keys) = newest::<1>(first, second).unwrap();
            (settings.identity.id(), keys.secret().expose()[0])
        };
        assert_eq!(secret(&first, &second), (2, 0xD1));
        for bit in 0..used * 8 {
            let mut damaged = second;
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(secret(&first, &damaged), (1, 0xA1), "bit {bit}");
            assert_eq!(secret(&damaged, &first), (1, 0xA1), "bit {bit}");
        }
        for written in 0..used {
            let mut cut = [0xFF; BYTES];
            cut[..written].copy_from_slice(&second[..written]);
            assert_eq!(secret(&first, &cut), (1, 0xA1), "{written} bytes");
            assert_eq!(crate::page::replaced(&first, &cut), (crate::page::Copy::Second, 2));
        }
    }

    #[test]
    fn keys_are_kept_for_the_same_unit_only() {
        let (old, new) = ([1; 50], [2; 50]);
        let (first, second) = (page(1, &old, 1), page(1, &new, 2));
        assert_eq!(kept(&settings(1), &first, &second), Some(&new[..]));
        assert_eq!(kept(&settings(1), &first, &[]), Some(&old[..]));
        assert_eq!(kept(&settings(2), &first, &second), None);
        let mut other = settings(1);
        other.fleet.0 += 1;
        assert_eq!(kept(&other, &first, &second), None);
        let mut plain = settings(1);
        plain.insecure = true;
        assert_eq!(kept(&plain, &first, &second), None);
        assert_eq!(kept(&settings(1), &page(1, &[], 1), &[]), None);
        assert_eq!(kept(&settings(1), &[], &[]), None);
    }

    #[test]
    fn settings_without_keys_are_told() {
        let plain = page(1, &[], 1);
        assert_eq!(newest::<1>(&plain, &[]).map(drop), Err(KeysError::Absent));
        assert_eq!(newest::<1>(&[], &[]).map(drop), Err(KeysError::Page(PageError::Absent)));
        assert_eq!(newest::<1>(&page(1, &[1, 2, 3], 1), &[]).map(drop), Err(KeysError::Unsound));
    }

    #[test]
    fn the_text_of_settings_takes_keys_and_never_shows_them() {
        let written = bytes(&keys());
        let digits: String = written.iter().map(|byte| format!("{byte:02x}")).collect();
        let text = format!("name=agv id=1 manager=depot/1 fleet=7 keys={digits}");
        let read = of_text::<1>(&text).unwrap().unwrap();
        assert_eq!(bytes(&read), written);
        let settings: Settings = text.parse().unwrap();
        assert_eq!(settings, self::settings(1));
        assert!(!settings.to_string().contains("keys"), "{settings}");
        assert!(of_text::<1>("name=agv id=1").unwrap().is_none());
        for wrong in ["", "0", "0g", "00"] {
            assert!(of_text::<1>(&format!("keys={wrong}")).is_err(), "{wrong}");
        }
        assert_eq!(of_text::<1>(&format!("keys={}", "0".repeat(5_000))).map(drop), Err(KeysError::Full));
        let twice = KeysError::Text(TextError::Twice(Field::Keys));
        assert_eq!(of_text::<1>("keys=00 keys=00").map(drop), Err(twice));
    }

    #[test]
    fn nothing_of_a_key_is_shown() {
        let shown = format!("{:?} {:#?}", keys(), keys());
        for byte in [0xA1_u8, 0xB2, 0xB1, 0xC2, 0xC1] {
            let forms = [format!("{byte}, {byte}"), format!("{byte:02x}{byte:02x}"), format!("{byte:02X}{byte:02X}")];
            assert!(forms.iter().all(|form| !shown.contains(form)), "{shown}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = Keys::<1>::decode(&bytes);
            let _ = Keys::<9>::decode(&bytes);
        }

        /// A byte that is changed makes other keys or none, and never a panic; what is cut or longer is refused.
        #[test]
        fn no_changed_byte_panics(at in any::<prop::sample::Index>(), byte: u8) {
            let mut changed = bytes(&keys());
            let length = changed.len();
            prop_assert!(Keys::<1>::decode(&changed[..at.index(length)]).is_err());
            changed[at.index(length)] = byte;
            let _ = Keys::<1>::decode(&changed);
            changed.push(byte);
            prop_assert!(Keys::<1>::decode(&changed).is_err());
        }

        #[test]
        fn no_text_panics(text in "(keys=)?[0-9a-f =]{0,80}") {
            let _ = of_text::<1>(&text);
        }
    }
}
