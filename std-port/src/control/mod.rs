//! The operator's interface (design, section 7): a running m_unit answers questions on a Unix socket that only its
//! owner can open.
//!
//! A unit opens its socket when it is started, unless its [`Builder`](crate::Builder) says otherwise ([`Control`]), and
//! removes it when it is stopped. [`Client`] is the other end; [`execute`] answers the same questions against a unit of
//! this process. The messages are in [`protocol`].
//!
//! The unit's own user, and root, have all rights of the program. So the directory belongs to its owner alone, and each
//! connection must come from the same user or from root; others are let in with a [`Role`] by [`Control::Shared`] alone.

mod answering;
mod attributes;
mod audit;
mod call;
mod client;
mod clock;
mod commands;
mod constraint;
mod describe;
mod elsewhere;
mod everybody;
mod failure;
mod forgetting;
mod hold;
pub mod json;
mod lines;
mod location;
pub mod protocol;
mod role;
mod select;
mod server;
mod sink;
mod stop;
mod stream;
mod values;

use std::path::PathBuf;
use std::sync::Arc;

pub use answering::{execute, execute_while};
pub(crate) use audit::{Audit, ProgramCall};
pub use client::{
    Answers, Client, Closer, ControlError, RunningUnit, UnitState, first_of, running, running_called, running_in,
};
pub(crate) use commands::{Commands, FollowedCall, Recorded};
pub use describe::event as described;
pub use elsewhere::{Elsewhere, elsewhere};
pub use forgetting::{ForgetError, Forgotten, forget_claims, state_folder};
pub use location::{directories, directory};
pub use role::{OperatorError, Operators, Role};
pub(crate) use server::Server;

use cara_core::distribution::identity::{Fleet, Identity};

use crate::CommunicationSystem;

/// Where a running m_unit answers its operator. An s_unit has no socket, and its builder no word for one:
///
/// ```compile_fail
/// cara_std::Unit::builder("agv", 7, "depot", 1).unwrap().control(cara_std::control::Control::Default);
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Control {
    /// In the [directory] of control sockets, under the unit's name, id and fleet. A socket that vanishes, as with the
    /// directories that a system removes when its user logs out, is made again there or in the next of the [directories].
    #[default]
    Default,
    /// At this path. Its directory is made if it is not there, and must be the owner's alone.
    Path(PathBuf),
    /// At this path, also for other users of the host, each with a role. Its directory has to be there, and must be the unit's
    /// user's; its group may enter it (mode 0750), and others must not.
    Shared(PathBuf, Operators),
    /// Nowhere.
    Off,
}

/// The socket of a unit that is to start, where a process has it that may be one of its identity, whether it answers or not.
pub(crate) fn held(control: &Control, identity: &Identity, fleet: Fleet) -> Option<PathBuf> {
    let (path, is_its_own) = match control {
        Control::Off => return None,
        Control::Default => {
            let name = location::file_name(identity, fleet);
            let path = directories().iter().map(|directory| directory.join(&name)).find(|path| location::is_held(path));
            (path.clone().unwrap_or_default(), path.is_some())
        }
        // Any unit may have been told this path.
        Control::Path(path) | Control::Shared(path, _) => (
            path.clone(),
            match Client::connect(path) {
                Ok(client) => client.unit().unit == identity.to_string() && client.unit().fleet == fleet.0,
                Err(ControlError::Silent { .. } | ControlError::Full { .. } | ControlError::Version { .. }) => true,
                Err(_) => false,
            },
        ),
    };
    is_its_own.then_some(path)
}

/// Removes the socket of a unit's own place at which nobody answers; `false` where somebody does, or it may be another unit's.
pub(crate) fn free_silent(control: &Control, path: &std::path::Path) -> bool {
    let Ok(file) = location::mark(path) else { return false };
    let is_its_own = *control == Control::Default;
    is_its_own && matches!(Client::connect(path), Err(ControlError::Silent { .. })) && location::free(path, file)
}

/// Opens the socket of a unit that has been started. A unit that cannot have one runs without it, with a warning in the
/// log.
pub(crate) fn open<T: Send + 'static>(
    control: &Control,
    audit: Option<Arc<Audit>>,
    guest: CommunicationSystem<T>,
) -> Option<Server> {
    let operators = if let Control::Shared(_, operators) = control { Some(operators.clone()) } else { None };
    let paths = match control {
        Control::Off => return None,
        Control::Path(path) | Control::Shared(path, _) => vec![path.clone()],
        Control::Default => {
            let name = location::file_name(&guest.identity(), guest.fleet());
            location::defaults().iter().map(|directory| directory.join(&name)).collect()
        }
    };
    match Server::open(paths, operators, audit, guest) {
        Ok(server) => Some(server),
        Err(error) => {
            tracing::warn!(%error, "there is no control socket: the `cara` command will not find this unit");
            None
        }
    }
}
