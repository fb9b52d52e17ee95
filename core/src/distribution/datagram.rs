//! UDP datagrams (docs/wire.md): a fixed header, then a search, an answer, or the body of a session.
//!
//! | bytes | meaning |
//! |---|---|
//! | 0–3 | magic of the mode |
//! | 4 | first version that can read it |
//! | 5 | kind: 1 [`WhoHas`], 2 [`Announce`], 3 session |
//! | 6 | last version that the sender speaks |
//! | 7 | number of authentication codes at the end |
//! | 8–11 | fleet, little-endian |
//! | 12– | [`WhoHas`], [`Announce`]: [items]; session: link u16, zero u16, nonce u64, body |
//!
//! In secured mode a search and an answer end with a code made with the fleet's key over everything before it. An answer to a
//! single unit also has a code made with the pair's key, before the fleet's. A [`WhoHas`] and a broadcast [`Announce`] are padded
//! to the length of the longest answer: what they cause is no longer than they are, so a forged source address yields no
//! amplification.

use super::authenticator::{Authenticator, CODE_BYTES};
use super::compact::{Reader, Writer};
use super::hello::{ClaimReport, Manager};
use super::identity::{Epoch, Fleet, Identity, Role};
use super::items::{self, Items, Malformed, kind};
use crate::config::{Mode, VERSIONS, Versions};
use crate::host::mailman::LinkId;

const WHO_HAS: u8 = 1;
const ANNOUNCE: u8 = 2;
const SESSION: u8 = 3;

/// Bytes before the body of a [`WhoHas`] or [`Announce`].
pub const HEADER_BYTES: usize = 12;
/// Bytes before the body of a session datagram.
pub const SESSION_HEADER_BYTES: usize = 24;
/// Most known nodes that one [`WhoHas`] can name.
pub const KNOWN_NODES: usize = 64;
/// Length of the longest [`WhoHas`].
pub const SEARCH_BYTES: usize = 512;
/// Length of the longest [`Announce`] in secured mode, and of the shortest [`WhoHas`].
pub const ANSWER_BYTES: usize = 176;

/// A search, broadcast (paper: "one node broadcasts a message containing its identifier").
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WhoHas {
    /// The sender.
    pub identity: Identity,
    /// The sender's boot epoch.
    pub epoch: Epoch,
    /// Increases with each search of this boot.
    pub sequence: u32,
    /// Returned in the answer.
    pub nonce: u64,
    /// The manager that is wanted; `None` asks all other m_units, and the sender's own s_units.
    pub wanted: Option<Manager>,
    /// The sender's TCP port; 0 if it accepts no links.
    pub tcp_port: u16,
    /// How many answers the sender expects; 0 in a question to a single node, which answers at once.
    pub expected: u16,
    /// The [`short_hash`] of each connected node, which does not answer.
    pub known: heapless::Vec<u32, KNOWN_NODES>,
    /// The sender is a standby, to be answered but not taken for a manager. Readers that do not know this flag answer, too: a
    /// standby must find a manager of an earlier version.
    pub standby: bool,
    /// How many unknown items the reader has skipped. Not encoded.
    pub skipped: u16,
}

/// An answer, to the node that asked, or broadcast when several ask.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Announce {
    /// The sender.
    pub identity: Identity,
    /// Its boot epoch.
    pub epoch: Epoch,
    /// The claim of an m_unit.
    pub claim: Option<ClaimReport>,
    /// The highest claim of the reader's identity that a vehicle has obeyed.
    pub obeyed: Option<ClaimReport>,
    /// Increases with each announce of this boot.
    pub sequence: u32,
    /// The nonce of the search that is answered; 0 in a broadcast.
    pub nonce: u64,
    /// The TCP port at which it can be dialled; 0 for none.
    pub tcp_port: u16,
    /// How many more nodes it can admit.
    pub room: u16,
    /// How many nodes it expects to dial after this announce, for their random delays.
    pub expected: u16,
    /// How many unknown items the reader has skipped. Not encoded.
    pub skipped: u16,
}

