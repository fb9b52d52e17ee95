//! Replies on their way to the tasks that wait for them.
//!
//! A task's parameters cannot be written by the runner, so a reply waits in one box until the task has read it. While
//! the box is taken, links with callers are not read: the network keeps what follows, and nothing is lost.

use core::task::Waker;

use cara_core::config::Priority;
use cara_core::distribution::block;
#[cfg(feature = "details")]
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::Signature;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::services::session::Event;
use cara_core::time::Instant;

use crate::line::copy;
use crate::machine::{Link, Machine};

/// A task that waits for a reply.
pub(crate) struct Waiter {
    pub(crate) call: InFlight,
    waker: Option<Waker>,
    /// How the call ended; with `Ok`, its results are in the box.
    outcome: Option<Result<(), Error>>,
}

/// Names a call of this unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InFlight {
    pub(crate) link: u16,
    pub(crate) serial: u32,
    pub(crate) id: CallId,
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    /// The caller waits for the reply until then.
    pub(crate) deadline: Instant,
}

/// Room for the results of one call.
pub(crate) struct ReplyBox {
    bytes: &'static mut [u8],
    held: Option<(InFlight, usize)>,
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

    fn put(&mut self, call: InFlight, block: &[u8]) -> Result<(), Error> {
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
    fn take_reported(&mut self, call: &InFlight) -> Option<&[u8]> {
        let (_, length) = self.reported.take_if(|(reported, _)| reported == call)?;
        self.bytes.get(..length)
    }

    #[cfg(feature = "details")]
    pub(crate) fn take_failure(&mut self, call: &InFlight) -> Option<Failure> {
        self.failure.take_if(|(failed, _)| failed == call).map(|(_, failure)| failure)
    }

    fn take(&mut self, call: &InFlight) -> Option<&[u8]> {
        let (_, length) = self.held.take_if(|(held, _)| held == call)?;
        self.bytes.get(..length)
    }
}

impl Link {
    /// The places of calls that tasks wait for.
    fn places(&mut self) -> impl Iterator<Item = &mut Option<Waiter>> {
        self.waiters.iter_mut().chain(&mut self.urgent)
    }

    /// The calls that tasks wait for.
    fn waiting(&self) -> impl Iterator<Item = &Waiter> {
        self.waiters.iter().chain(&self.urgent).flatten()
    }

    /// Whether a task waits for a reply on this link.
    pub(crate) fn awaits_reply(&self) -> bool {
        self.waiting().any(|waiter| waiter.call.serial == self.serial && waiter.outcome.is_none())
    }

    /// Ends all calls of the link that have not ended.
    pub(crate) fn interrupt(&mut self) {
        let serial = self.serial;
        for waiter in self.places().flatten().filter(|waiter| waiter.call.serial == serial) {
            waiter.end(Err(Error::Interrupted));
        }
    }
}

impl Waiter {
    fn end(&mut self, outcome: Result<(), Error>) {
        if self.outcome.is_none() {
            self.outcome = Some(outcome);
            self.wake();
        }
    }

    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
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
fn called<'l>(links: &'l [Link], call: &InFlight) -> Option<Signature<'l>> {
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

impl<T> Machine<T> {
    /// Whether there is a place for a call that is about to be made; an emergency has some where the others are taken.
    pub(crate) fn can_wait(&self, link: u16, function: &str, class: Option<Priority>) -> bool {
        let Some(link) = self.link(link) else { return false };
        let is_urgent = || {
            let function = link.session.as_ref().and_then(|session| session.their_function_list().named(function));
            let attributes = function.map(|function| function.attributes);
            attributes.is_some_and(|attributes| attributes.is_urgent(class.unwrap_or(attributes.priority)))
        };
        link.waiters.iter().any(Option::is_none) || link.urgent.iter().any(Option::is_none) && is_urgent()
    }

    pub(crate) fn wait(&mut self, call: InFlight) {
        let link = self.link_mut(call.link);
        if let Some(place) = link.and_then(|link| link.places().find(|place| place.is_none())) {
            *place = Some(Waiter { call, waker: None, outcome: None });
        }
    }

    /// How a call ended, its results in `parameters`; `None` while it goes on, and `waker` is woken then.
    pub(crate) fn outcome(
        &mut self,
        call: &InFlight,
        parameters: &mut ParametersView,
        waker: &Waker,
    ) -> Option<Result<(), Error>> {
        let link = self.links.get_mut(usize::from(call.link))?;
        let place = link.places().find(|place| place.as_ref().is_some_and(|waiter| waiter.call == *call));
        let Some(place) = place else { return Some(Err(Error::Interrupted)) };
        let waiter = place.as_mut()?;
        let Some(outcome) = waiter.outcome else {
            waiter.waker = Some(waker.clone());
            return None;
        };
        *place = None;
        self.wakers.runner.wake();
        Some(outcome.and_then(|()| self.read(call, parameters)))
    }

    fn read(&mut self, call: &InFlight, parameters: &mut ParametersView) -> Result<(), Error> {
        let Self { links, reply, .. } = self;
        let bytes = reply.take(call).ok_or(Error::ResultLost)?;
        block::read(called(links, call).ok_or(Error::ResultLost)?.results(), bytes, parameters)
    }

    /// Reads what a call has told last into `values`, once; `false` when there is nothing new, no room for it, or when the call
    /// has ended.
    #[cfg(feature = "details")]
    pub(crate) fn take_reported(&mut self, call: &InFlight, values: &mut ParametersView) -> bool {
        let Self { links, reply, .. } = self;
        let continues = |waiter: &Waiter| waiter.call == *call && waiter.outcome.is_none();
        let link = links.get(usize::from(call.link));
        let continues = link.is_some_and(|link| link.waiting().any(continues));
        let (reported, called) = (reply.take_reported(call), called(links, call).filter(|_| continues));
        reported.zip(called).is_some_and(|(bytes, called)| block::read(called.progress(), bytes, values).is_ok())
    }

    /// Nothing waits for a call any more, and what it started is not wanted.
    pub(crate) fn give_up(&mut self, call: &InFlight) {
        let Some(link) = self.links.get_mut(usize::from(call.link)) else { return };
        for place in link.places() {
            place.take_if(|waiter| waiter.call == *call);
        }
        if link.serial == call.serial {
            self.with(call.link, |session, cx| session.cancel(cx, call.id));
        }
        let _ = self.reply.take(call);
        self.wakers.runner.wake();
    }

    /// A reply that its task has not fetched by its deadline makes room for others.
    pub(crate) fn expire_reply(&mut self, now: Instant) {
        let Some((call, _)) = self.reply.held.filter(|(call, _)| call.deadline <= now) else { return };
        self.reply.held = None;
        let link = self.links.get_mut(usize::from(call.link));
        let mut waiters = link.into_iter().flat_map(|link| link.places().flatten());
        if let Some(waiter) = waiters.find(|waiter| waiter.call == call) {
            waiter.outcome = Some(Err(Error::TimedOut));
        }
    }

    /// When that is due.
    pub(crate) fn reply_deadline(&self) -> Instant {
        self.reply.held.map_or(Instant::FAR_FUTURE, |(call, _)| call.deadline)
    }
}
