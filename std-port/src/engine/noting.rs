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
        let peer = link.peer.get();
        let (attributes, followed) = {
            let state = link.lock();
            let known = state.session.their_function_list().named(function);
            let followed = known
                .zip(peer.filter(|_| is_followed))
                .map(|(known, peer)| FollowedCall::of(&self.commands, peer, known.signature, options.take_over));
            (known.map(|known| *known.attributes), followed)
        };
        let node = || peer.map(|peer| peer.identity.to_string()).unwrap_or_default();
        let audited =
            self.audit.as_ref().and_then(|audit| ProgramCall::of(audit, function, attributes, options.take_over, node));
        Recorded::of(audited, followed)
    }

    pub(super) fn commands(&self) -> &Arc<Commands> {
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
