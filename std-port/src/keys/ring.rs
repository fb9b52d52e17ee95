//! What one node needs to speak with its fleet.
//!
//! ```text
//! # The keys of agv-17/17 in fleet 7. A holder of this file can speak as it.
//! cara-ring 2
//! fleet 7
//! node s_unit 17 agv-17
//! generation 1
//! discovery 64 hexadecimal digits
//! pair 64 hexadecimal digits m_unit 1 depot
//! generation 2
//! …
//! sum 8 hexadecimal digits
//! ```
//!
//! The generation in use stands first, and behind it the one beside it, if keys are being changed; pairs in the order of
//! their identities.

use std::fmt::Write;
use std::path::Path;

use cara_core::distribution::identity::{Fleet, Identity};
use cara_secure::keyring::Keyring;
use cara_secure::keys::{DiscoveryKey, PairKey};
use zeroize::Zeroizing;

use super::text::{FORM, FormError, Line, Lines, push_identity, push_key, push_sum};
use super::{KeyError, Owner, file, full_name};

/// Bytes that a line with a key takes at most, and those of a generation or the head of a file.
const LINE_BYTES: usize = 160;
/// The keys of one node: of the generation in use, with which it speaks, and while the fleet changes its keys of the one
/// beside it, which it takes as well.
#[derive(Debug)]
pub struct KeyRing {
    fleet: Fleet,
    identity: Identity,
    used: Generation,
    beside: Option<Generation>,
}

/// What a node has of one generation.
#[derive(Debug)]
pub(super) struct Generation {
    pub(super) number: u32,
    pub(super) discovery: DiscoveryKey,
    /// In the order of identities. Made with room for all: a list that grows leaves keys behind.
    pub(super) pairs: Vec<(Identity, PairKey)>,
}

impl Generation {
    fn pair(&self, peer: &Identity) -> Option<&PairKey> {
        let found = self.pairs.binary_search_by(|(identity, _)| identity.cmp(peer)).ok()?;
        self.pairs.get(found).map(|(_, key)| key)
    }
}

impl KeyRing {
    pub(super) fn new(fleet: Fleet, identity: Identity, used: Generation, beside: Option<Generation>) -> Self {
        Self { fleet, identity, used, beside }
    }

    fn all(&self) -> impl Iterator<Item = &Generation> {
        std::iter::once(&self.used).chain(&self.beside)
    }

    /// Reads a ring from a file that only its owner can read.
    pub fn load(path: &Path) -> Result<Self, KeyError> {
        Self::load_marked(path).map(|(ring, _)| ring)
    }

    pub(super) fn load_marked(path: &Path) -> Result<(Self, file::Mark), KeyError> {
        let (text, mark) = file::read(path)?;
        file::advise(path, &text);
        Ok((Self::parse(&text).map_err(|error| file::form(path, error))?, mark))
    }

    /// As [`load`](Self::load); an error if it is another node's.
    pub fn load_of(path: &Path, identity: &Identity, fleet: Fleet) -> Result<Self, KeyError> {
        Self::load(path)?.belonging_to(path, identity, fleet)
    }

    pub(super) fn belonging_to(self, path: &Path, identity: &Identity, fleet: Fleet) -> Result<Self, KeyError> {
        if (&self.identity, self.fleet) == (identity, fleet) {
            return Ok(self);
        }
        let found = Owner { identity: self.identity.clone(), fleet: self.fleet };
        let owners = Box::new((found, Owner { identity: identity.clone(), fleet }));
        Err(KeyError::OtherNode { path: path.to_owned(), owners })
    }

    /// Whose keys they are.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The fleet.
    pub fn fleet(&self) -> Fleet {
        self.fleet
    }

    /// The generation in use.
    pub fn generation(&self) -> u32 {
        self.used.number
    }

    /// All generations, the one in use first.
    pub fn generations(&self) -> impl Iterator<Item = u32> {
        self.all().map(|generation| generation.number)
    }

    /// The key in use with a peer; `None` for a node that this one may not talk to.
    pub fn pair(&self, peer: &Identity) -> Option<&PairKey> {
        self.pairs(peer).next().map(|(_, key)| key)
    }

    /// The key with a peer of one generation.
    pub fn pair_in(&self, generation: u32, peer: &Identity) -> Option<&PairKey> {
        self.pairs(peer).find(|(number, _)| *number == generation).map(|(_, key)| key)
    }

