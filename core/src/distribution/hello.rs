//! The hello: the first frame on each link, in both directions.
//!
//! | bytes | meaning |
//! |---|---|
//! | 0–3 | magic of the mode |
//! | 4, 5 | first and last version that the sender speaks |
//! | 6–7 | supported cipher suites, a bit each |
//! | 8–11 | fleet, little-endian |
//! | 12–19 | capabilities, a bit each; in effect if both ends have it |
//! | 20– | [items](super::items) |

use serde::{Deserialize, Serialize};

use super::authenticator::CODE_BYTES;
use super::compact::{Reader, Writer};
use super::identity::{Epoch, Fleet, Identity};
use super::items::{Items, Malformed, kind};
use crate::config::{Constraints, MINIMUM_CHUNK_BYTES, Mode, NODE_NAME_BYTES, VERSIONS, Versions};
use crate::distribution::claim::{Claim, TaggedClaim};

/// Bytes before the items.
const PREFIX_BYTES: usize = 20;
const SUITES: core::ops::Range<usize> = 6..8;

/// The manager that an s_unit belongs to (paper, section 2: "the manually set properties of the m_unit object").
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Manager {
    /// The manager's name.
    pub name: heapless::String<NODE_NAME_BYTES>,
    /// The manager's ID number.
    pub id: u32,
}

/// What a unit accepts, so that the peer sends nothing longer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Longest block of parameters, in bytes.
    pub message_size: u32,
    /// Longest frame body, in bytes.
    pub chunk_size: u16,
    /// Most calls of one peer at a time.
    pub calls: u16,
    /// Least time between two requests to it, in microseconds.
    pub minimum_interval: u32,
}

impl From<&Constraints> for Limits {
    fn from(constraints: &Constraints) -> Self {
        Self {
            message_size: constraints.message_size,
            chunk_size: constraints.chunk_size,
            calls: constraints.calls_per_peer,
            minimum_interval: constraints.minimum_interval.as_wire(),
        }
    }
}

/// A unit's introduction of itself on a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Hello {
    /// The versions that the unit speaks.
    pub versions: Versions,
    /// Abilities that no version implies, a bit each; none are defined yet.
    pub capabilities: u64,
    /// The fleet; units of different fleets refuse each other.
    pub fleet: Fleet,
    /// Name, id and role.
    pub identity: Identity,
    /// The manager that an s_unit belongs to.
    pub wanted: Option<Manager>,
    /// This boot of the unit.
    pub epoch: Epoch,
    /// The claim of an m_unit.
    pub claim: Option<ClaimReport>,
    /// The highest claim of the reader's identity that the sender has obeyed.
    pub obeyed: Option<ClaimReport>,
    /// Fresh for each link; the peer's session datagrams contain it.
    pub nonce: u64,
    /// What the unit accepts.
    pub limits: Limits,
    /// The unit's index of this link, to which its session datagrams are addressed.
    pub link: u16,
    /// The UDP port for its session datagrams; 0 for none.
    pub udp_port: u16,
    /// The unit's clock when the hello was made, in microseconds.
    pub stamp: u64,
    /// Interval of the unit's keep-alives, in milliseconds.
    pub keep_alive: u32,
    /// How many unknown items the reader has skipped. Not encoded.
    pub skipped: u16,
}

/// The cipher suites that an encoded hello offers, a bit each.
pub fn suites(hello: &[u8]) -> u16 {
    hello.get(SUITES).and_then(|bytes| bytes.first_chunk()).map_or(0, |bytes| u16::from_le_bytes(*bytes))
}

/// Adds cipher suites to an encoded hello.
pub fn offer(suites: u16, hello: &mut [u8]) {
    let bytes = hello.get_mut(SUITES).unwrap_or_default();
    bytes.iter_mut().zip(suites.to_le_bytes()).for_each(|(to, more)| *to |= more);
}

/// Why a hello cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HelloError {
    /// Not a hello of CARA.
    Magic,
    /// A hello of the other mode.
    Mode,
    /// None of this unit's versions, but these.
    Version(Versions),
    /// No common cipher suite.
    Suite,
    /// The rest cannot be decoded, or has an unknown item that must not be skipped.
    Malformed,
}

