//! Waits of tasks: for a change of a link, and for whatever happens to the unit. Nothing here holds a lock while it waits.

use std::future::poll_fn;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};

use cara_core::error::Error;
use cara_core::time::{Duration, Instant};

use crate::engine::link::{LinkCell, LinkState};
use crate::engine::{Alarm, Engine};
use crate::news::News;

/// Tells the waits for news apart.
static WAITS: AtomicU64 = AtomicU64::new(0);

/// A task's wait for news: when it is dropped, its waker is.
struct Wait<'n> {
    news: &'n News,
    number: u64,
}

impl Drop for Wait<'_> {
    fn drop(&mut self) {
        self.news.await_no_more(self.number);
    }
}

/// Looks now and after each event of the unit, until there is something. [`Error::NotRunning`] when the unit is stopped.
pub(super) async fn look_until<T: Send + 'static, R>(
    engine: &Engine<T>,
    mut look: impl FnMut() -> Option<R>,
) -> Result<R, Error> {
    let wait = Wait { news: &engine.news, number: WAITS.fetch_add(1, Ordering::Relaxed) };
    poll_fn(|cx| {
        // Before the look: what comes after it wakes the task.
        engine.news.await_more(wait.number, cx.waker());
        match look() {
            Some(found) => Poll::Ready(Ok(found)),
            None if engine.is_stopping() => Poll::Ready(Err(Error::NotRunning)),
            None => Poll::Pending,
        }
    })
    .await
}

/// A task's wait for changes of a link.
pub(super) struct LinkWait<'e, T: Send + 'static> {
    engine: &'e Arc<Engine<T>>,
    deadline: Instant,
}

impl<'e, T: Send + 'static> LinkWait<'e, T> {
    pub(super) fn new(engine: &'e Arc<Engine<T>>, timeout: Duration) -> Self {
        Self { engine, deadline: engine.now() + timeout }
    }

    /// Looks at a link now and after each of its changes, until there is something; [`Error::TimedOut`] at the deadline.
    pub(super) async fn until<R>(
        &self,
        link: &Arc<LinkCell>,
        mut look: impl FnMut(&mut LinkState) -> Option<Result<R, Error>>,
    ) -> Result<R, Error> {
        let (engine, deadline) = (self.engine, self.deadline);
        let mut alarm = Alarm::new(engine.driver.clone());
        let mut poll = |cx: &mut Context<'_>| {
            let mut state = link.lock();
            let found = look(&mut state);
            let is_over = found.is_none() && engine.now() >= deadline;
            if found.is_none() && !is_over {
                state.await_change(cx.waker());
            }
            engine.settle(link, state);
            match found {
                Some(result) => Poll::Ready(result),
                None if is_over => Poll::Ready(Err(Error::TimedOut)),
                None => {
                    alarm.set(deadline, cx.waker());
                    Poll::Pending
                }
            }
        };
        poll_fn(&mut poll).await
    }

    /// Those of the links whose peers have not read by the deadline what they were told.
    pub(super) async fn acknowledgements(&self, reported: Vec<(Arc<LinkCell>, u32)>) -> Vec<Arc<LinkCell>> {
        let mut missing = Vec::new();
        for (link, serial) in reported {
            let look = |state: &mut LinkState| match state.session.is_acknowledged(serial) {
                true => Some(Ok(())),
                false => (!state.session.is_live()).then_some(Err(Error::NotConnected)),
            };
            if self.until(&link, look).await.is_err() {
                missing.push(link);
            }
        }
        missing
    }
}
