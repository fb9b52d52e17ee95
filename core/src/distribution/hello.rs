//! The hello: the first frame on each link, in both directions.
//!
//! Magic and version stand in fixed places, so that units of different versions can refuse each other by name; the rest
//! is postcard.

use serde::{Deserialize, Serialize};

use super::compact::{Reader, Writer};
use super::identity::{Epoch, Fleet, Identity};
use crate::config::{Constraints, MINIMUM_CHUNK_BYTES, Mode, NODE_NAME_BYTES, VERSION};

/// Bytes of magic and version.
const PREFIX_BYTES: usize = 5;

/// Which manager an s_unit belongs to (paper, section 2: "the manually set properties of the m_unit object").
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Manager {
    /// The manager's name.
    pub name: heapless::String<NODE_NAME_BYTES>,
    /// The manager's ID number.
    pub id: u32,
}

/// What a unit takes, told so that nothing longer is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(test, derive(Serialize, Deserialize))]
pub struct Limits {
    /// Longest block of parameters, in bytes.
    pub message_size: u32,
    /// Longest frame body, in bytes.
    pub chunk_size: u16,
    /// Calls of one peer that it holds.
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

/// How a unit introduces itself on a link.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(test, derive(Serialize, Deserialize))]
pub struct Hello {
    /// Units of different fleets refuse each other.
    pub fleet: Fleet,
    /// Name, id and role.
    pub identity: Identity,
    /// The manager that an s_unit belongs to.
    pub wanted: Option<Manager>,
    /// This life of the unit.
    pub epoch: Epoch,
    /// Fresh for each link; the peer's session datagrams carry it.
    pub nonce: u64,
    /// For fail-over between managers, later; 0 now.
    pub term: u32,
    /// Abilities beyond this version; 0 now.
    pub capabilities: u32,
    /// What the unit takes.
    pub limits: Limits,
    /// The index by which the unit wants this link's session datagrams addressed.
    pub link: u16,
    /// The UDP port to which session datagrams go; 0 for none.
    pub udp_port: u16,
    /// The unit's clock when the hello was made, in microseconds.
    pub stamp: u64,
    /// Pause between the unit's keep-alives, in milliseconds.
    pub keep_alive: u32,
}

/// Why a hello cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HelloError {
    /// No unit at all.
    Magic,
    /// A unit of the other mode.
    Mode,
    /// Another version, this one.
    Version(u8),
    /// The rest cannot be read.
    Malformed,
}

impl Manager {
    pub(super) fn put(wanted: Option<&Self>, writer: &mut Writer<'_>) {
        writer.flag(wanted.is_some());
        if let Some(Self { name, id }) = wanted {
            writer.text(name.as_bytes());
            writer.number((*id).into());
        }
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> Option<Self> {
        reader.flag().then(|| Self { name: reader.name(), id: reader.u32() })
    }
}

impl Hello {
    /// Encodes into `out`; the length, or `None` where it does not fit.
    pub fn encode(&self, mode: Mode, out: &mut [u8]) -> Option<usize> {
        let (prefix, rest) = out.split_first_chunk_mut::<PREFIX_BYTES>()?;
        let [m0, m1, m2, m3] = mode.magic();
        *prefix = [m0, m1, m2, m3, VERSION];
        let mut writer = Writer::new(rest);
        self.put(&mut writer);
        writer.finish()?.checked_add(PREFIX_BYTES)
    }

    fn put(&self, writer: &mut Writer<'_>) {
        let Self { fleet, identity, wanted, epoch, nonce, term, capabilities, limits, .. } = self;
        writer.number(fleet.0.into());
        identity.put(writer);
        Manager::put(wanted.as_ref(), writer);
        let Limits { message_size, chunk_size, calls, minimum_interval } = *limits;
        writer.number(epoch.0);
        writer.number(*nonce);
        writer.numbers(&[*term, *capabilities, message_size, chunk_size.into(), calls.into(), minimum_interval]);
        writer.numbers(&[self.link.into(), self.udp_port.into()]);
        writer.number(self.stamp);
        writer.number(self.keep_alive.into());
    }

