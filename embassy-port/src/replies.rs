//! Replies on their way to the tasks that wait for them.
//!
//! A task's parameters cannot be written by the runner, so a reply waits in one box until the task has read it. While
//! the box is taken, links with callers are not read: the network keeps what follows, and nothing is lost.

#[cfg(feature = "details")]
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::Signature;
use cara_core::error::Error;
use cara_core::services::session::Event;

use crate::connection::copy;
use crate::link::{InFlight, Link};

/// Room for the results of one call.
pub(crate) struct ReplyBox {
    bytes: &'static mut [u8],
    pub(crate) held: Option<(InFlight, usize)>,
    /// What the service has said of the failure that came last.
    #[cfg(feature = "details")]
    failure: Option<(InFlight, Failure)>,
    /// What a call has told last while it runs: it waits in the same room, and makes way for a reply.
    #[cfg(feature = "details")]
    reported: Option<(InFlight, usize)>,
}

impl ReplyBox {
    pub(crate) fn new(bytes: &'static mut [u8]) -> Self {
        Self {
            bytes,
            held: None,
            #[cfg(feature = "details")]
            failure: None,
            #[cfg(feature = "details")]
            reported: None,
        }
    }

    pub(crate) fn is_taken(&self) -> bool {
        self.held.is_some()
    }

    pub(crate) fn put(&mut self, call: InFlight, block: &[u8]) -> Result<(), Error> {
        let limit = self.bytes.len();
        if block.len() > limit {
            return Err(Error::TooLarge { limit: u32::try_from(limit).unwrap_or(u32::MAX) });
        }
        self.held = Some((call, copy(block, self.bytes)));
        #[cfg(feature = "details")]
        {
            self.reported = None;
        }
        Ok(())
    }

    #[cfg(feature = "details")]
    fn notify(&mut self, call: InFlight, block: &[u8]) {
        if self.held.is_none() && block.len() <= self.bytes.len() {
            self.reported = Some((call, copy(block, self.bytes)));
        }
    }

    #[cfg(feature = "details")]
    pub(crate) fn take_reported(&mut self, call: &InFlight) -> Option<&[u8]> {
        let (_, length) = self.reported.take_if(|(reported, _)| reported == call)?;
        self.bytes.get(..length)
    }

    #[cfg(feature = "details")]
    pub(crate) fn take_failure(&mut self, call: &InFlight) -> Option<Failure> {
        self.failure.take_if(|(failed, _)| failed == call).map(|(_, failure)| failure)
    }

    pub(crate) fn take(&mut self, call: &InFlight) -> Option<&[u8]> {
        let (_, length) = self.held.take_if(|(held, _)| held == call)?;
        self.bytes.get(..length)
    }
}

/// Keeps what a call has told for the task that waits for it, if that is what happened and there is one.
#[cfg(feature = "details")]
pub(crate) fn reported(link: &mut Link, reply: &mut ReplyBox, event: &Event, lent: &[u8]) {
    let Event::Progress(id, values) = event else { return };
    let (serial, session) = (link.serial, &link.session);
    let mut waiting = link.waiters.iter_mut().chain(&mut link.urgent).flatten();
    let Some(waiter) = waiting.find(|waiter| waiter.call.serial == serial && waiter.call.id == *id) else { return };
    if let Some(Ok(block)) = session.as_ref().map(|session| session.progress_values(values, lent)) {
        reply.notify(waiter.call, block.bytes());
        waiter.wake();
    }
}

/// The function that a call is of, as long as it is the one that was called.
pub(crate) fn called<'l>(links: &'l [Link], call: &InFlight) -> Option<Signature<'l>> {
    let link = links.get(usize::from(call.link)).filter(|link| link.serial == call.serial)?;
    let function = link.session.as_ref()?.their_function_list().function(call.slot)?;
    (function.generation == call.generation).then_some(function.signature)
}

/// Stores the outcome of a call for the task that waits for it, if that is what happened and there is one.
pub(crate) fn ended(link: &mut Link, reply: &mut ReplyBox, event: &Event, lent: &[u8]) {
    let Event::Reply(id, outcome) = event else { return };
    // Before anything else: it lies in what was lent.
    #[cfg(feature = "details")]
    let failure = outcome.is_err().then(|| link.session.as_mut()?.failure(lent)).flatten();
    let (serial, session) = (link.serial, &link.session);
    let mut waiting = link.waiters.iter_mut().chain(&mut link.urgent).flatten();
    if let Some(waiter) = waiting.find(|waiter| waiter.call.serial == serial && waiter.call.id == *id) {
        let session = session.as_ref().ok_or(Error::ResultLost);
        let results = outcome.and_then(|results| session?.results(&results, lent));
        #[cfg(feature = "details")]
        if let Some(failure) = failure {
            reply.failure = Some((waiter.call, failure));
        }
        waiter.end(results.and_then(|block| reply.put(waiter.call, block.bytes())));
    }
}
