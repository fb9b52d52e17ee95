//! Waits of tasks: for a change of a link, and for whatever happens to the unit. Nothing here holds a lock while it waits.

use std::future::poll_fn;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};

use cara_core::error::Error;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::driving::Alarm;
use super::link::{LinkCell, LinkState};
use super::reader::Cause;
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

/// This caller's turn to ping: the link has one ping at a time whose round trip is measured.
struct Turn<'l>(&'l LinkCell);

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        self.0.lock().pinging = false;
        self.0.notify();
    }
}

impl<T: Send + 'static> Engine<T> {
    /// Looks now and after each event of the unit, until there is something. [`Error::NotRunning`] when the unit is stopped.
    pub(crate) async fn look_until<R>(&self, mut look: impl FnMut() -> Option<R>) -> Result<R, Error> {
        let wait = Wait { news: &self.news, number: WAITS.fetch_add(1, Ordering::Relaxed) };
        poll_fn(|cx| {
            // Before the look: what comes after it wakes the task.
            self.news.await_more(wait.number, cx.waker());
            match look() {
                Some(found) => Poll::Ready(Ok(found)),
                None if self.is_stopping() => Poll::Ready(Err(Error::NotRunning)),
                None => Poll::Pending,
            }
        })
        .await
    }

    /// Looks at a link now and after each of its changes, until there is something; [`Error::TimedOut`] at the deadline.
    async fn look_at_link_until<R>(
        self: &Arc<Self>,
        link: &Arc<LinkCell>,
        deadline: Instant,
        mut look: impl FnMut(&mut LinkState) -> Option<Result<R, Error>>,
    ) -> Result<R, Error> {
        let mut alarm = Alarm::new(self.driver.clone());
        let mut poll = |cx: &mut Context<'_>| {
            let mut state = link.lock();
            let found = look(&mut state);
            let is_over = found.is_none() && self.now() >= deadline;
            if found.is_none() && !is_over {
                state.await_change(cx.waker());
            }
            self.settle(link, state);
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

    /// As [`ping`](Self::ping), without a thread that waits.
    pub(crate) async fn await_ping(
        self: &Arc<Self>,
        link: &Arc<LinkCell>,
        timeout: Duration,
    ) -> Result<Duration, Error> {
        let deadline = self.now() + timeout;
        let take_turn = |state: &mut LinkState| {
            if !state.session.is_live() {
                return Some(Err(Error::NotConnected));
            }
            (!std::mem::replace(&mut state.pinging, true)).then_some(Ok(()))
        };
        self.look_at_link_until(link, deadline, take_turn).await?;
        let _turn = Turn(link);
        let mut asked = false;
        let ask = |state: &mut LinkState| {
            if !state.session.is_live() {
                return Some(Err(Error::NotConnected));
            }
            if !asked {
                // A link that is kept is read by no thread until its caller is back.
                self.links.read_by(self.now(), link, state, Cause::NeedsPool);
                match self.with(link, state, |session, cx| session.ping(cx)) {
                    Ok(()) => asked = true,
                    Err(Error::Full(_)) => {}
                    Err(error) => return Some(Err(error)),
                }
            }
            state.session.round_trip().filter(|_| asked).map(Ok)
        };
        self.look_at_link_until(link, deadline, ask).await
    }

    /// As [`await_acknowledgements`](Self::await_acknowledgements), without a thread that waits.
    pub(crate) async fn acknowledgements(
        self: &Arc<Self>,
        reported: Vec<(Arc<LinkCell>, u32)>,
        timeout: Duration,
    ) -> Vec<Arc<LinkCell>> {
        let deadline = self.now() + timeout;
        let mut missing = Vec::new();
        for (link, serial) in reported {
            let look = |state: &mut LinkState| match state.session.is_acknowledged(serial) {
                true => Some(Ok(())),
                false => (!state.session.is_live()).then_some(Err(Error::NotConnected)),
            };
            if self.look_at_link_until(&link, deadline, look).await.is_err() {
                missing.push(link);
            }
        }
        missing
    }

    /// How what a call of this unit started has ended, once its peer has told.
    pub(crate) async fn end_of_order(
        self: &Arc<Self>,
        link: &Arc<LinkCell>,
        call: CallId,
        timeout: Duration,
    ) -> Result<LeaseEnd, Error> {
        let look = |state: &mut LinkState| {
            let nonce = state.session.nonce() as u32;
            let last = state.actuators.values().filter_map(|actuator| actuator.last);
            let end = last.filter(|last| (last.link, last.call) == (nonce, call.0)).find_map(|last| last.end);
            match end {
                Some(end) => Some(Ok(end)),
                None => (!state.session.is_live()).then_some(Err(Error::Interrupted)),
            }
        };
        self.look_at_link_until(link, self.now() + timeout, look).await
    }
}
