//! Why a unit does not start, and why a call has no results.

use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;

use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::distribution::message::HandOverRefusal;
use cara_core::error::Error;
use cara_core::services::call::{self, CallDetails, Detail};

/// Why a call has no results. It turns into an [`Error`] by `?`.
///
/// ```no_run
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
/// if let Err(failed) = depot.s_unit("agv")?.call("go_to", &mut cara_std::Parameters::new()).wait() {
///     println!("{failed}; it may have run: {}", failed.may_have_run());
///     if let Some(failure) = failed.failure() {
///         println!("{:?}", failure.values().variable::<[i64; 2]>("at"));
///     }
/// }
/// # Ok::<(), cara_std::BuildError>(())
/// ```
pub type CallError<F = ()> = call::CallError<F, BoxedDetail>;

/// What is known of a failed call beside its [`Error`].
#[derive(Clone, Debug, Default)]
pub struct BoxedDetail(Option<Box<Detail>>);

const _: () = assert!(size_of::<CallError>() <= 24, "a result is returned in registers, or nearly");

impl CallDetails for BoxedDetail {
    fn of(detail: Detail) -> Self {
        Self(Some(Box::new(detail)))
    }

    fn get(&self) -> Option<&Detail> {
        self.0.as_deref()
    }
}

/// Why a vehicle was not [handed over](crate::Peer::hand_over).
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HandOverError {
    /// The vehicle stays.
    #[error(transparent)]
    Refused(HandOverRefusal),
    /// It was not asked, or has not answered.
    #[error(transparent)]
    Link(#[from] Error),
}

/// Why a unit does not start.
#[derive(Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// A live m_unit has this name, id and fleet. With keys the answer was proven by a key that only this identity has.
    #[error(
        "the m_unit {identity} of fleet {} is running already, {}: stop it first, or give this one its own name or id",
        fleet.0, place(at)
    )]
    AlreadyRunning {
        /// The identity of both.
        identity: Identity,
        /// Their fleet.
        fleet: Fleet,
        /// The address at which it takes links; port 0 of one that is about to start.
        at: SocketAddr,
    },
    /// A process of this host has the control socket of an m_unit of this name, id and fleet, and does not answer on the
    /// network: it hangs, is stopped, or is of another mode.
    #[error(
        "the m_unit {identity} of fleet {} is running already: a process of this host holds its control socket {}, and does \
         not answer as this one would. It hangs or is stopped (state T in `ps`; `kill -CONT` lets it go on), or it has other \
         keys or none: end it first, or give this one its own name or id",
        fleet.0, path.display()
    )]
    SocketHeld {
        /// The identity of both.
        identity: Identity,
        /// Their fleet.
        fleet: Fleet,
        /// The socket.
        path: PathBuf,
    },
    /// Another manager of this name, id and fleet has taken over within the last minute.
    #[error(
        "another manager {identity} of fleet {} has taken over within the last minute, and runs {}: wait, or force it \
         (`--force-take-over`)",
        fleet.0, place(at)
    )]
    JustTakenOver {
        /// The identity of both.
        identity: Identity,
        /// Their fleet.
        fleet: Fleet,
        /// The address at which it takes links.
        at: SocketAddr,
    },
    /// The key file of an m_unit has no key of the m_unit with itself, with which it makes its claims.
    #[error(
        "the file with the keys of {identity} has no key of it with itself, without which it can claim no vehicle: `cara keys \
         derive` on the provisioning host makes the file anew; bring it here"
    )]
    NoOwnKey {
        /// Its identity.
        identity: Identity,
    },
    /// An m_unit cannot store its claim, which it must before it speaks with it.
    #[error(
        "the claim of this manager cannot be stored: {0}; make space there, or name another folder of state (CARA_STATE)"
    )]
    Claim(String),
    /// The manager's authority has not given it the key, without which it may not claim.
    #[error(
        "the m_unit {identity} of fleet {} may not command, since it has not its authority's key: {why}; try again later, or start it as \
         a standby",
        fleet.0
    )]
    NoAuthority {
        /// Its identity.
        identity: Identity,
        /// Its fleet.
        fleet: Fleet,
        /// What is known of it.
        why: String,
    },
    /// Something about the unit itself, or what the system refuses.
    #[error(transparent)]
    Unit(#[from] Error),
}

impl StartError {
    /// The exit code with which `cara node` and the examples end where another one [runs already](Self::is_running_already):
    /// a supervisor should not start them again.
    pub const ALREADY_RUNNING_EXIT: u8 = 5;

    /// The exit code with which `cara node` and the examples end where a live manager with a higher claim commands
    /// ([`UnitEvent::Fenced`](crate::UnitEvent::Fenced)): a supervisor should not start them again.
    pub const FENCED_EXIT: u8 = 6;

    /// Whether another one of this identity is why it does not start.
    pub fn is_running_already(&self) -> bool {
        matches!(self, Self::AlreadyRunning { .. } | Self::SocketHeld { .. } | Self::JustTakenOver { .. })
    }

    /// The error's name, for programs.
    pub fn code(&self) -> String {
        match self {
            Self::AlreadyRunning { .. } | Self::SocketHeld { .. } => "AlreadyRunning".to_owned(),
            Self::JustTakenOver { .. } => "JustTakenOver".to_owned(),
            Self::NoOwnKey { .. } => "NoOwnKey".to_owned(),
            Self::Claim(_) => "Claim".to_owned(),
            Self::NoAuthority { .. } => "NoAuthority".to_owned(),
            Self::Unit(error) => format!("{error:?}"),
        }
    }
}

fn place(at: &SocketAddr) -> String {
    match at.port() {
        0 => format!("on {}, and about to take links", at.ip()),
        _ => format!("at {at}"),
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

debug_is_display!(
    crate::BuildError,
    StartError,
    crate::keys::KeyError,
    crate::keys::FleetError,
    crate::access::AccessError
);
#[cfg(feature = "control")]
debug_is_display!(crate::control::ControlError);

/// What the system says goes to the log; the error tells where to look.
pub(crate) fn system_refused(error: std::io::Error) -> Error {
    tracing::error!(%error, "the operating system refused a thread, a socket or a descriptor");
    Error::Network
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BuildError;

    #[test]
    fn what_main_prints_is_the_sentence() {
        let at = SocketAddr::from(([127, 0, 0, 1], 4000));
        let (identity, fleet) = (Identity::m_unit("depot", 1).unwrap(), Fleet(7));
        let running = |at| BuildError::from(StartError::AlreadyRunning { identity: identity.clone(), fleet, at });
        let error = running(at);
        assert_eq!(format!("{error:?}"), error.to_string());
        for part in ["depot/1 of fleet 7", "at 127.0.0.1:4000"] {
            assert!(format!("{error:?}").contains(part), "{error:?}");
        }
        let about_to_start = running(SocketAddr::from(([127, 0, 0, 1], 0))).to_string();
        assert!(!about_to_start.contains(":0") && about_to_start.contains("on 127.0.0.1,"), "{about_to_start}");
        let error = BuildError::from(Error::PortInUse);
        assert!(format!("{error:?}").contains("choose another port"), "{error:?}");
    }
}
