//! What is told of calls beside their results: of the peer's why they fail and how far they are, of this unit's the same, for
//! whatever watches them.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::Ticket;
use cara_core::services::session::Session;
use cara_core::time::Instant;

use super::Engine;
use super::link::{LinkCell, LinkState, Linux};
use super::worker::arena;

/// The details of one link, under its lock.
#[derive(Default)]
pub(crate) struct Details {
    /// What handlers have said of the failures of calls that are not answered yet.
    failures: Vec<(Ticket, Box<Failure>)>,
    /// The newest progress of each call of the peer that could not be sent.
    progress: Vec<(Ticket, Box<ParametersView>)>,
}

impl Details {
    pub(super) fn take_failure(&mut self, ticket: Ticket) -> Option<Box<Failure>> {
        self.progress.retain(|(known, _)| *known != ticket);
        let index = self.failures.iter().position(|(known, _)| *known == ticket)?;
        Some(self.failures.swap_remove(index).1)
    }

    pub(super) const fn has_progress_to_send(&self) -> bool {
        !self.progress.is_empty()
    }
}

/// Answers a call, with what its handler has said of its failure.
pub(super) fn answer(
    session: &mut Session<Linux>,
    cx: &mut cara_core::services::Context<'_, Linux>,
    ticket: Ticket,
    result: Result<&ParametersView, Error>,
    failure: Option<&Failure>,
) -> Result<(), Error> {
    match (result, failure) {
        (Err(error), Some(failure)) if error == failure.into() => session.answer_failed(cx, ticket, failure),
        _ => session.answer(cx, ticket, result),
    }
}

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
trait Reports: Send + Sync {
    fn notify(&self, link: &Arc<LinkCell>, ticket: Ticket, values: &ParametersView) -> Result<(), Error>;
}

impl<T: Send + 'static> Reports for Engine<T> {
    fn notify(&self, link: &Arc<LinkCell>, ticket: Ticket, values: &ParametersView) -> Result<(), Error> {
        let mut state = link.lock();
        let reported = self.send_progress(self.now(), link, &mut state, ticket, values);
        self.settle(link, state);
        reported
    }
}

impl<T: Send + 'static> Engine<T> {
    pub(super) fn serving(&self, link: &Arc<LinkCell>, ticket: Ticket) -> Serving {
        Serving { engine: self.me.clone(), link: Arc::downgrade(link), ticket }
    }

    fn send_progress(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        ticket: Ticket,
        values: &ParametersView,
    ) -> Result<(), Error> {
        let reported = self.with_at(now, link, state, |session, cx| session.progress(cx, ticket, values));
        let waiting = state.details.progress.iter_mut().find(|(known, _)| *known == ticket);
        match (reported, waiting) {
            (Err(Error::Full(_)), Some((_, kept))) => kept.copy_from(values),
            (Err(Error::Full(_)), None) => {
                let mut kept = arena(size_of_val(values));
                kept.copy_from(values)?;
                state.details.progress.push((ticket, kept));
                Ok(())
            }
            (Ok(()), _) => {
                state.details.progress.retain(|(known, _)| *known != ticket);
                Ok(())
            }
            // What is wrong with these values is nothing against those that wait.
            (Err(error), _) => Err(error),
        }
    }

    /// Sends the progress that there was no room for, as far as there is now.
    pub(super) fn notify_again(&self, now: Instant, link: &LinkCell, state: &mut LinkState) {
        for (ticket, values) in std::mem::take(&mut state.details.progress) {
            // What is wrong with it was told when it was new.
            let _ = self.send_progress(now, link, state, ticket, &values);
        }
    }
}

impl Serving {
    pub(crate) fn fail(&self, failure: Failure) {
        let Some(link) = self.link.upgrade() else { return };
        let mut state = link.lock();
        // Of a call that has ended nothing would take it.
        if !state.session.is_cancelled(self.ticket) {
            drop(state.details.take_failure(self.ticket));
            state.details.failures.push((self.ticket, Box::new(failure)));
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

/// Gives up a call that another thread waits for. Copies are of the same call.
///
/// ```no_run
/// use cara_std::{Canceller, Parameters};
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
/// let canceller = Canceller::new();
/// let button = canceller.clone();
/// std::thread::spawn(move || button.cancel());
/// let agv = depot.s_unit("agv")?;
/// let outcome = agv.call("go_to", &mut Parameters::new()).cancelled_by(&canceller).wait();
/// # Ok::<(), cara_std::BuildError>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Canceller(Arc<AtomicBool>);

impl Canceller {
    /// For one call, or for all calls that it is given to.
    pub fn new() -> Self {
        Self::default()
    }

    /// The call ends with [`Error::Cancelled`] within 20 ms, and its callee is told. What has not been sent yet is not sent.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::SeqCst);
    }

    /// Whether it was.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}
