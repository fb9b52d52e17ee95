//! Without the feature `details`: calls that fail have an error, and nothing beside it.

use core::convert::Infallible;
use core::ops::ControlFlow;

use cara_core::error::Error;
use cara_core::services::call::{Callee, Outgoing};

use crate::calls::CallError;
use crate::handle::Handle;
use crate::link::InFlight;
use crate::machine::Machine;
use crate::peer::Peer;

/// What is known of a failed call.
pub(crate) type Kept = ();

impl<T> Peer<T> {
    #[expect(clippy::unused_self, reason = "it is that of the feature")]
    pub(crate) fn explained(&self, _: Callee<'_>, error: Error) -> CallError {
        error.into()
    }
}

impl<T> Handle<T> {
    #[expect(clippy::unused_self, reason = "it is that of the feature")]
    pub(crate) const fn hear(&self, _: &InFlight, _: &mut Outgoing<'_, Infallible>) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }
}

impl<T> Machine<T> {
    #[expect(clippy::unused_self, reason = "it is that of the feature")]
    pub(crate) fn failed(&self, _: &InFlight, error: Error) -> CallError {
        error.into()
    }
}
