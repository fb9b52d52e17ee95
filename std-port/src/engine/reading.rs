//! Carries out what the policy of a link's reader asks for ([`ReadPolicy::on`](super::reader::ReadPolicy::on)): the token,
//! the wake-up of a caller, the registration with epoll, and the clock's looks.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use cara_core::time::Instant;

use super::link::{LinkCell, LinkState};
use super::links::Links;
use super::reader::{Cause, LOOK, RELIEF, Token};
use super::watch::next_look;
use crate::locks::Locked;
use crate::sys::epoll::{Interest, Trigger};

impl Links {
    /// Something happens that may change which thread reads the link. The token, if the thread that asked for it gets it.
    pub(crate) fn read_by(&self, now: Instant, link: &LinkCell, state: &mut LinkState, cause: Cause) -> Option<Token> {
        let duties = state.reading.on(now, cause);
        if let Some(id) = duties.wake {
            state.wake(id);
        }
        match duties.look_at {
            None => {}
            // A link on the list has the clock come back by itself.
            Some(at) if !duties.enlist => self.put_off_look(now, at),
            Some(_) if self.driver.is_stopping() => {}
            Some(_) => {
                // Before the clock is told: it reads the list when it is.
                self.watch.enlist(link.token());
                self.driver.pool().watched.fetch_add(1, Ordering::Relaxed);
                self.begin_watch();
            }
        }
        duties.token
    }

    /// Keeps the epoll registration in step with which thread reads, and whether bytes wait to be written.
    pub(super) fn set_interest(&self, link: &LinkCell, state: &mut LinkState) {
        let before = state.registration;
        let wanted = state.reading.registration(before, state.is_paused(), state.session.wants_to_write());
        if before == wanted {
            return;
        }
        state.registration = wanted;
        let interest = Interest { readable: wanted.readable, writable: wanted.writable, trigger: Trigger::Edge };
        // A descriptor that cannot be watched is one whose link has ended.
        let set = match (before.is_out, wanted.is_out) {
            (false, true) => self.driver.pool().epoll.remove(&link.stream),
            (true, false) => self.driver.pool().epoll.add(&link.stream, link.token(), interest),
            _ => self.driver.pool().epoll.modify(&link.stream, link.token(), interest),
        };
        if set.is_err() {
            state.registration.is_out = false;
        }
    }

    /// The clock is to look at links, until nothing happens there any more.
    pub(super) fn begin_watch(&self) {
        if self.watch.begins() {
            self.driver.wake();
        }
    }

    /// Ends what takes too long on the links of the clock's list; returns when to look again. The unit's `others` are due
    /// then.
    pub(super) fn look(
        &self,
        others: Instant,
        settle: impl for<'l> Fn(&'l Arc<LinkCell>, Locked<'l, LinkState>),
    ) -> Instant {
        self.watch.set_next(Instant::FAR_FUTURE, others);
        if !self.watch.is_on() {
            return Instant::FAR_FUTURE;
        }
        let now = self.driver.clock().now();
        let again = self.watch.look(|token| {
            let stays = self.of_token(token).is_some_and(|link| look_at_link(now, &link, &settle));
            self.driver.pool().watched.fetch_sub(usize::from(!stays), Ordering::Relaxed);
            stays
        });
        self.driver.pool().wake_for_waiting();
        if !self.driver.pool().relieve(now, RELIEF) && !again {
            return Instant::FAR_FUTURE;
        }
        self.watch.go_on();
        let next = next_look(now);
        self.watch.set_next(next, others);
        next
    }

    /// The clock need look at a link before `at` no more. Where it looks at no other link, its next look is put off: a
    /// wake-up every 2 ms would be in the way of each hundredth call.
    fn put_off_look(&self, now: Instant, at: Instant) {
        let look = self.watch.next();
        if look >= now + LOOK.divided_by(2)
            || self.driver.pool().watched.load(Ordering::Relaxed) != 1
            || !self.driver.pool().has_idle()
            || self.driver.pool().has_waiting()
        {
            return;
        }
        let Some(unit_number) = self.driver.unit_number() else { return };
        let due = || self.next_due().min(self.watch.others()).min(self.driver.alarms.next());
        if let Some(at) = self.driver.pool().put_off(unit_number, look, || due().min(at)) {
            self.watch.put_off(look, at);
        }
    }
}

/// Whether the link remains on the clock's list.
fn look_at_link(
    now: Instant,
    link: &Arc<LinkCell>,
    settle: impl for<'l> Fn(&'l Arc<LinkCell>, Locked<'l, LinkState>),
) -> bool {
    // The thread that has the lock is its reader, which is back.
    let Some(mut state) = link.try_lock() else { return true };
    let waiter = state.next_reader();
    let duties = state.reading.on(now, Cause::Looks { waiter });
    if let Some(id) = duties.wake {
        state.wake(id);
    }
    if duties.look_at.is_none() {
        settle(link, state);
    }
    duties.look_at.is_some()
}