    /// All keys with a peer and their generations: what is said is said with the first, what is heard may be of any.
    pub fn pairs(&self, peer: &Identity) -> impl Iterator<Item = (u32, &PairKey)> {
        self.all().filter_map(|generation| Some((generation.number, generation.pair(peer)?)))
    }

    /// The key in use for discovery.
    pub fn discovery(&self) -> &DiscoveryKey {
        &self.used.discovery
    }

    /// The key for discovery of one generation.
    #[cfg(test)]
    pub(crate) fn discovery_in(&self, generation: u32) -> Option<&DiscoveryKey> {
        self.discoveries().find(|(number, _)| *number == generation).map(|(_, key)| key)
    }

    /// All keys for discovery and their generations, the one in use first.
    pub fn discoveries(&self) -> impl Iterator<Item = (u32, &DiscoveryKey)> {
        self.all().map(|generation| (generation.number, &generation.discovery))
    }

    /// The nodes that it may talk to, in order. An m_unit's key for itself, with which it finds another one of its identity, is no
    /// peer's.
    pub fn peers(&self) -> Vec<&Identity> {
        let pairs = self.all().flat_map(|generation| &generation.pairs);
        let mut peers: Vec<_> = pairs.map(|(identity, _)| identity).filter(|peer| **peer != self.identity).collect();
        peers.sort_unstable();
        peers.dedup();
        peers
    }

    /// How many those are.
    pub(crate) fn nodes(&self) -> u16 {
        u16::try_from(self.peers().len()).unwrap_or(u16::MAX)
    }

    /// The text of its file.
    pub(super) fn text(&self) -> Zeroizing<String> {
        let lines = 5 + self.all().map(|generation| 2 + generation.pairs.len()).sum::<usize>();
        let mut text = Zeroizing::new(String::with_capacity(lines * LINE_BYTES));
        self.push_to(&mut text);
        debug_assert!(text.len() <= lines * LINE_BYTES, "a text that grows leaves keys behind");
        text
    }

    fn push_to(&self, text: &mut String) {
        // Writing to text does not fail.
        let (name, fleet) = (full_name(&self.identity), self.fleet.0);
        let _ = writeln!(text, "# The keys of {name} in fleet {fleet}. A holder of this file can speak as it.");
        let _ = write!(text, "cara-ring {FORM}\nfleet {fleet}\nnode ");
        push_identity(text, &self.identity);
        text.push('\n');
        for Generation { number, discovery, pairs } in self.all() {
            let _ = write!(text, "generation {number}\ndiscovery ");
            push_key(text, discovery.expose());
            text.push('\n');
            for (identity, key) in pairs {
                text.push_str("pair ");
                push_key(text, key.expose());
                text.push(' ');
                push_identity(text, identity);
                text.push('\n');
            }
        }
        push_sum(text);
    }

    pub(super) fn parse(text: &str) -> Result<Self, FormError> {
        let mut lines = Lines::of(text);
        lines.head("cara-ring", "here `cara-ring 2` is expected: this is no file with a node's keys")?;
        let fleet = Fleet(lines.expect("fleet", "here `fleet` is expected")?.number()?);
        let identity = lines.expect("node", "here `node` is expected")?.identity()?;
        let first = lines.expect("generation", "here `generation` is expected")?;
        let (used, next) = read_generation(&mut lines, first)?;
        let Some(second) = next else { return Ok(Self { fleet, identity, used, beside: None }) };
        let (beside, third) = read_generation(&mut lines, second)?;
        if beside.number == used.number || third.is_some() {
            return Err(third.unwrap_or(second).wrong("here are more than two generations, or one twice"));
        }
        Ok(Self { fleet, identity, used, beside: Some(beside) })
    }
}

impl Keyring for KeyRing {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        (&self.used.discovery, self.beside.as_ref().map(|beside| &beside.discovery))
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        let mut keys = self.pairs(peer).map(|(_, key)| key.clone());
        keys.next().map(|key| (key, keys.next()))
    }
}

