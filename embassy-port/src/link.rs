//! One link, and the tasks that wait for replies on it.

use core::task::Waker;

use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::identity::Identity;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::services::session::SessionStorage;
use cara_core::storage::Lent;
use cara_core::time::Instant;

use crate::port::LinkSession;

/// Emergencies that tasks may wait for on a link whose calls are all in flight.
pub(crate) const EMERGENCIES: usize = 2;

/// One link: the session while it is open, its memory while it is not.
pub(crate) struct Link {
    pub(crate) session: Option<LinkSession>,
    pub(crate) storage: Option<SessionStorage<Lent>>,
    /// Tells this link from an earlier one with the same index.
    pub(crate) serial: u32,
    /// When it was opened.
    pub(crate) since: Instant,
    pub(crate) waiters: &'static mut [Option<Waiter>],
    /// Places of emergencies, where the others are taken.
    pub(crate) urgent: [Option<Waiter>; EMERGENCIES],
    /// The serial of the list that was last sent to the peer, for tasks that wait until it is read.
    pub(crate) reported: Option<u32>,
}

impl Link {
    pub(crate) fn new(storage: SessionStorage<Lent>, waiters: &'static mut [Option<Waiter>]) -> Self {
        let urgent = [const { None }; EMERGENCIES];
        Self {
            session: None,
            storage: Some(storage),
            serial: 0,
            since: Instant::START,
            waiters,
            urgent,
            reported: None,
        }
    }

    /// The peer, from joining to leaving.
    pub(crate) fn peer(&self) -> Option<&Identity> {
        self.session.as_ref().and_then(LinkSession::peer)
    }

    /// Whether it leads to a peer that requests can be made of.
    pub(crate) fn is_live(&self) -> bool {
        self.session.as_ref().is_some_and(LinkSession::is_live)
    }

    /// The places of calls that tasks wait for.
    pub(crate) fn places(&mut self) -> impl Iterator<Item = &mut Option<Waiter>> {
        self.waiters.iter_mut().chain(&mut self.urgent)
    }

    /// The calls that tasks wait for.
    pub(crate) fn waiting(&self) -> impl Iterator<Item = &Waiter> {
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

/// A task that waits for a reply.
pub(crate) struct Waiter {
    pub(crate) call: InFlight,
    pub(crate) waker: Option<Waker>,
    /// How the call ended; with `Ok`, its results are in the box.
    pub(crate) outcome: Option<Result<(), Error>>,
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

impl Waiter {
    pub(crate) fn end(&mut self, outcome: Result<(), Error>) {
        if self.outcome.is_none() {
            self.outcome = Some(outcome);
            self.wake();
        }
    }

    pub(crate) fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }
}
