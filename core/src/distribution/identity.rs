//! Identity of a node: name, id, role, fleet (paper, Fig. 2), and the epoch that distinguishes its boots.

use core::fmt;

use serde::{Deserialize, Serialize};

use super::compact::{Reader, Writer};
use super::items::kind;
use super::name::is_hidden;
use crate::config::NODE_NAME_BYTES;
use crate::error::Error;

/// m_unit or s_unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Role {
    /// `CommunicationSystem`: connects to many nodes.
    MUnit,
    /// `Unit`: connects to exactly one m_unit.
    SUnit,
}

impl Role {
    /// The word in texts and files: `m_unit` or `s_unit`.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::MUnit => "m_unit",
            Self::SUnit => "s_unit",
        }
    }
}

/// The number of a fleet. Units of different fleets never connect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Fleet(pub u32);

/// A boot of a node: different for each start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Epoch(pub u64);

/// Name, ID number and role of a node.
///
/// Ordered by (id, name): of two m_units the smaller one dials.
#[derive(Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Identity {
    id: u32,
    name: heapless::String<NODE_NAME_BYTES>,
    role: Role,
}

impl Identity {
    /// An m_unit's identity.
    pub fn m_unit(name: &str, id: u32) -> Result<Self, Error> {
        Self::new(name, id, Role::MUnit)
    }

    /// An s_unit's identity.
    pub fn s_unit(name: &str, id: u32) -> Result<Self, Error> {
        Self::new(name, id, Role::SUnit)
    }

    /// An identity; [`Error::BadName`] for a name that is empty, longer than [`NODE_NAME_BYTES`], or has control, bidi or
    /// zero-width characters.
    pub fn new(name: &str, id: u32, role: Role) -> Result<Self, Error> {
        let name = heapless::String::try_from(name).map_err(|_| Error::BadName)?;
        let identity = Self { id, name, role };
        if identity.is_sound() { Ok(identity) } else { Err(Error::BadName) }
    }

    /// Encodes the item with identity and epoch.
    pub(super) fn put(&self, epoch: Epoch, writer: &mut Writer<'_>) {
        let item = writer.begin(kind::UNIT);
        writer.number(self.id.into());
        writer.text(self.name.as_bytes());
        writer.flag(self.role == Role::SUnit);
        writer.number(epoch.0);
        writer.end(item);
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> (Self, Epoch) {
        let (id, name) = (reader.u32(), reader.name());
        let role = if reader.flag() { Role::SUnit } else { Role::MUnit };
        (Self { id, name, role }, Epoch(reader.u64()))
    }

    /// Whether the name is valid: not empty, and without [hidden](is_hidden) characters, which could forge lines of a
    /// log or make two names look alike.
    pub(crate) fn is_sound(&self) -> bool {
        !self.name.is_empty() && !self.name.chars().any(is_hidden)
    }

    /// The name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The ID number.
    pub const fn id(&self) -> u32 {
        self.id
    }

    /// The role.
    pub const fn role(&self) -> Role {
        self.role
    }
}

impl Ord for Identity {
    fn cmp(&self, other: &Self) -> core::cmp::Ordering {
        (self.id, self.name(), self.role).cmp(&(other.id, other.name(), other.role))
    }
}

impl PartialOrd for Identity {
    fn partial_cmp(&self, other: &Self) -> Option<core::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.name(), self.id)
    }
}

impl fmt::Debug for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