/// A datagram, borrowed from the received bytes.
// Searches are rare and processed where they are decoded, so this enum is not moved.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, PartialEq, Eq)]
pub enum Datagram<'b> {
    /// A search.
    WhoHas(WhoHas),
    /// An answer.
    Announce(Announce),
    /// Part of a session.
    Session {
        /// The receiver's index of the link.
        link: u16,
        /// The receiver's nonce of the session.
        nonce: u64,
        /// See [`SessionBody`](super::message::SessionBody).
        body: &'b [u8],
    },
}

/// Why a datagram is not for this unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DatagramError {
    /// It is of another mode, or no datagram of CARA.
    Magic,
    /// It is of no version that this unit speaks, but of these.
    Version(Versions),
    /// It is of this other fleet.
    Fleet(Fleet),
    /// The code made with the fleet's key is wrong or missing.
    Forged,
    /// An answer to a single unit, whose pair code is wrong for this unit.
    NotForUs,
    /// The rest cannot be decoded.
    Malformed,
}

impl From<Malformed> for DatagramError {
    fn from(Malformed: Malformed) -> Self {
        Self::Malformed
    }
}

/// The fixed header of any mode, version and fleet, for tools that inspect a network. Units use [`Datagram::decode`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// The sender's mode.
    pub mode: Mode,
    /// From the first version that can read the datagram to the last one that the sender speaks.
    pub versions: Versions,
    /// The sender's fleet.
    pub fleet: Fleet,
    kind: u8,
    codes: u8,
}

impl Header {
    /// Decodes the header, and returns the bytes behind it; [`DatagramError::Magic`] or [`DatagramError::Malformed`].
    pub fn decode(bytes: &[u8]) -> Result<(Self, &[u8]), DatagramError> {
        let (header, body) = bytes.split_first_chunk::<HEADER_BYTES>().ok_or(DatagramError::Malformed)?;
        let [m0, m1, m2, m3, first, kind, last, codes, f0, f1, f2, f3] = *header;
        let mode = Mode::of_magic([m0, m1, m2, m3]).ok_or(DatagramError::Magic)?;
        let (versions, fleet) = (Versions::from_wire(first, last), Fleet(u32::from_le_bytes([f0, f1, f2, f3])));
        Ok((Self { mode, versions, fleet, kind, codes }, body))
    }

    /// Decodes the body, by the versions of this unit. Does not check the codes.
    pub fn read<'b>(&self, body: &'b [u8]) -> Result<Datagram<'b>, DatagramError> {
        Ok(match self.kind {
            WHO_HAS if self.codes == self.codes_of(0) => Datagram::WhoHas(WhoHas::take(self.items(body)?)?),
            ANNOUNCE => {
                let announce = Announce::take(self.items(body)?)?;
                if self.codes != self.codes_of(announce.nonce) {
                    return Err(DatagramError::Malformed);
                }
                Datagram::Announce(announce)
            }
            SESSION => {
                let (link, nonce, body) = session(body).ok_or(DatagramError::Malformed)?;
                Datagram::Session { link, nonce, body }
            }
            _ => return Err(DatagramError::Malformed),
        })
    }

    /// The body without the codes.
    fn items<'b>(&self, body: &'b [u8]) -> Result<&'b [u8], DatagramError> {
        let codes = usize::from(self.codes).saturating_mul(CODE_BYTES);
        body.len().checked_sub(codes).and_then(|length| body.get(..length)).ok_or(DatagramError::Malformed)
    }

    /// How many codes a search has, or an answer with this nonce.
    const fn codes_of(&self, nonce: u64) -> u8 {
        codes(self.mode, nonce != 0)
    }

    fn check(&self, mode: Mode, fleet: Fleet) -> Result<(), DatagramError> {
        if self.mode != mode {
            return Err(DatagramError::Magic);
        }
        if VERSIONS.common(self.versions).is_none() {
            return Err(DatagramError::Version(self.versions));
        }
        if self.fleet != fleet {
            return Err(DatagramError::Fleet(self.fleet));
        }
        Ok(())
    }
}

