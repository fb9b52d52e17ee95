//! Giving a link's lock up: whatever a thread has done under it, the session is polled, its timer and its registration with
//! epoll are set, and what happened is acted upon.

use std::sync::Arc;
use std::task::Waker;

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::Ticket;
use cara_core::services::session::Event;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::services;
use super::tape::OFFERS;
use crate::locks::Locked;

/// A link on which reading is paused is looked at again after this.
pub(super) const RETRY: Duration = Duration::from_millis(1);

impl<T: Send + 'static> Engine<T> {
    /// Polls the session as far as something is due, sets its timer and epoll interest, gives the lock up, and acts on
    /// what happened.
    pub(crate) fn settle<'l>(&self, link: &'l Arc<LinkCell>, guard: Locked<'l, LinkState>) {
        self.settle_at(self.now(), link, guard);
    }

    pub(super) fn settle_at<'l>(&self, now: Instant, link: &'l Arc<LinkCell>, mut guard: Locked<'l, LinkState>) {
        let state = &mut *guard;
        self.dispatch_emergencies(link, state);
        // Before the poll, which looks for values: so a value that is published meanwhile is noticed by one of the two.
        link.note_subscriptions(state.session.subscriptions() > 0);
        let mut deadline = state.session.deadline();
        if deadline <= now {
            self.poll_session(link, state);
            deadline = state.session.deadline();
        }
        if !state.details.progress.is_empty() {
            for (ticket, values) in std::mem::take(&mut state.details.progress) {
                // Its errors were returned to the handler when it was new.
                let _ = self.send_progress(now, link, state, ticket, &values);
            }
            deadline = state.session.deadline();
        }
        self.set_timer(now, deadline, link, state);
        self.links.set_interest(link, state);
        let woken = std::mem::take(&mut state.woken);
        if state.notices.begin() {
            self.act(link, guard);
        } else {
            drop(guard);
        }
        woken.into_iter().for_each(Waker::wake);
    }

    /// Tells the peer how far its call is, or keeps that until there is room for it.
    pub(super) fn send_progress(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        ticket: Ticket,
        values: &ParametersView,
    ) -> Result<(), Error> {
        let reported =
            self.with_at(now, link, state, |session, cx| session.unrecorded(OFFERS).progress(cx, ticket, values));
        state.details.keep_progress(ticket, values, reported)
    }

    pub(super) fn poll_session(&self, link: &Arc<LinkCell>, state: &mut LinkState) {
        loop {
            let event = self.with(link, state, |session, cx| session.poll(cx));
            match event {
                None => return,
                #[cfg(feature = "async")]
                Some(Event::Cancelled(ticket)) => state.wake_serving(ticket),
                Some(Event::Reply(id, outcome)) => {
                    // Results come with what was read alone.
                    state.fail(id, outcome.err().unwrap_or(Error::ResultLost));
                }
                Some(event) => {
                    if let Event::Closed(_) = event {
                        link.stream.shutdown();
                        link.room.notify_all();
                        state.wake_all();
                    }
                    self.note(state, event);
                }
            }
        }
    }

    /// An event that is acted upon when the lock is given up; only what waits for the end of a lease is woken before.
    pub(super) fn note(&self, state: &mut LinkState, event: Event) {
        if let Event::LeaseExpired(slot) = event {
            services::wake_leased(&self.services.functions(), slot);
        }
        state.notices.push(event);
    }

    fn set_timer(&self, now: Instant, mut deadline: Instant, link: &LinkCell, state: &mut LinkState) {
        if state.is_paused() {
            deadline = deadline.min(now + RETRY);
        }
        // A timer that is early does no harm: it is set again when it comes.
        if deadline < state.timer {
            state.timer = deadline;
            if self.links.set_timer(link.id, deadline) {
                self.driver.wake_at(deadline);
            }
        }
    }

    /// Gives up a link's lock and acts on what happened under it. What happens meanwhile is left to the thread that is
    /// acting on earlier things.
    fn act<'l>(&self, link: &'l Arc<LinkCell>, mut state: Locked<'l, LinkState>) {
        if !state.notices.begin() {
            return;
        }
        while let Some(notices) = state.notices.next() {
            drop(state);
            notices.into_iter().for_each(|event| self.act_on(link, event));
            state = link.lock();
        }
    }
}