impl From<Malformed> for HelloError {
    fn from(Malformed: Malformed) -> Self {
        Self::Malformed
    }
}

impl Manager {
    pub(super) fn put(wanted: Option<&Self>, writer: &mut Writer<'_>) {
        let Some(Self { name, id }) = wanted else { return };
        let item = writer.begin(kind::WANTED);
        writer.text(name.as_bytes());
        writer.number((*id).into());
        writer.end(item);
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> Self {
        Self { name: reader.name(), id: reader.u32() }
    }
}

/// A claim, as a manager makes it or as a vehicle has obeyed it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClaimReport {
    /// The claim and its tag, which only a manager of its identity can make.
    pub tagged: TaggedClaim,
    /// In milliseconds. For a manager's own claim: since it took over from a live manager, [`NEVER`](Self::NEVER) if it did not.
    /// For an obeyed claim: since its manager was last heard.
    pub since: u32,
}

impl ClaimReport {
    /// The value of [`since`](Self::since) for a manager that did not take over, or was not heard for 49 days.
    pub const NEVER: u32 = u32::MAX;

    /// The claim.
    pub const fn claim(&self) -> Claim {
        self.tagged.claim
    }

    /// Encodes the item, if there is a claim.
    pub(super) fn put(report: Option<&Self>, kind: u16, writer: &mut Writer<'_>) {
        let Some(report) = report else { return };
        let item = writer.begin(kind);
        report.put_fields(writer);
        writer.end(item);
    }

    pub(super) fn put_fields(&self, writer: &mut Writer<'_>) {
        writer.number(self.tagged.claim.term);
        writer.number(self.tagged.claim.claimant);
        writer.bytes(&self.tagged.tag);
        writer.number(self.since.into());
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> Self {
        let claim = Claim { term: reader.u64(), claimant: reader.u64() };
        let tag = reader.bytes(CODE_BYTES).first_chunk().copied().unwrap_or_default();
        Self { tagged: TaggedClaim { claim, tag }, since: reader.u32() }
    }
}

/// The content of an item [`kind::LINK`].
struct Link {
    nonce: u64,
    link: u16,
    udp_port: u16,
    stamp: u64,
    keep_alive: u32,
}

impl Link {
    fn take(reader: &mut Reader<'_>) -> Self {
        Self {
            nonce: reader.u64(),
            link: reader.u16(),
            udp_port: reader.u16(),
            stamp: reader.u64(),
            keep_alive: reader.u32(),
        }
    }
}

impl Limits {
    fn take(reader: &mut Reader<'_>) -> Self {
        Self {
            message_size: reader.u32(),
            chunk_size: reader.u16(),
            calls: reader.u16(),
            minimum_interval: reader.u32(),
        }
    }
}

impl Hello {
    /// Encodes into `out`; returns the length, or `None` if it does not fit.
    pub fn encode(&self, mode: Mode, out: &mut [u8]) -> Option<usize> {
        let mut writer = Writer::new(out);
        writer.bytes(&mode.magic());
        writer.bytes(&[self.versions.first, self.versions.last]);
        writer.bytes(&mode.suites().to_le_bytes());
        writer.bytes(&self.fleet.0.to_le_bytes());
        writer.bytes(&self.capabilities.to_le_bytes());
        self.identity.put(self.epoch, &mut writer);
        Manager::put(self.wanted.as_ref(), &mut writer);
        let item = writer.begin(kind::LINK);
        writer.number(self.nonce);
        writer.numbers(&[self.link.into(), self.udp_port.into()]);
        writer.number(self.stamp);
        writer.number(self.keep_alive.into());
        writer.end(item);
        let Limits { message_size, chunk_size, calls, minimum_interval } = self.limits;
        let item = writer.begin(kind::LIMITS);
        writer.numbers(&[message_size, chunk_size.into(), calls.into(), minimum_interval]);
        writer.end(item);
        ClaimReport::put(self.claim.as_ref(), kind::CLAIM, &mut writer);
        ClaimReport::put(self.obeyed.as_ref(), kind::OBEYED, &mut writer);
        writer.finish()
    }