/// How many codes there are: the fleet's and, if the datagram is for one unit, the pair's; none in plain mode.
const fn codes(mode: Mode, for_one: bool) -> u8 {
    match mode {
        Mode::Plain => 0,
        Mode::Secured if for_one => 2,
        Mode::Secured => 1,
    }
}

/// The fixed fields of a search.
struct Search {
    sequence: u32,
    nonce: u64,
    tcp_port: u16,
    expected: u16,
}

impl Search {
    fn take(reader: &mut Reader<'_>) -> Self {
        Self { sequence: reader.u32(), nonce: reader.u64(), tcp_port: reader.u16(), expected: reader.u16() }
    }
}

/// The fixed fields of an answer.
struct Answer {
    sequence: u32,
    nonce: u64,
    tcp_port: u16,
    room: u16,
    expected: u16,
}

impl Answer {
    fn take(reader: &mut Reader<'_>) -> Self {
        Self {
            sequence: reader.u32(),
            nonce: reader.u64(),
            tcp_port: reader.u16(),
            room: reader.u16(),
            expected: reader.u16(),
        }
    }
}

/// Decodes an item [`kind::KNOWN`]: hashes of four bytes each.
fn hashes(body: &[u8]) -> Result<heapless::Vec<u32, KNOWN_NODES>, Malformed> {
    let (hashes, []) = body.as_chunks() else { return Err(Malformed) };
    let mut known = heapless::Vec::new();
    known.extend(hashes.iter().take(KNOWN_NODES).map(|hash| u32::from_le_bytes(*hash)));
    Ok(known)
}

impl<'b> Datagram<'b> {
    /// Decodes a datagram of this fleet. In secured mode the fleet's code of a [`WhoHas`] or [`Announce`] is checked before
    /// anything else is decoded, and an answer needs the pair's code. Session datagrams are decrypted by their session.
    pub fn decode(bytes: &'b [u8], fleet: Fleet, authenticator: &dyn Authenticator) -> Result<Self, DatagramError> {
        let (header, body) = Header::decode(bytes)?;
        header.check(authenticator.mode(), fleet)?;
        if header.mode == Mode::Plain || header.kind == SESSION {
            return header.read(body);
        }
        let signed = of_fleet(bytes, authenticator).ok_or(DatagramError::Forged)?;
        let datagram = header.read(body)?;
        match &datagram {
            Self::Announce(announce) if announce.nonce != 0 && !is_for_us(signed, announce, authenticator) => {
                Err(DatagramError::NotForUs)
            }
            _ => Ok(datagram),
        }
    }
}

/// Link, nonce and body of a session datagram of this mode and fleet, judged by its header alone: pass them to
/// [`Session::datagram`](crate::services::session::Session::datagram), and all other datagrams to the node.
pub fn for_session(bytes: &mut [u8], mode: Mode, fleet: Fleet) -> Option<(LinkId, u64, &mut [u8])> {
    let (header, body) = Header::decode(bytes).ok()?;
    header.check(mode, fleet).ok()?;
    if header.kind != SESSION {
        return None;
    }
    let (link, nonce, _) = session(body)?;
    Some((LinkId(link), nonce, bytes.get_mut(SESSION_HEADER_BYTES..)?))
}

/// The datagram without the fleet's code, if that is right.
fn of_fleet<'b>(bytes: &'b [u8], authenticator: &dyn Authenticator) -> Option<&'b [u8]> {
    let (signed, code) = bytes.split_last_chunk()?;
    authenticator.is_of_fleet(signed, code).then_some(signed)
}

fn is_for_us(signed: &[u8], announce: &Announce, authenticator: &dyn Authenticator) -> bool {
    let Some((signed, code)) = signed.split_last_chunk() else { return false };
    authenticator.is_of(&announce.identity, signed, code)
}

