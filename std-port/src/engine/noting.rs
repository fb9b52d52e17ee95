//! What the audit log has of calls by the unit's own program: those that move, stop or reset something. An operator's are noted
//! where they are asked for.

#[cfg(feature = "control")]
pub(super) use crate::control::ProgramCall as Recorded;

#[cfg(feature = "control")]
use std::sync::Arc;

use cara_core::services::session::RequestOptions;

use super::link::LinkCell;
#[cfg(feature = "control")]
use crate::control::Audit;

/// Without operators there is no audit log.
#[cfg(not(feature = "control"))]
#[derive(Debug)]
pub(super) enum Recorded {}

#[cfg(not(feature = "control"))]
impl Recorded {
    pub(super) fn ended(self, _: Result<(), cara_core::error::Error>) {
        match self {}
    }
}

/// Where such calls are noted, if anywhere.
pub(super) struct Notes {
    #[cfg(feature = "control")]
    pub(super) audit: Option<Arc<Audit>>,
}

#[cfg(feature = "control")]
impl Notes {
    /// What is to be noted of a call that is about to be made.
    pub(super) fn recorded(&self, link: &LinkCell, function: &str, options: &RequestOptions) -> Option<Recorded> {
        let audit = self.audit.as_ref().filter(|_| !options.operator)?;
        let attributes = link.lock().session.their_function_list().named(function).map(|known| *known.attributes);
        let node = || link.peer.get().map(|peer| peer.identity.to_string()).unwrap_or_default();
        Recorded::of(audit, function, attributes, options.take_over, node)
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
