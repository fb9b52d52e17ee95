//! The asynchronous face, for tokio or any other executor: the unit's own threads read, and wake the task.

use std::fmt;
use std::future::{Future, poll_fn};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;

use crate::engine::{Alarm, CallTold, Engine, PendingCall, Step};

/// A call that [`Peer::request_async`](crate::Peer::request_async) has begun.
#[must_use = "a call is waited for by awaiting it; dropped, it is given up"]
pub struct PendingReply<'p, T: Send + 'static> {
    call: PendingCall<T>,
    alarm: Alarm<T>,
    parameters: &'p mut ParametersView,
    /// How it has ended, found by a look for progress.
    ended: Option<Error>,
}

impl<T: Send + 'static> fmt::Debug for PendingReply<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PendingReply").finish_non_exhaustive()
    }
}

impl<'p, T: Send + 'static> PendingReply<'p, T> {
    pub(crate) fn new(engine: &Arc<Engine<T>>, call: PendingCall<T>, parameters: &'p mut ParametersView) -> Self {
        Self { call, alarm: Alarm::new(engine.clone()), parameters, ended: None }
    }

    /// The newest that the call has told and this has not returned, if its options have `progress`; `None` once it has ended,
    /// and then awaiting it tells how. Dropping this future loses nothing; dropping the reply gives the call up, and its
    /// handler is told.
    ///
    /// ```no_run
    /// # async fn go(agv: cara_std::Peer) -> Result<(), cara_std::Error> {
    /// use cara_std::{Parameters, RequestOptions};
    ///
    /// let watched = RequestOptions { progress: true, ..RequestOptions::default() };
    /// let mut parameters = Parameters::new();
    /// let mut call = agv.request_async("go_to", &mut parameters, &watched)?;
    /// while let Some(told) = call.progress().await {
    ///     println!("{} m left", told.variable::<f64>("left")?);
    /// }
    /// if let Err(error) = (&mut call).await {
    ///     println!("{error}: {:?}", call.failure());
    /// }
    /// # Ok(())
    /// # }
    /// ```
    pub async fn progress(&mut self) -> Option<Box<ParametersView>> {
        poll_fn(|cx| {
            if self.ended.is_some() {
                return Poll::Ready(None);
            }
            match self.call.advance_progress(cx, self.parameters) {
                CallTold::Progress(told) => Poll::Ready(Some(told)),
                CallTold::Over(ended) => {
                    self.ended = ended;
                    Poll::Ready(None)
                }
                CallTold::Nothing => Poll::Pending,
                CallTold::Again(at) => {
                    self.alarm.set(at, cx.waker());
                    Poll::Pending
                }
            }
        })
        .await
    }

    /// Why the call failed, once it has and if its service has said so; for calls whose options have `progress`.
    pub const fn failure(&mut self) -> Option<Box<Failure>> {
        self.call.take_failure()
    }

    /// The call, once it has ended.
    pub(crate) fn into_call(self) -> PendingCall<T> {
        self.call
    }
}

impl<T: Send + 'static> Future for PendingReply<'_, T> {
    type Output = Result<(), Error>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let Self { call, alarm, parameters, ended } = &mut *self;
        if let Some(error) = ended.take() {
            return Poll::Ready(Err(error));
        }
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
