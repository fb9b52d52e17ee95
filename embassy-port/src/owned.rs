//! Calls that values of tasks stand for, such as a hold, and what becomes of those that are dropped while the machine is in use:
//! executors on the heap drop a task with its last waker, which the machine may have.
//!
//! Each such call has a place outside of the machine, where its value marks it. So none is lost, however many are dropped at once.

use cara_core::config::LEASES;
use cara_core::services::requests::CallId;
use cara_core::services::{Port as _, Ticket};
use core::cell::Cell;

use crate::link::{EMERGENCIES, InFlight, Link};
use crate::machine::Machine;
use crate::port::Board;
use crate::task_slots::Running;
use crate::time::now;

/// Names a call of a link, also of one that has ended.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Owned {
    pub(crate) serial: u32,
    pub(crate) id: u32,
    /// That of its ticket, or [`MADE`]; and [`DROPPED`].
    index: u16,
}

/// This unit has made it. No link has so many places for calls of its peer.
const MADE: u16 = 0x7FFF;
/// Its value was dropped while the machine was in use.
const DROPPED: u16 = 0x8000;

impl Owned {
    pub(crate) const fn made(call: &InFlight) -> Self {
        Self { serial: call.serial, id: call.id.0, index: MADE }
    }

    pub(crate) const fn taken(call: &Running) -> Self {
        let (index, id) = call.ticket.parts();
        Self { serial: call.serial, id, index }
    }
}

/// Where one call is marked.
pub(crate) type Place = Cell<Owned>;

/// A place that nothing needs: no call has this id.
#[expect(clippy::declare_interior_mutable_const, reason = "arrays are made of it")]
pub(crate) const FREE: Place = Cell::new(Owned { serial: 0, id: 0, index: MADE });

/// The places of a link: for as many calls as can be in flight, run here, or hold something at the peer.
pub(crate) struct Places {
    calls: &'static [Place],
    others: [Place; EMERGENCIES + LEASES],
}

impl Places {
    /// With two for each of [`Limits::calls`](crate::Limits::calls).
    pub(crate) const fn new(calls: &'static [Place]) -> Self {
        Self { calls, others: [FREE; EMERGENCIES + LEASES] }
    }

    fn all(&self) -> impl Iterator<Item = &Place> {
        self.calls.iter().chain(&self.others)
    }

    /// Marks a call whose value was dropped. One that has no place any more is over.
    pub(crate) fn mark(&self, call: Owned) {
        if let Some(place) = self.all().find(|place| place.get() == call) {
            place.set(Owned { index: call.index | DROPPED, ..call });
        }
    }

    /// A call that was marked: one of this unit's, or one that a task had taken.
    fn take_marked(&self, is_made: bool) -> Option<Owned> {
        let marked = |place: &&Place| {
            let index = place.get().index;
            index & DROPPED != 0 && (index == MADE | DROPPED) == is_made
        };
        let place = self.all().find(marked)?;
        let call = Owned { index: place.get().index & MADE, ..place.get() };
        place.set(call);
        Some(call)
    }
}

impl Link {
    /// Whether something is to be done when the value of this call is dropped.
    fn needs(&self, call: Owned) -> bool {
        let session = self.session.as_ref().filter(|_| self.serial == call.serial);
        match call.index & MADE {
            MADE if !Board::CALLS => false,
            // A task that waits has a place to give back, also when its link has ended.
            MADE if self.waiting().any(|waiter| Owned { index: call.index, ..Owned::made(&waiter.call) } == call) => {
                true
            }
            MADE => session.is_some_and(|session| session.may_hold(CallId(call.id))),
            index => session.is_some_and(|session| !session.is_answered(Ticket::of(index, call.id))),
        }
    }
}

impl<T> Machine<T> {
    /// A value stands for this call from now on. There is a place: what needs one is bounded by the session's own tables.
    #[inline(never)]
    pub(crate) fn own(&self, link: u16, call: Owned) {
        let Some((link, places)) = self.link(link).zip(self.places.get(usize::from(link))) else { return };
        if let Some(place) = places.all().find(|place| !link.needs(place.get())) {
            place.set(call);
        }
    }

    /// Gives up this unit's calls whose values were dropped.
    pub(crate) fn give_up_marked(&mut self) {
        let places = self.places;
        for (index, places) in self.indices().zip(places) {
            while let Some(call) = places.take_marked(true) {
                self.give_up(index, call);
            }
        }
    }

    /// Answers taken calls whose values were dropped. What there is no room for waits as long as a call may take.
    pub(crate) fn drop_marked(&mut self) {
        let places = self.places;
        for (link, places) in self.indices().zip(places) {
            while let Some(Owned { serial, id, index }) = places.take_marked(false) {
                let deadline = now() + self.hub.node.constraints().request_timeout;
                self.drop_taken(&Running { link, serial, ticket: Ticket::of(index, id), deadline });
            }
        }
    }
}