    /// Decodes a hello of this mode. Items that this version does not know are skipped and counted.
    pub fn decode(bytes: &[u8], mode: Mode) -> Result<Self, HelloError> {
        let (prefix, items) = bytes.split_first_chunk::<PREFIX_BYTES>().ok_or(HelloError::Malformed)?;
        let [m0, m1, m2, m3, first, last, s0, s1, f0, f1, f2, f3, capabilities @ ..] = *prefix;
        match Mode::of_magic([m0, m1, m2, m3]) {
            None => return Err(HelloError::Magic),
            Some(other) if other != mode => return Err(HelloError::Mode),
            Some(_) => {}
        }
        let versions = Versions::from_wire(first, last);
        if VERSIONS.common(versions).is_none() {
            return Err(HelloError::Version(versions));
        }
        if mode.suites() != 0 && mode.suites() & u16::from_le_bytes([s0, s1]) == 0 {
            return Err(HelloError::Suite);
        }
        let (mut unit, mut wanted, mut link, mut limits) = (None, None, None, None);
        let (mut claim, mut obeyed, mut skipped) = (None, None, 0);
        for item in Items::new(items) {
            let item = item?;
            match item.kind {
                kind::UNIT => unit = Some(item.read(Identity::take)?),
                kind::WANTED => wanted = Some(item.read(Manager::take)?),
                kind::LINK => link = Some(item.read(Link::take)?),
                kind::LIMITS => limits = Some(item.read(Limits::take)?),
                kind::CLAIM => claim = Some(item.read(ClaimReport::take)?),
                kind::OBEYED => obeyed = Some(item.read(ClaimReport::take)?),
                _ => item.skip(&mut skipped)?,
            }
        }
        let (Some((identity, epoch)), Some(link), Some(limits)) = (unit, link, limits) else {
            return Err(HelloError::Malformed);
        };
        if !identity.is_sound() || usize::from(limits.chunk_size) < MINIMUM_CHUNK_BYTES {
            return Err(HelloError::Malformed);
        }
        let Link { nonce, link, udp_port, stamp, keep_alive } = link;
        Ok(Self {
            versions,
            capabilities: u64::from_le_bytes(capabilities),
            fleet: Fleet(u32::from_le_bytes([f0, f1, f2, f3])),
            identity,
            wanted,
            epoch,
            claim,
            obeyed,
            nonce,
            limits,
            link,
            udp_port,
            stamp,
            keep_alive,
            skipped,
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]
    use super::super::items::list;
    use super::*;
    use proptest::prelude::*;

    const ROOM: usize = 300;
    const PLAIN: Mode = Mode::Plain;

    /// Bytes of the longest item with a claim.
    const CLAIM: usize = 48;

    fn highest() -> ClaimReport {
        let claim = Claim { term: u64::MAX, claimant: u64::MAX };
        ClaimReport { tagged: TaggedClaim { claim, tag: [0xFF; CODE_BYTES] }, since: u32::MAX }
    }

    fn longest() -> Hello {
        let name = "a-manager-with-a-name-of-32-byte";
        Hello {
            versions: VERSIONS,
            capabilities: u64::MAX,
            fleet: Fleet(u32::MAX),
            identity: Identity::s_unit(name, u32::MAX).unwrap(),
            wanted: Some(Manager { name: name.try_into().unwrap(), id: u32::MAX }),
            epoch: Epoch(u64::MAX),
            claim: Some(highest()),
            obeyed: Some(highest()),
            nonce: u64::MAX,
            limits: Limits {
                message_size: u32::MAX,
                chunk_size: u16::MAX,
                calls: u16::MAX,
                minimum_interval: u32::MAX,
            },
            link: u16::MAX,
            udp_port: u16::MAX,
            stamp: u64::MAX,
            keep_alive: u32::MAX,
            skipped: 0,
        }
    }

    /// The hello with these items in front of its own.
    fn with_items(hello: &Hello, mode: Mode, items: &[(u16, &[u8])]) -> std::vec::Vec<u8> {
        let mut out = [0; ROOM];
        let length = hello.encode(mode, &mut out).unwrap();
        let more = list(items, |writer, body| writer.bytes(body));
        [&out[..PREFIX_BYTES], &more, &out[PREFIX_BYTES..length]].concat()
    }

    #[test]
    fn the_longest_hello_fits_300_bytes_and_survives() {
        let mut out = [0; ROOM];
        let length = longest().encode(PLAIN, &mut out).unwrap();
        assert_eq!(Hello::decode(&out[..length], PLAIN), Ok(longest()));
        assert_eq!(longest().encode(PLAIN, &mut out[..length - 1]), None);
    }

    #[test]
    fn a_hello_of_a_later_version_is_read() {
        let later = Hello { versions: Versions { first: VERSIONS.last, last: 9 }, ..longest() };
        let bytes = with_items(&later, PLAIN, &[(0x7000, b"unknown"), (0, &[0; 4]), (0x7001, &[])]);
        assert_eq!(Hello::decode(&bytes, PLAIN), Ok(Hello { skipped: 2, ..later.clone() }));
        let bytes = with_items(&later, PLAIN, &[(0xF000, b"must be understood")]);
        assert_eq!(Hello::decode(&bytes, PLAIN), Err(HelloError::Malformed));
    }

    #[test]
    fn each_fault_of_a_hello_is_named() {
        let mut out = [0; ROOM];
        let length = longest().encode(PLAIN, &mut out).unwrap();
        let with = |place: usize, byte| {
            let mut bytes = out;
            bytes[place] = byte;
            Hello::decode(&bytes[..length], PLAIN)
        };
        assert_eq!(with(0, b'X'), Err(HelloError::Magic));
        assert_eq!(with(3, b's'), Err(HelloError::Mode));
        assert_eq!(with(4, 3), Err(HelloError::Version(Versions { first: 3, last: 3 })));
        assert_eq!(with(4, 1), Err(HelloError::Version(Versions { first: 1, last: 1 })), "it has its fleet in byte 5");
        // The two claims, which are last, may be missing.
        for cut in (0..length).filter(|cut| ![length - CLAIM, length - 2 * CLAIM].contains(cut)) {
            assert_eq!(Hello::decode(&out[..cut], PLAIN), Err(HelloError::Malformed), "{cut}");
        }
        let small = Limits { chunk_size: (MINIMUM_CHUNK_BYTES - 1) as u16, ..longest().limits };
        let length = Hello { limits: small, ..longest() }.encode(PLAIN, &mut out).unwrap();
        assert_eq!(Hello::decode(&out[..length], PLAIN), Err(HelloError::Malformed), "an emergency would not fit");
        let length = longest().encode(Mode::Secured, &mut out).unwrap();
        out[6] = 0b10;
        assert_eq!(Hello::decode(&out[..length], Mode::Secured), Err(HelloError::Suite), "the first is everybody's");
        offer(0x8001, &mut out[..length]);
        assert_eq!(Hello::decode(&out[..length], Mode::Secured), Ok(longest()));
        assert_eq!((suites(&out[..length]), suites(&out[..7])), (0x8003, 0));
    }

    proptest! {
        #[test]
        fn what_is_read_from_changed_bytes_can_be_written_again(
            changes in prop::collection::vec((PREFIX_BYTES..190, any::<u8>()), 0..6),
            cut in 0..ROOM,
        ) {
            let mut out = [0; ROOM];
            let length = longest().encode(PLAIN, &mut out).unwrap();
            for (place, byte) in changes {
                out[place] = byte;
            }
            let _ = Hello::decode(&out[..cut], PLAIN);
            if let Ok(hello) = Hello::decode(&out[..length], PLAIN) {
                let mut again = [0; ROOM];
                let length = hello.encode(PLAIN, &mut again).unwrap();
                prop_assert_eq!(Hello::decode(&again[..length], PLAIN), Ok(Hello { skipped: 0, ..hello }));
            }
        }
    }
}
