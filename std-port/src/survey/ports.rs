//! The UDP ports of a survey.

use cara_core::config::{Mode, PLAIN_PORT, SECURED_PORT};

/// Where a survey listens, and where its questions go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ports {
    /// The port of plain mode and that of secured mode.
    Usual,
    /// One port for both modes.
    One(u16),
}

impl Ports {
    /// The ports.
    pub fn numbers(self) -> Vec<u16> {
        match self {
            Self::Usual => vec![PLAIN_PORT, SECURED_PORT],
            Self::One(port) => vec![port],
        }
    }

    /// The one of a mode.
    pub const fn of(self, mode: Mode) -> u16 {
        match self {
            Self::Usual => mode.port(),
            Self::One(port) => port,
        }
    }
}

impl From<u16> for Ports {
    fn from(port: u16) -> Self {
        Self::One(port)
    }
}