/// Link, nonce and body of a session datagram.
fn session(body: &[u8]) -> Option<(u16, u64, &[u8])> {
    let (head, body) = body.split_first_chunk::<{ SESSION_HEADER_BYTES - HEADER_BYTES }>()?;
    let [l0, l1, _, _, n0, n1, n2, n3, n4, n5, n6, n7] = *head;
    let nonce = u64::from_le_bytes([n0, n1, n2, n3, n4, n5, n6, n7]);
    Some((u16::from_le_bytes([l0, l1]), nonce, body))
}

fn header(kind: u8, mode: Mode, versions: Versions, codes: u8, fleet: Fleet) -> [u8; HEADER_BYTES] {
    let [m0, m1, m2, m3] = mode.magic();
    let [f0, f1, f2, f3] = fleet.0.to_le_bytes();
    [m0, m1, m2, m3, versions.first, kind, versions.last, codes, f0, f1, f2, f3]
}

/// Appends a code after the first `length` bytes of `out`; returns the new length.
fn append(code: [u8; CODE_BYTES], length: usize, out: &mut [u8]) -> Option<usize> {
    *out.get_mut(length..)?.first_chunk_mut()? = code;
    length.checked_add(CODE_BYTES)
}

fn sign_for_fleet(length: usize, authenticator: &dyn Authenticator, out: &mut [u8]) -> Option<usize> {
    append(authenticator.sign_for_fleet(out.get(..length)?), length, out)
}

impl WhoHas {
    fn take(body: &[u8]) -> Result<Self, DatagramError> {
        let (mut unit, mut wanted, mut search, mut known) = (None, None, None, heapless::Vec::new());
        let (mut standby, mut skipped) = (false, 0);
        for item in Items::new(body) {
            let item = item?;
            match item.kind {
                kind::UNIT => unit = Some(item.read(Identity::take)?),
                kind::WANTED => wanted = Some(item.read(Manager::take)?),
                kind::SEARCH => search = Some(item.read(Search::take)?),
                kind::KNOWN => known = hashes(item.body)?,
                kind::STANDBY => standby = true,
                _ => item.skip(&mut skipped)?,
            }
        }
        let (Some((identity, epoch)), Some(search)) = (unit, search) else { return Err(DatagramError::Malformed) };
        if !identity.is_sound() {
            return Err(DatagramError::Malformed);
        }
        let Search { sequence, nonce, tcp_port, expected } = search;
        Ok(Self { identity, epoch, sequence, nonce, wanted, tcp_port, expected, known, standby, skipped })
    }

    /// Encodes the datagram into `out`; `None` if it does not fit.
    pub fn encode<'o>(&self, fleet: Fleet, authenticator: &dyn Authenticator, out: &'o mut [u8]) -> Option<&'o [u8]> {
        let mode = authenticator.mode();
        let mut writer = Writer::new(out);
        writer.bytes(&header(WHO_HAS, mode, VERSIONS, codes(mode, false), fleet));
        self.identity.put(self.epoch, &mut writer);
        Manager::put(self.wanted.as_ref(), &mut writer);
        let item = writer.begin(kind::SEARCH);
        writer.number(self.sequence.into());
        writer.number(self.nonce);
        writer.numbers(&[self.tcp_port.into(), self.expected.into()]);
        writer.end(item);
        if !self.known.is_empty() {
            let item = writer.begin(kind::KNOWN);
            for hash in &self.known {
                writer.bytes(&hash.to_le_bytes());
            }
            writer.end(item);
        }
        if self.standby {
            let item = writer.begin(kind::STANDBY);
            writer.end(item);
        }
        let mut length = writer.finish()?;
        if mode == Mode::Secured {
            length = sign_for_fleet(fill(length, out)?, authenticator, out)?;
        }
        out.get(..length)
    }
}

