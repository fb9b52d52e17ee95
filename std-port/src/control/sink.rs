//! Where answers go, and why there are no more.

use std::ops::ControlFlow;
use std::time::Instant;

use cara_core::error::Error;
use cara_core::services::access::Verb;
use cara_core::time::Duration;

use super::protocol::{Answer, Failure};
use crate::CommunicationSystem;

/// Where answers go; `Break` when the client is gone.
pub(super) type Sink<'s> = &'s mut dyn FnMut(Answer) -> ControlFlow<()>;

/// When the client last sent something, its question or a [`BEAT`](super::protocol::BEAT); `None` once it has gone.
pub(super) type Lives<'l> = &'l dyn Fn() -> Option<Instant>;

/// How often a call and a watch check that their client is still there, and a pause that the unit still runs. A call
/// whose client has gone runs on for at most this long.
pub(super) const LOOK: std::time::Duration = std::time::Duration::from_millis(20);

/// Why an answer ends early.
pub(super) enum End {
    /// The client is gone.
    Gone,
    /// It could not be given.
    Failed(Failure),
}

impl From<Failure> for End {
    fn from(failure: Failure) -> Self {
        Self::Failed(failure)
    }
}

impl From<Error> for End {
    fn from(error: Error) -> Self {
        Self::Failed(error.into())
    }
}

pub(super) fn send(sink: Sink<'_>, answer: Answer) -> Result<(), End> {
    match sink(answer) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(End::Gone),
    }
}

/// Waits; [`Error::NotRunning`] when the unit has been stopped.
pub(super) fn pause<T: Send + 'static>(system: &CommunicationSystem<T>, span: Duration) -> Result<(), End> {
    let mut left: std::time::Duration = span.into();
    while !system.is_stopped() {
        let step = left.min(LOOK);
        if step.is_zero() {
            return Ok(());
        }
        std::thread::sleep(step);
        left -= step;
    }
    Err(Error::NotRunning.into())
}

/// Whether the operator may do something with a function.
pub(super) fn permit<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    function: &str,
    verb: Verb,
) -> Result<(), Failure> {
    system.operator_may(function, verb).map_err(|error| match error {
        Error::NotAllowed => Failure::not_allowed(function, verb),
        error => error.into(),
    })
}
