//! The asynchronous face, for tokio or any other executor: the unit's own threads read, and wake the task.

use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;

use crate::engine::{Alarm, Engine, PendingCall, Step};

/// A call that [`Peer::request_async`](crate::Peer::request_async) has begun.
#[must_use = "a call is waited for by awaiting it; dropped, it is given up"]
pub struct PendingReply<'p, T: Send + 'static> {
    call: PendingCall<T>,
    alarm: Alarm<T>,
    parameters: &'p mut ParametersView,
}

impl<T: Send + 'static> fmt::Debug for PendingReply<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PendingReply").finish_non_exhaustive()
    }
}

impl<'p, T: Send + 'static> PendingReply<'p, T> {
    pub(crate) fn new(engine: &Arc<Engine<T>>, call: PendingCall<T>, parameters: &'p mut ParametersView) -> Self {
        Self { call, alarm: Alarm::new(engine.clone()), parameters }
    }

    /// The call, once it has ended.
    pub(crate) fn into_call(self) -> PendingCall<T> {
        self.call
    }
}

impl<T: Send + 'static> Future for PendingReply<'_, T> {
    type Output = Result<(), Error>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let Self { call, alarm, parameters } = &mut *self;
        match call.advance(cx, parameters) {
            Step::Over(result) => Poll::Ready(result),
            Step::InFlight => Poll::Pending,
            Step::Again(at) => {
                alarm.set(at, cx.waker());
                Poll::Pending
            }
        }
    }
}