impl Announce {
    fn take(body: &[u8]) -> Result<Self, DatagramError> {
        let (mut unit, mut answer, mut claim, mut obeyed, mut skipped) = (None, None, None, None, 0);
        for item in Items::new(body) {
            let item = item?;
            match item.kind {
                kind::UNIT => unit = Some(item.read(Identity::take)?),
                kind::ANSWER => answer = Some(item.read(Answer::take)?),
                kind::CLAIM => claim = Some(item.read(ClaimReport::take)?),
                kind::OBEYED => obeyed = Some(item.read(ClaimReport::take)?),
                _ => item.skip(&mut skipped)?,
            }
        }
        let (Some((identity, epoch)), Some(answer)) = (unit, answer) else { return Err(DatagramError::Malformed) };
        if !identity.is_sound() {
            return Err(DatagramError::Malformed);
        }
        let Answer { sequence, nonce, tcp_port, room, expected } = answer;
        Ok(Self { identity, epoch, claim, obeyed, sequence, nonce, tcp_port, room, expected, skipped })
    }

    /// Encodes the datagram into `out`; `None` if it does not fit, or in secured mode if there is no key for the pair with `to`.
    pub fn encode<'o>(
        &self,
        fleet: Fleet,
        authenticator: &dyn Authenticator,
        to: Option<&Identity>,
        out: &'o mut [u8],
    ) -> Option<&'o [u8]> {
        let mode = authenticator.mode();
        let to = to.filter(|_| self.nonce != 0);
        let mut writer = Writer::new(out);
        writer.bytes(&header(ANNOUNCE, mode, VERSIONS, codes(mode, to.is_some()), fleet));
        self.identity.put(self.epoch, &mut writer);
        let item = writer.begin(kind::ANSWER);
        writer.number(self.sequence.into());
        writer.number(self.nonce);
        writer.numbers(&[self.tcp_port.into(), self.room.into(), self.expected.into()]);
        writer.end(item);
        ClaimReport::put(self.claim.as_ref(), kind::CLAIM, &mut writer);
        ClaimReport::put(self.obeyed.as_ref(), kind::OBEYED, &mut writer);
        let mut length = writer.finish()?;
        if mode == Mode::Secured {
            length = match to {
                Some(to) => append(authenticator.sign_for(to, out.get(..length)?)?, length, out)?,
                None => fill(length, out)?,
            };
            length = sign_for_fleet(length, authenticator, out)?;
        }
        out.get(..length)
    }
}

/// Pads the first `length` bytes of `out` to the longest answer without the fleet's code; returns the new length.
fn fill(length: usize, out: &mut [u8]) -> Option<usize> {
    items::fill(length, ANSWER_BYTES.saturating_sub(CODE_BYTES), out)
}

/// The header of a session datagram: `link` and `nonce` are those of the receiver.
pub fn session_header(mode: Mode, version: u8, fleet: Fleet, link: u16, nonce: u64) -> [u8; SESSION_HEADER_BYTES] {
    let versions = Versions { first: version, last: version };
    let [h0, h1, h2, h3, h4, h5, h6, h7, h8, h9, h10, h11] = header(SESSION, mode, versions, 0, fleet);
    let [l0, l1] = link.to_le_bytes();
    let [n0, n1, n2, n3, n4, n5, n6, n7] = nonce.to_le_bytes();
    [h0, h1, h2, h3, h4, h5, h6, h7, h8, h9, h10, h11, l0, l1, 0, 0, n0, n1, n2, n3, n4, n5, n6, n7]
}

