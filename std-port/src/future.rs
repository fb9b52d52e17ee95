//! The asynchronous face, for tokio or any other executor: the unit's own threads read, and wake the task.

use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;

use crate::engine::CallFuture;

/// A call in flight. Dropped before it has ended, it is given up: its slot is free, and what it started, or would start,
/// stops if its service has a lease. Without one the service may still run, once.
#[must_use = "a call is waited for by awaiting it"]
pub struct PendingReply<'p, T: Send + 'static> {
    call: CallFuture<T>,
    parameters: &'p mut ParametersView,
}

impl<T: Send + 'static> fmt::Debug for PendingReply<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PendingReply").finish_non_exhaustive()
    }
}

impl<'p, T: Send + 'static> PendingReply<'p, T> {
    pub(crate) fn new(call: CallFuture<T>, parameters: &'p mut ParametersView) -> Self {
        Self { call, parameters }
    }
}

impl<T: Send + 'static> Future for PendingReply<'_, T> {
    type Output = Result<(), Error>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let Self { call, parameters } = &mut *self;
        call.poll(cx, parameters)
    }
}
