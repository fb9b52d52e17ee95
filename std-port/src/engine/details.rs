//! What is told of calls beside their results: of the peer's why they fail and how far they are, of this unit's the same, for
//! whatever watches them.

use std::fmt;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::Ticket;
use cara_core::services::requests::CallId;
use cara_core::services::session::{ReplyBlock, Session};
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
    watched: Vec<Watched>,
}

/// A call of this unit that is watched.
struct Watched {
    id: CallId,
    /// The newest that it has told, until it is looked at.
    progress: Option<Box<ParametersView>>,
    failure: Option<Box<Failure>>,
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

    pub(crate) fn watch(&mut self, id: CallId) {
        self.watched.push(Watched { id, progress: None, failure: None });
    }

    /// Nothing watches a call any more; why it failed, where its service has said so.
    pub(crate) fn unwatch(&mut self, id: CallId) -> Option<Box<Failure>> {
        let index = self.watched.iter().position(|watched| watched.id == id)?;
        self.watched.swap_remove(index).failure
    }

    pub(crate) fn has_news(&self, id: CallId) -> bool {
        self.watched.iter().any(|watched| watched.id == id && watched.progress.is_some())
    }

    pub(crate) fn take_progress(&mut self, id: CallId) -> Option<Box<ParametersView>> {
        self.watched.iter_mut().find(|watched| watched.id == id)?.progress.take()
    }

    fn of(&mut self, id: CallId) -> Option<&mut Watched> {
        self.watched.iter_mut().find(|watched| watched.id == id)
    }

    /// A call of this unit has told how far it is; whether anything watches it.
    pub(super) fn told(&mut self, id: CallId, block: &ReplyBlock<'_>) -> bool {
        let Some(watched) = self.of(id) else { return false };
        let mut values = arena(block.parameters_bytes() as usize);
        if block.read_into(&mut values).is_ok() {
            watched.progress = Some(values);
        }
        true
    }

    /// A call of this unit has failed, and its service has said why.
    pub(super) fn failed(&mut self, id: CallId, failure: Failure) {
        tracing::debug!(call = id.0, code = failure.code(), text = ?failure.text(), "a call has failed");
        if let Some(watched) = self.of(id) {
            watched.failure = Some(Box::new(failure));
        }
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
    engine: Weak<dyn Tells>,
    link: Weak<LinkCell>,
    ticket: Ticket,
}

impl fmt::Debug for Serving {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.ticket)
    }
}

/// The engine, whatever the application's state is.
trait Tells: Send + Sync {
    fn tell(&self, link: &Arc<LinkCell>, ticket: Ticket, values: &ParametersView) -> Result<(), Error>;
}

impl<T: Send + 'static> Tells for Engine<T> {
    fn tell(&self, link: &Arc<LinkCell>, ticket: Ticket, values: &ParametersView) -> Result<(), Error> {
        let mut state = link.lock();
        let told = self.send_progress(self.now(), link, &mut state, ticket, values);
        self.settle(link, state);
        told
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
        let told = self.with_at(now, link, state, |session, cx| session.progress(cx, ticket, values));
        let waiting = state.details.progress.iter_mut().find(|(known, _)| *known == ticket);
        match (told, waiting) {
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
    pub(super) fn tell_again(&self, now: Instant, link: &LinkCell, state: &mut LinkState) {
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

    pub(crate) fn tell(&self, values: &ParametersView) -> Result<(), Error> {
        match (self.engine.upgrade(), self.link.upgrade()) {
            (Some(engine), Some(link)) => engine.tell(&link, self.ticket, values),
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
/// use cara_std::{Canceller, Parameters, RequestOptions};
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
/// let (canceller, options) = (Canceller::new(), RequestOptions::default());
/// let button = canceller.clone();
/// std::thread::spawn(move || button.cancel());
/// let agv = depot.s_unit("agv")?;
/// let outcome = agv.block_request_cancellable("go_to", &mut Parameters::new(), &options, &canceller, |_| {});
/// # Ok::<(), cara_std::BuildError>(())
/// ```
///
/// Typed clients take it with their peer: [`Peer::cancelled_by`](crate::Peer::cancelled_by).
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

/// Hears what a call tells; `Break` gives it up.
pub(crate) type OnProgress<'w> = &'w mut dyn FnMut(&ParametersView) -> ControlFlow<()>;

/// What watches a call whose caller blocks.
pub(crate) struct Watch<'w> {
    /// `None` for a call whose progress nobody asks for.
    pub(crate) on_progress: Option<OnProgress<'w>>,
    pub(crate) canceller: &'w Canceller,
    pub(crate) failure: Option<Box<Failure>>,
}