/// Names an identity in a list of known nodes by 32 bits: FNV-1a over role (0 m_unit, 1 s_unit), id (little-endian) and name. A
/// collision costs one more search.
pub fn short_hash(identity: &Identity) -> u32 {
    let role = match identity.role() {
        Role::MUnit => 0,
        Role::SUnit => 1,
    };
    let fold = |hash, bytes: &[u8]| {
        bytes.iter().fold(hash, |hash: u32, byte| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193))
    };
    fold(fold(fold(0x811C_9DC5, &[role]), &identity.id().to_le_bytes()), identity.name().as_bytes())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]
    use super::*;
    use crate::host::secure::Plain;
    use proptest::prelude::*;

    const FLEET: Fleet = Fleet(7);

    fn who_has(known: usize) -> WhoHas {
        WhoHas {
            identity: Identity::m_unit("a-manager-with-a-name-of-32-byte", u32::MAX).unwrap(),
            epoch: Epoch(u64::MAX),
            sequence: u32::MAX,
            nonce: u64::MAX,
            wanted: Some(Manager { name: "a-manager-with-a-name-of-32-byte".try_into().unwrap(), id: u32::MAX }),
            tcp_port: u16::MAX,
            expected: u16::MAX,
            known: (0..known).map(|_| u32::MAX).collect(),
            standby: false,
            skipped: 0,
        }
    }

    #[test]
    fn the_longest_search_fits_and_survives() {
        let search = WhoHas { standby: true, ..who_has(KNOWN_NODES) };
        let mut out = [0; SEARCH_BYTES];
        let bytes = search.encode(FLEET, &Plain, &mut out).unwrap();
        assert_eq!(Datagram::decode(bytes, FLEET, &Plain), Ok(Datagram::WhoHas(search)));
    }

    #[test]
    fn another_fleet_version_or_magic_is_named() {
        let mut out = [0; SEARCH_BYTES];
        let length = who_has(0).encode(FLEET, &Plain, &mut out).unwrap().len();
        assert_eq!(Datagram::decode(&out[..length], Fleet(8), &Plain), Err(DatagramError::Fleet(FLEET)));
        // A later version that can still speak ours is heard; one that cannot is told.
        out[6] = 9;
        assert!(Datagram::decode(&out[..length], FLEET, &Plain).is_ok());
        out[4] = 9;
        let versions = Versions { first: 9, last: 9 };
        assert_eq!(Datagram::decode(&out[..length], FLEET, &Plain), Err(DatagramError::Version(versions)));
        for other in [*b"Xarp", Mode::Secured.magic()] {
            out[..4].copy_from_slice(&other);
            assert_eq!(Datagram::decode(&out[..length], FLEET, &Plain), Err(DatagramError::Magic));
        }
    }

    #[test]
    fn a_header_is_read_whatever_its_version_and_fleet() {
        let mut out = [0; SEARCH_BYTES];
        let length = who_has(0).encode(FLEET, &Plain, &mut out).unwrap().len();
        (out[4], out[6]) = (8, 9);
        let (header, body) = Header::decode(&out[..length]).unwrap();
        assert_eq!((header.versions, header.fleet), (Versions { first: 8, last: 9 }, FLEET));
        assert_eq!(header.read(body), Ok(Datagram::WhoHas(who_has(0))));
        assert_eq!(header.read(&body[..body.len() - 1]), Err(DatagramError::Malformed));
        out[0] = b'X';
        assert_eq!(Header::decode(&out[..length]), Err(DatagramError::Magic));
        assert_eq!(Header::decode(&out[..HEADER_BYTES - 1]), Err(DatagramError::Malformed));
    }

    #[test]
    fn a_session_datagram_is_told_by_its_header() {
        let datagram = |mode, fleet: Fleet| [&session_header(mode, VERSIONS.last, fleet, 3, 42)[..], &[1]].concat();
        for mode in [Mode::Plain, Mode::Secured] {
            let mut bytes = datagram(mode, FLEET);
            assert_eq!(for_session(&mut bytes, mode, FLEET), Some((LinkId(3), 42, &mut [1][..])));
            for at in 0..SESSION_HEADER_BYTES {
                let mut changed = bytes.clone();
                changed[at] ^= 0x80;
                // Link and nonce may be any, and what a later version may have told.
                let any = at >= 12 || at == 6 || at == 7;
                assert_eq!(for_session(&mut changed, mode, FLEET).is_some(), any, "{at}");
                assert_eq!(for_session(&mut bytes[..at].to_vec(), mode, FLEET), None);
            }
        }
        assert_eq!(for_session(&mut datagram(Mode::Plain, FLEET), Mode::Secured, FLEET), None);
        assert_eq!(for_session(&mut datagram(Mode::Plain, Fleet(8)), Mode::Plain, FLEET), None);
        let mut out = [0; SEARCH_BYTES];
        let length = who_has(1).encode(FLEET, &Plain, &mut out).unwrap().len();
        assert_eq!(for_session(&mut out[..length], Mode::Plain, FLEET), None);
    }

    #[test]
    fn a_session_datagram_carries_its_link_and_nonce() {
        let mut bytes =
            std::vec::Vec::from(session_header(Mode::Plain, VERSIONS.last, FLEET, 300, 0x0102_0304_0506_0708));
        bytes.push(42);
        let expected = Datagram::Session { link: 300, nonce: 0x0102_0304_0506_0708, body: &[42] };
        assert_eq!(Datagram::decode(&bytes, FLEET, &Plain), Ok(expected));
    }

    #[test]
    fn every_cut_every_tail_and_every_unknown_kind_is_refused() {
        let mut out = [0; SEARCH_BYTES];
        let length = who_has(2).encode(FLEET, &Plain, &mut out).unwrap().len();
        // The nodes that stay silent are told last, and need not be.
        let known = 4 + 2 * 4;
        for cut in (0..length).filter(|cut| *cut != length - known) {
            assert_eq!(Datagram::decode(&out[..cut], FLEET, &Plain), Err(DatagramError::Malformed), "{cut}");
        }
        assert_eq!(Datagram::decode(&out[..length + 1], FLEET, &Plain), Err(DatagramError::Malformed));
        for (place, byte) in [(5, 0), (5, 4), (7, 1)] {
            let mut changed = out;
            changed[place] = byte;
            assert_eq!(Datagram::decode(&changed[..length], FLEET, &Plain), Err(DatagramError::Malformed));
        }
        let session = session_header(Mode::Plain, VERSIONS.last, FLEET, 1, 2);
        assert_eq!(
            Datagram::decode(&session[..SESSION_HEADER_BYTES - 1], FLEET, &Plain),
            Err(DatagramError::Malformed)
        );
    }

    #[test]
    fn a_node_without_a_name_is_refused() {
        let mut out = [0; SEARCH_BYTES];
        let length = who_has(0).encode(FLEET, &Plain, &mut out).unwrap().len();
        // The identity is behind the head of its item; it begins with its id in five bytes, and the name's length follows.
        let at = HEADER_BYTES + 4 + 5;
        assert_eq!((out[HEADER_BYTES + 2], out[at]), (49, 32));
        (out[HEADER_BYTES + 2], out[at]) = (17, 0);
        let mut bytes = std::vec::Vec::from(&out[..length]);
        bytes.drain(at + 1..=at + 32);
        assert_eq!(Datagram::decode(&bytes, FLEET, &Plain), Err(DatagramError::Malformed));
    }

    #[test]
    fn short_hashes_are_fnv_1a() {
        // Computed by hand from the definition: role 0, id 1, "a".
        let mut expected: u32 = 0x811C_9DC5;
        for byte in [0, 1, 0, 0, 0, b'a'] {
            expected = (expected ^ u32::from(byte)).wrapping_mul(16_777_619);
        }
        assert_eq!(short_hash(&Identity::m_unit("a", 1).unwrap()), expected);
        assert_ne!(short_hash(&Identity::s_unit("a", 1).unwrap()), expected);
    }

    proptest! {
        #[test]
        fn what_is_read_from_changed_bytes_can_be_written_again(
            changes in prop::collection::vec((0..SEARCH_BYTES, any::<u8>()), 0..6),
            cut in 0..SEARCH_BYTES,
            known in 0..KNOWN_NODES,
        ) {
            let mut out = [0; SEARCH_BYTES];
            let length = who_has(known).encode(FLEET, &Plain, &mut out).unwrap().len();
            for (place, byte) in changes {
                out[place] = byte;
            }
            let _ = Datagram::decode(&out[..length.min(cut)], FLEET, &Plain);
            if let Ok(Datagram::WhoHas(read)) = Datagram::decode(&out[..length], FLEET, &Plain) {
                let (read, mut again) = (WhoHas { skipped: 0, ..read }, [0; SEARCH_BYTES]);
                let bytes = read.encode(FLEET, &Plain, &mut again).unwrap();
                prop_assert_eq!(Datagram::decode(bytes, FLEET, &Plain), Ok(Datagram::WhoHas(read)));
            }
        }
    }
}
