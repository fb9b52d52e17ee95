//! Tasks that wait for replies, as the machine of their unit has them.

use core::task::Waker;

use cara_core::config::Priority;
use cara_core::distribution::block;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::time::Instant;

use crate::link::{InFlight, Waiter};
use crate::machine::Machine;
use crate::owned::Owned;
use crate::replies::called;

impl<T> Machine<T> {
    /// Whether there is capacity for a call that is about to be made; some is reserved for emergencies.
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
    pub(crate) fn give_up(&mut self, index: u16, call: Owned) {
        let Some(link) = self.link_mut(index) else { return };
        for place in link.places() {
            place.take_if(|waiter| Owned::made(&waiter.call) == call);
        }
        if link.serial == call.serial {
            self.with(index, |session, cx| session.cancel(cx, CallId(call.id)));
        }
        self.reply.held.take_if(|(held, _)| held.link == index && Owned::made(held) == call);
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