/// The generation that a line begins; the line of the one behind it, if there is one.
fn read_generation<'t>(lines: &mut Lines<'t>, first: Line<'t>) -> Result<(Generation, Option<Line<'t>>), FormError> {
    let number = first.number()?;
    let (key, _) = lines.expect("discovery", "here `discovery` is expected")?.key()?;
    let discovery = DiscoveryKey::new(*key);
    let mut pairs = Vec::with_capacity(lines.clone().take_while(|line| line.word == "pair").count());
    let next = read_pairs(lines, &mut pairs)?;
    Ok((Generation { number, discovery, pairs }, next))
}

/// The pairs of a generation; the line of the one behind it, if there is one.
fn read_pairs<'t>(lines: &mut Lines<'t>, pairs: &mut Vec<(Identity, PairKey)>) -> Result<Option<Line<'t>>, FormError> {
    for line in lines {
        if line.word == "generation" {
            return Ok(Some(line));
        }
        if line.word != "pair" {
            return Err(line.wrong("here `pair` or `generation` is expected"));
        }
        let (key, behind) = line.key()?;
        let identity = behind.identity()?;
        if pairs.last().is_some_and(|(before, _)| *before >= identity) {
            return Err(line.wrong("pairs stand in the order of ID, name and role, each once"));
        }
        pairs.push((identity, PairKey::new(*key)));
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn generation(number: u32, peers: &[Identity]) -> Generation {
        let mut peers = peers.to_vec();
        peers.sort();
        peers.dedup();
        let key = |index: usize| PairKey::new([number as u8 ^ index as u8; 32]);
        let pairs = peers.into_iter().enumerate().map(|(index, peer)| (peer, key(index))).collect();
        Generation { number, discovery: DiscoveryKey::new([0xD0 | number as u8; 32]), pairs }
    }

    fn agv(id: u32) -> Identity {
        Identity::s_unit("agv", id).unwrap()
    }

    fn ring() -> KeyRing {
        let (used, beside) = (generation(2, &[agv(1), agv(2)]), generation(1, &[agv(1), agv(3)]));
        KeyRing::new(Fleet(7), Identity::m_unit("depot", 1).unwrap(), used, Some(beside))
    }

    #[test]
    fn the_key_in_use_comes_first_and_the_other_is_there() {
        let ring = ring();
        let newest = |id| ring.pairs(&agv(id)).map(|(number, _)| number).collect::<Vec<_>>();
        assert_eq!([newest(1), newest(2), newest(3), newest(4)], [vec![2, 1], vec![2], vec![1], vec![]]);
        assert_eq!(ring.pair(&agv(1)).unwrap().expose(), ring.pair_in(2, &agv(1)).unwrap().expose());
        assert!(ring.pair_in(1, &agv(2)).is_none() && ring.pair(&agv(3)).is_some() && ring.pair(&agv(4)).is_none());
        // Another role is another node.
        assert!(ring.pair(&Identity::m_unit("agv", 1).unwrap()).is_none());
        assert_eq!(ring.discovery().expose(), &[0xD2; 32]);
        assert_eq!(ring.discovery_in(1).unwrap().expose(), &[0xD1; 32]);
        assert!(ring.discovery_in(3).is_none());
        assert_eq!((ring.generation(), ring.peers()), (2, vec![&agv(1), &agv(2), &agv(3)]));
    }

    #[test]
    fn every_line_that_is_wrong_is_told_by_its_number() {
        let text = ring().text();
        let (text, sum) = text.split_at(text.find("sum ").unwrap());
        let lines: Vec<_> = text.lines().collect();
        let with_sum = |lines: Vec<&str>| lines.join("\n") + "\n" + sum;
        let parse = |lines: Vec<&str>| KeyRing::parse(&with_sum(lines)).map(drop).map_err(|error| error.line);
        assert_eq!(parse(lines.clone()), Ok(()));
        for (index, line) in lines.iter().enumerate().skip(1) {
            let with = |new: &str| {
                let mut lines = lines.clone();
                lines[index] = new;
                parse(lines)
            };
            assert_eq!(with("strange 1"), Err(index + 1), "{line}");
            assert_eq!(with(line.split(' ').next().unwrap()), Err(index + 1), "{line}");
        }
        assert_eq!(parse(lines[..4].to_vec()), Err(5));
        assert_eq!(KeyRing::parse("").map_err(|error| error.line).err(), Some(1));
        let unknown = format!("{}{sum}", text.replace("cara-ring 2", "cara-ring 3"));
        assert_eq!(KeyRing::parse(&unknown).map_err(|error| error.line).err(), Some(2));
        assert_eq!(KeyRing::parse(text).map_err(|error| error.line).err(), Some(2), "without its checksum");
        let swapped = |one: usize, other: usize| {
            let mut lines = lines.clone();
            lines.swap(one, other);
            parse(lines)
        };
        assert_eq!(swapped(6, 7), Err(8), "two pairs");
        let (again, third) =
            (text.replace("generation 1", "generation 2"), text.replacen("generation 2", "generation 3", 1));
        assert_eq!(parse(again.lines().collect()), Err(9), "one generation twice");
        assert_eq!(parse(third.lines().chain(lines[4..8].iter().copied()).collect()), Err(13), "three generations");
    }

    #[test]
    fn another_node_s_ring_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ring");
        file::write_private(&path, ring().text().as_bytes()).unwrap();
        let depot = Identity::m_unit("depot", 1).unwrap();
        assert!(KeyRing::load_of(&path, &depot, Fleet(7)).is_ok());
        assert!(matches!(KeyRing::load_of(&path, &agv(1), Fleet(7)), Err(KeyError::OtherNode { .. })));
        let text = KeyRing::load_of(&path, &depot, Fleet(8)).unwrap_err().to_string();
        assert!(text.contains("depot/1@m_unit in fleet 7, and this is depot/1@m_unit in fleet 8"), "{text}");
    }

    /// Whatever is shown of keys, it is none of their bytes, as numbers, as hexadecimal or as text.
    #[test]
    fn no_debug_or_error_shows_a_key() {
        let key = |byte: u8| [byte; 32];
        let pairs = vec![(agv(2), PairKey::new(key(0xB9)))];
        let used = Generation { number: 1, discovery: DiscoveryKey::new(key(0xC7)), pairs };
        let ring = KeyRing::new(Fleet(7), agv(1), used, None);
        let text = ring.text();
        let mut shown = vec![format!("{ring:?} {ring:#?}")];
        for (index, line) in text.lines().enumerate() {
            // A line that is cut anywhere, or with a digit that is none.
            for cut in [line.len() / 2, line.len().saturating_sub(1)] {
                let broken: Vec<_> = text
                    .lines()
                    .enumerate()
                    .map(|(at, whole)| if at == index { &line[..cut] } else { whole })
                    .collect();
                let error = KeyRing::parse(&broken.join("\n"));
                shown.push(format!("{error:?}"));
                shown.extend(error.err().map(|error| file::form(Path::new("ring"), error).to_string()));
            }
            let error = KeyRing::parse(&text.replace(line, &format!("{line}x")))
                .map_err(|error| file::form(Path::new("ring"), error));
            shown.extend(error.err().map(|error| format!("{error:?} {error}")));
        }
        for shown in shown {
            for byte in [0xC7_u8, 0xB9] {
                let run = |one: String, between: &str| [one.clone(), one].join(between);
                for form in
                    [run(byte.to_string(), ", "), run(format!("{byte:02x}"), ""), run(format!("{byte:02x}"), ", ")]
                {
                    assert!(!shown.to_lowercase().contains(&form), "{shown}");
                }
            }
        }
    }

    fn identity() -> impl Strategy<Value = Identity> {
        (any::<bool>(), any::<u32>(), "[ -~äß]{1,16}").prop_map(|(manages, id, name)| match manages {
            true => Identity::m_unit(&name, id).unwrap(),
            false => Identity::s_unit(&name, id).unwrap(),
        })
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(
            fleet: u32, own in identity(), newest in 3_u32.., peers in prop::collection::vec(prop::collection::vec(identity(), 0..6), 1..3),
        ) {
            let mut generations = (0..).zip(&peers).map(|(before, peers)| generation(newest - before, peers));
            let ring = KeyRing::new(Fleet(fleet), own, generations.next().unwrap(), generations.next());
            let text = ring.text();
            let read = KeyRing::parse(&text).unwrap();
            prop_assert_eq!(&*read.text(), &*text);
            prop_assert_eq!((read.fleet, &read.identity, read.peers()), (ring.fleet, &ring.identity, ring.peers()));
        }

        #[test]
        fn no_text_panics(text in "(cara-ring 1\nfleet 7\nnode s_unit 1 a\n)?([a-z]{0,9} ?[0-9a-f ]{0,70}\n?){0,6}") {
            let _ = KeyRing::parse(&text);
        }
    }
}
