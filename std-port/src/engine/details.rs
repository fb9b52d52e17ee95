//! What is told of calls beside their results: of the peer's why they fail and how far they are, of this unit's the same, for
//! whatever watches them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::Ticket;

use super::worker::arena;

/// The details of one link, under its lock.
#[derive(Default)]
pub(crate) struct Details {
    /// What handlers have said of the failures of calls that are not answered yet.
    failures: Vec<(Ticket, Box<Failure>)>,
    /// The newest progress of each call of the peer that could not be sent.
    pub(super) progress: Vec<(Ticket, Box<ParametersView>)>,
}

impl Details {
    pub(super) fn take_failure(&mut self, ticket: Ticket) -> Option<Box<Failure>> {
        self.progress.retain(|(known, _)| *known != ticket);
        let index = self.failures.iter().position(|(known, _)| *known == ticket)?;
        Some(self.failures.swap_remove(index).1)
    }

    /// What a handler has said of the failure of a call.
    pub(super) fn failed(&mut self, ticket: Ticket, failure: Failure) {
        drop(self.take_failure(ticket));
        self.failures.push((ticket, Box::new(failure)));
    }

    /// Progress has been `reported` to the peer, or waits until there is room for it.
    pub(super) fn keep_progress(
        &mut self,
        ticket: Ticket,
        values: &ParametersView,
        reported: Result<(), Error>,
    ) -> Result<(), Error> {
        let waiting = self.progress.iter_mut().find(|(known, _)| *known == ticket);
        match (reported, waiting) {
            (Err(Error::Full(_)), Some((_, kept))) => kept.copy_from(values),
            (Err(Error::Full(_)), None) => {
                let mut kept = arena(size_of_val(values));
                kept.copy_from(values)?;
                self.progress.push((ticket, kept));
                Ok(())
            }
            (Ok(()), _) => {
                self.progress.retain(|(known, _)| *known != ticket);
                Ok(())
            }
            // What is wrong with these values is nothing against those that wait.
            (Err(error), _) => Err(error),
        }
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
