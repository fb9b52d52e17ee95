//! Why a unit does not start.

use std::fmt;
use std::net::SocketAddr;

use cara_core::error::Error;

/// Why a unit does not start.
#[derive(Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// A live m_unit has this name, id and fleet. With keys the answer was proven by a key that only this identity has.
    #[error(
        "an m_unit with this name and id is running already, at {at}: stop it first, or give this one its own name or id"
    )]
    AlreadyRunning {
        /// The address at which it takes links; port 0 of one that is about to start.
        at: SocketAddr,
    },
    /// Something about the unit itself, or what the system refuses.
    #[error(transparent)]
    Unit(#[from] Error),
}

impl StartError {
    /// The exit code with which `cara node` and the examples end where another one [runs already](Self::AlreadyRunning): a
    /// supervisor should not start them again.
    pub const ALREADY_RUNNING_EXIT: u8 = 5;

    /// The error's name, for programs.
    pub fn code(&self) -> String {
        match self {
            Self::AlreadyRunning { .. } => "AlreadyRunning".to_owned(),
            Self::Unit(error) => format!("{error:?}"),
        }
    }
}

/// A `main` that returns an error prints its `Debug`: the sentence says what to do, and the derived form does not.
macro_rules! debug_is_display {
    ($($error:ty),+) => {
        $(impl fmt::Debug for $error {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Display::fmt(self, f)
            }
        })+
    };
}

debug_is_display!(crate::BuildError, StartError, crate::keys::KeyError, crate::keys::FleetError);
#[cfg(feature = "access")]
debug_is_display!(crate::access::AccessError);
#[cfg(feature = "control")]
debug_is_display!(crate::control::ControlError);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BuildError;

    #[test]
    fn what_main_prints_is_the_sentence() {
        let at = SocketAddr::from(([127, 0, 0, 1], 4000));
        let error = BuildError::from(StartError::AlreadyRunning { at });
        assert_eq!(format!("{error:?}"), error.to_string());
        assert!(format!("{error:?}").contains("127.0.0.1:4000"), "{error:?}");
        let error = BuildError::from(Error::PortInUse);
        assert!(format!("{error:?}").contains("choose another port"), "{error:?}");
    }
}
