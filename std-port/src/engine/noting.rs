//! What is recorded of calls by the unit's own program: the audit log has those that move, stop or reset something, and the
//! followers of commands get all. An operator's are recorded where they are asked for.

#[cfg(feature = "control")]
pub(super) use crate::control::Recorded;

#[cfg(feature = "control")]
use std::sync::{Arc, OnceLock};

#[cfg(not(feature = "control"))]
use cara_core::distribution::parameters::ParametersView;
#[cfg(not(feature = "control"))]
use cara_core::error::Error;
use cara_core::services::session::RequestOptions;

use super::link::LinkCell;
#[cfg(feature = "control")]
use crate::Log;
#[cfg(feature = "control")]
use crate::control::{Audit, Commands, FollowedCall, ProgramCall};

/// Without operators there is no audit log, and no follower.
#[cfg(not(feature = "control"))]
#[derive(Debug)]
pub(super) enum Recorded {}

#[cfg(not(feature = "control"))]
impl Recorded {
    pub(super) fn asks(&mut self, _: &ParametersView) {
        match *self {}
    }

    pub(super) fn answers(&mut self, _: &ParametersView) {
        match *self {}
    }

    pub(super) fn ended(self, _: Result<Option<u32>, Error>) {
        match self {}
    }
}

/// Where such calls are noted, if anywhere.
pub(super) struct Notes {
    #[cfg(feature = "control")]
    pub(super) audit: Option<Arc<Audit>>,
    #[cfg(feature = "control")]
    pub(super) commands: Arc<Commands>,
    /// The program's log, which operators see.
    #[cfg(feature = "control")]
    pub(super) log: OnceLock<Log>,
}

#[cfg(feature = "control")]
impl Notes {
    /// What is to be recorded of a call that is about to be made.
    pub(super) fn recorded(&self, link: &LinkCell, function: &str, options: &RequestOptions) -> Option<Recorded> {
        let is_followed = self.commands.are_followed();
        if options.operator || self.audit.is_none() && !is_followed {
            return None;
        }
        let (attributes, definition) = {
            let link = link.lock();
            let known = link.session.their_function_list().named(function);
            let definition = known.filter(|_| is_followed).map(|known| known.signature.to_definition());
            (known.map(|known| *known.attributes), definition)
        };
        let peer = link.peer.get();
        let node = || peer.map(|peer| peer.identity.to_string()).unwrap_or_default();
        let audited =
            self.audit.as_ref().and_then(|audit| ProgramCall::of(audit, function, attributes, options.take_over, node));
        let followed = peer
            .zip(definition)
            .map(|(peer, definition)| FollowedCall::of(&self.commands, &peer.identity, definition, options.take_over));
        Recorded::of(audited, followed)
    }

    pub(super) fn commands(&self) -> &Commands {
        &self.commands
    }

    /// Lines that nothing has written.
    pub(super) fn lines_lost(&self) -> u64 {
        self.audit.as_ref().map_or(0, |audit| audit.lost())
    }
}

#[cfg(not(feature = "control"))]
impl Notes {
    pub(super) fn recorded(&self, _: &LinkCell, _: &str, _: &RequestOptions) -> Option<Recorded> {
        None
    }

    pub(super) fn lines_lost(&self) -> u64 {
        0
    }
}
