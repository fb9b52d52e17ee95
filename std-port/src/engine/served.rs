//! A call of a peer, as its handler has it: to tell how far it is, why it fails, and whether it is still wanted.

use std::fmt;
#[cfg(feature = "async")]
use std::sync::Mutex;
use std::sync::{Arc, Weak};
#[cfg(feature = "async")]
use std::task::{self, Poll, Waker};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::Ticket;
use cara_core::time::{Duration, Instant};

use super::link::{LinkCell, LinkState};
#[cfg(feature = "async")]
use crate::locks::{Locked, lock};

/// How long an answer waits for room at a time.
pub(super) const PAUSE: Duration = Duration::from_millis(20);

/// A call of a peer, for its handler.
#[derive(Clone)]
pub(crate) struct Serving {
    engine: Weak<dyn Reports>,
    link: Weak<LinkCell>,
    ticket: Ticket,
}

impl fmt::Debug for Serving {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.ticket)
    }
}

/// The engine, whatever the application's state is.
pub(super) trait Reports: Send + Sync {
    /// Tells the caller how far its call is.
    fn notify(&self, link: &Arc<LinkCell>, ticket: Ticket, values: &ParametersView) -> Result<(), Error>;
    /// Answers a call, with what its handler has said of its failure, unless there is no room for that now.
    fn try_answer(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        ticket: Ticket,
        result: Result<&ParametersView, Error>,
        failure: Option<&Failure>,
    ) -> Result<(), Error>;
    /// Gives the lock of a link up, and acts on what happened under it.
    #[cfg(feature = "async")]
    fn give_up_lock<'l>(&self, now: Instant, link: &'l Arc<LinkCell>, state: Locked<'l, LinkState>);
}

impl Serving {
    pub(super) fn new(engine: Weak<dyn Reports>, link: &Arc<LinkCell>, ticket: Ticket) -> Self {
        Self { engine, link: Arc::downgrade(link), ticket }
    }

    pub(crate) fn fail(&self, failure: Failure) {
        let Some(link) = self.link.upgrade() else { return };
        let mut state = link.lock();
        // Of a call that has ended nothing would take it. One that was given up is answered: its caller may wait for that.
        if !state.session.is_answered(self.ticket) {
            state.details.failed(self.ticket, failure);
        }
    }

    pub(crate) fn notify(&self, values: &ParametersView) -> Result<(), Error> {
        match (self.engine.upgrade(), self.link.upgrade()) {
            (Some(engine), Some(link)) => engine.notify(&link, self.ticket, values),
            _ => Ok(()),
        }
    }

    pub(crate) fn is_cancelled(&self) -> bool {
        self.link.upgrade().is_none_or(|link| {
            let state = link.lock();
            !state.session.is_live() || state.session.is_cancelled(self.ticket)
        })
    }
}

/// Whether the call of a handler is given up, for whatever awaits it.
#[cfg(feature = "async")]
#[derive(Debug, Default)]
pub(crate) struct GivenUp(Mutex<(bool, Vec<Waker>)>);

#[cfg(feature = "async")]
impl GivenUp {
    pub(super) fn notify(&self) {
        let mut state = lock(&self.0);
        state.0 = true;
        let tasks = std::mem::take(&mut state.1);
        drop(state);
        tasks.into_iter().for_each(Waker::wake);
    }

    pub(crate) fn poll(&self, cx: &task::Context<'_>) -> Poll<()> {
        let mut state = lock(&self.0);
        if state.0 {
            return Poll::Ready(());
        }
        if !state.1.iter().any(|task| task.will_wake(cx.waker())) {
            state.1.push(cx.waker().clone());
        }
        Poll::Pending
    }
}

#[cfg(test)]
#[cfg(feature = "async")]
mod tests {
    use super::*;

    #[test]
    fn what_awaits_the_end_of_a_call_is_woken_and_late_comers_see_it_at_once() {
        let given_up = GivenUp::default();
        let cx = task::Context::from_waker(Waker::noop());
        assert!(given_up.poll(&cx).is_pending());
        given_up.notify();
        assert!(given_up.poll(&cx).is_ready());
    }
}