    fn take(reader: &mut Reader<'_>) -> Self {
        Self {
            fleet: Fleet(reader.u32()),
            identity: Identity::take(reader),
            wanted: Manager::take(reader),
            epoch: Epoch(reader.u64()),
            nonce: reader.u64(),
            term: reader.u32(),
            capabilities: reader.u32(),
            limits: Limits {
                message_size: reader.u32(),
                chunk_size: reader.u16(),
                calls: reader.u16(),
                minimum_interval: reader.u32(),
            },
            link: reader.u16(),
            udp_port: reader.u16(),
            stamp: reader.u64(),
            keep_alive: reader.u32(),
        }
    }

    /// Reads a hello of this mode: all of it, nothing behind it.
    pub fn decode(bytes: &[u8], mode: Mode) -> Result<Self, HelloError> {
        let (prefix, rest) = bytes.split_first_chunk::<PREFIX_BYTES>().ok_or(HelloError::Malformed)?;
        let [m0, m1, m2, m3, version] = *prefix;
        match Mode::of_magic([m0, m1, m2, m3]) {
            None => return Err(HelloError::Magic),
            Some(other) if other != mode => return Err(HelloError::Mode),
            Some(_) => {}
        }
        if version != VERSION {
            return Err(HelloError::Version(version));
        }
        let mut reader = Reader::new(rest);
        let hello = Self::take(&mut reader);
        let sound = reader.is_through()
            && hello.identity.is_sound()
            && usize::from(hello.limits.chunk_size) >= MINIMUM_CHUNK_BYTES;
        if sound { Ok(hello) } else { Err(HelloError::Malformed) }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]
    use super::*;
    use proptest::prelude::*;

    const ROOM: usize = 256;
    const PLAIN: Mode = Mode::Plain;

    fn longest() -> Hello {
        let name = "a-manager-with-a-name-of-32-byte";
        Hello {
            fleet: Fleet(u32::MAX),
            identity: Identity::s_unit(name, u32::MAX).unwrap(),
            wanted: Some(Manager { name: name.try_into().unwrap(), id: u32::MAX }),
            epoch: Epoch(u64::MAX),
            nonce: u64::MAX,
            term: u32::MAX,
            capabilities: u32::MAX,
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
        }
    }

    #[test]
    fn the_longest_hello_fits_256_bytes_and_survives() {
        let mut out = [0; ROOM];
        let length = longest().encode(PLAIN, &mut out).unwrap();
        assert_eq!(Hello::decode(&out[..length], PLAIN), Ok(longest()));
        assert_eq!(postcard::from_bytes(&out[PREFIX_BYTES..length]), Ok(longest()));
        assert_eq!(longest().encode(PLAIN, &mut out[..length - 1]), None);
        assert_eq!(Hello::decode(&out[..length + 1], PLAIN), Err(HelloError::Malformed), "nothing may follow");
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
        assert_eq!(with(4, VERSION + 1), Err(HelloError::Version(VERSION + 1)));
        for cut in 0..length {
            assert_eq!(Hello::decode(&out[..cut], PLAIN), Err(HelloError::Malformed));
        }
        let small = Limits { chunk_size: (MINIMUM_CHUNK_BYTES - 1) as u16, ..longest().limits };
        let length = Hello { limits: small, ..longest() }.encode(PLAIN, &mut out).unwrap();
        assert_eq!(Hello::decode(&out[..length], PLAIN), Err(HelloError::Malformed), "an emergency would not fit");
    }

    proptest! {
        #[test]
        fn what_is_read_from_changed_bytes_can_be_written_again(
            changes in prop::collection::vec((5usize..160, any::<u8>()), 0..6),
            cut in 0..ROOM,
        ) {
            let mut out = [0; ROOM];
            let length = longest().encode(PLAIN, &mut out).unwrap();
            for (place, byte) in changes {
                out[place] = byte;
            }
            let _ = Hello::decode(&out[..cut], PLAIN);
            // Whatever the bytes are, postcard reads the same.
            let mut reader = Reader::new(&out[PREFIX_BYTES..length]);
            let hello = Hello::take(&mut reader);
            let theirs = postcard::take_from_bytes::<Hello>(&out[PREFIX_BYTES..length]).ok();
            let theirs = theirs.and_then(|(hello, rest)| rest.is_empty().then_some(hello));
            prop_assert_eq!(reader.is_through().then_some(hello), theirs);
            if let Ok(hello) = Hello::decode(&out[..length], PLAIN) {
                let mut again = [0; ROOM];
                let length = hello.encode(PLAIN, &mut again).unwrap();
                prop_assert_eq!(Hello::decode(&again[..length], PLAIN), Ok(hello));
            }
        }
    }
}
