//! Leases that this unit's calls hold at the peer: renewed while somebody wants the motion, then released (docs/safety.md).
//!
//! A call *holds* a lease while this unit renews it. It is *released* when it fails or its caller *cancels* it: the peer is
//! notified, whether the call is in flight, queued or running there. A release is retried until the stream has taken it.

use super::due::Part;
use super::wire::{Phase, Wire};
use super::{Event, RequestOptions, Session};
use crate::ability::DETAILS;
use crate::config::{LEASES, Priority};
use crate::distribution::function_list::Slot;
use crate::distribution::message::{Release, Renewal, RequestHeader, SessionBody};
use crate::error::{Error, Limit};
use crate::host::connections::LinkCounter;
use crate::host::frame::Frame;
use crate::services::heart::{Beats, Renew};
use crate::services::lease::{Held, LeaseEnd};
use crate::services::requests::{CallId, Pending, Requests};
use crate::services::{Context, Port};
use crate::storage::take_at;
use crate::time::{Duration, Instant};

/// Renewals per length of a lease: a few lost ones do not end it.
const RENEWALS_PER_LEASE: u64 = 4;
/// Least number of beats of a heart in the length of a lease.
const BEATS_PER_LEASE: u64 = 2;
/// Least interval between renewals, as for a lease of 20 ms. A peer may publish a shorter lease, whose renewals would flood the
/// network: it ends before it is renewed.
const SHORTEST_INTERVAL: Duration = Duration::from_millis(5);
/// How soon a release that the stream had no capacity for is retried, unless the stream becomes writable earlier.
const RETRY: Duration = Duration::from_millis(20);

/// Releases of whole functions that are not in the stream yet: the function, and the newest call that is released.
type Releases = heapless::Vec<(Slot, CallId), LEASES>;

/// Answered calls of leased functions whose lease the peer has not ended. Needed to release them, whether renewed or not.
type Answered = heapless::Vec<AnsweredCall, LEASES>;

#[derive(Clone, Copy)]
struct AnsweredCall {
    call: CallId,
    slot: Slot,
    class: Priority,
}

fn between_renewals(lease: Duration) -> Duration {
    lease.divided_by(RENEWALS_PER_LEASE).max(SHORTEST_INTERVAL)
}

/// This unit's calls to the peer: those that wait for a reply, and the leases that they hold there.
pub(super) struct Calling<P: Port> {
    pub(super) requests: Requests<P::Storage>,
    pub(super) held: heapless::Vec<Held, LEASES>,
    answered: Answered,
    releases: Releases,
    /// The newest call of a function with a lease.
    pub(super) last_order: Option<(Slot, CallId)>,
}

impl<P: Port> Session<P> {
    /// Whether an answered call may hold a lease at the peer, so that [`cancel`](Self::cancel) releases it.
    pub fn may_hold(&self, call: CallId) -> bool {
        self.calling.answered.iter().any(|known| known.call == call) || self.calling.holds(call)
    }
}

impl<P: Port> Calling<P> {
    pub(super) const fn new(requests: Requests<P::Storage>) -> Self {
        Self {
            requests,
            held: heapless::Vec::new(),
            answered: Answered::new(),
            releases: Releases::new(),
            last_order: None,
        }
    }

    /// Times out one call whose deadline has passed.
    pub(super) fn expire_call(&mut self, wire: &mut Wire<P>, now: Instant) -> Option<Pending> {
        let expired = self.requests.expire(now);
        if expired.is_none() {
            wire.due.set(Part::Calls, self.requests.deadline());
        }
        expired
    }

    /// Whether this unit is renewing the lease of a call.
    pub(super) fn holds(&self, call: CallId) -> bool {
        self.held.iter().any(|held| held.call == call && held.is_renewed())
    }

    /// Whether it is renewing that of any.
    pub(super) fn renews(&self) -> bool {
        self.held.iter().any(Held::is_renewed)
    }

    /// How much of a function's leases is left, counted from the last answer to a renewal; `None` if none is renewed.
    pub(super) fn lease_left(&self, now: Instant, slot: Slot) -> Option<Duration> {
        let of_slot = self.held.iter().filter(|held| held.slot == slot && held.is_renewed());
        of_slot.map(|held| (held.answered + held.length()).since(now)).max()
    }

    /// Whether a call of this function could be renewed. [`Error::Full`] if the table is full and has neither an earlier call of the
    /// same function and origin nor a release that waits to be sent, to replace; [`Error::SlowHeart`] if the heart's period is longer
    /// than half of the lease.
    pub(super) fn check_held(&self, lease: Duration, options: &RequestOptions, slot: Slot) -> Result<(), Error> {
        let slowest = lease.divided_by(BEATS_PER_LEASE);
        if let Renew::Heart(beats) = options.renew
            && beats.period() > slowest
        {
            let [need, have] = [slowest, beats.period()].map(|span| span.as_millis() as u32);
            return Err(Error::SlowHeart { need, have });
        }
        let fits = !self.held.is_full() || self.replaceable(slot, options.operator).is_some();
        if fits { Ok(()) } else { Err(Error::Full(Limit::Leases)) }
    }

    /// What gives its place to a new call: the oldest renewed call of the function, where an operator's calls and the program's do not
    /// replace each other, or else a release that has yet to be sent and can be kept elsewhere.
    fn replaceable(&self, slot: Slot, operator: bool) -> Option<usize> {
        let can_go = |held: &Held| {
            if held.is_renewed() { held.slot == slot && held.operator == operator } else { self.can_keep(held.slot) }
        };
        let replaceable = self.held.iter().enumerate().filter(|(_, held)| can_go(held));
        replaceable.min_by_key(|(_, held)| (!held.is_renewed(), held.call)).map(|(index, _)| index)
    }

    /// Renews the lease of a call from now on; the call itself may not have begun.
    pub(super) fn hold_lease(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        header: &RequestHeader,
        class: Priority,
        lease: Duration,
        renew: Renew,
    ) {
        // Replace another one and do not refuse: the new call may be one that stops what the earlier calls started.
        if self.held.is_full()
            && let Some(index) = self.replaceable(header.slot, header.operator)
            && let Some(replaced) = take_at(&mut self.held, index)
        {
            if replaced.is_renewed() {
                wire.link.counters.count(LinkCounter::RenewalsStopped);
            } else {
                // Its function's earlier calls are released with it.
                let _ = self.keep_release(replaced.slot, replaced.call);
            }
        }
        let (call, slot, next) = (CallId(header.id), header.slot, cx.now + between_renewals(lease));
        let (answered, operator) = (cx.now, header.operator);
        let lease = u32::try_from(lease.as_millis()).unwrap_or(u32::MAX);
        let _ = self.held.push(Held { call, slot, operator, class, lease, renew, next, answered });
        wire.due.hasten(Part::Renewals, next);
    }

    /// Sends the renewals that are due. A lease whose renewals the peer has not answered for the length of the lease is
    /// released instead, and returned, one in each call.
    pub(super) fn renew_leases(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Option<Event> {
        let (stamp, since) = wire.clock.stamp(cx.now);
        let now = cx.now;
        for index in 0..self.held.len() {
            let due = self.held.get_mut(index).filter(|held| held.next <= now);
            let Some(held) = due else { continue };
            let length = held.length();
            if held.answered + length <= now {
                let Held { call, slot, .. } = *held;
                wire.link.counters.count(LinkCounter::RenewalsUnanswered);
                self.release_call(wire, cx, call, None);
                return Some(Event::LeaseEnded { call, slot, why: LeaseEnd::Unanswered });
            }
            held.next = now + between_renewals(length);
            // A heart that has not beaten within the lease renews nothing. The peer decides whether a later beat is too late.
            let Some(age) = held.renew.age(now).filter(|age| *age < length) else { continue };
            let renewal = Renewal { call: held.call.0, class: held.class, stamp, since, age };
            let body = SessionBody::renewal(&renewal);
            // By datagram and in the stream: neither a lost datagram nor a retransmission in the stream may stop a vehicle.
            wire.send_datagram(cx, &body, &[]);
            wire.link.send_frame(&Frame::Session(&body));
        }
        let next = self.held.iter().map(|held| held.next).min();
        wire.due.set(Part::Renewals, next.unwrap_or(Instant::FAR_FUTURE));
        wire.flush(cx);
        None
    }

    /// Notes an answer to a renewal.
    pub(super) fn was_renewed(&mut self, now: Instant, call: CallId) {
        if let Some(held) = self.held.iter_mut().find(|held| held.call == call) {
            held.answered = now;
        }
    }

    /// A heart has stopped: releases the calls that name it.
    pub(super) fn release_beats(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, beats: Beats) {
        let of_it = |held: &&Held| held.renew == Renew::Heart(beats) && held.is_renewed();
        while let Some(call) = self.held.iter().find(of_it).map(|held| held.call) {
            self.release_call(wire, cx, call, None);
        }
    }

    /// Notes that the peer has answered a call with results.
    pub(super) fn note_answered(&mut self, pending: &Pending) {
        let Pending { id: call, slot, leased: Some(class), .. } = *pending else { return };
        // The peer reports the end of each lease, and refuses calls beyond its own table, so the oldest entry is obsolete.
        if self.answered.is_full() {
            let oldest = self.answered.iter().enumerate().min_by_key(|(_, known)| known.call);
            oldest.map(|(index, _)| index).and_then(|index| take_at(&mut self.answered, index));
        }
        let _ = self.answered.push(AnsweredCall { call, slot, class });
    }

    #[inline(never)]
    fn take_answered(&mut self, call: CallId) -> Option<AnsweredCall> {
        let index = self.answered.iter().position(|known| known.call == call)?;
        take_at(&mut self.answered, index)
    }

    /// Forgets a call whose lease the peer has ended.
    pub(super) fn stop_renewing(&mut self, call: CallId) -> Option<Held> {
        self.take_answered(call);
        let index = self.held.iter().position(|held| held.call == call && held.is_renewed())?;
        take_at(&mut self.held, index)
    }

    /// Forgets a call, whether it is renewed or its release waits already. Returns its function and class.
    fn forget(&mut self, call: CallId) -> Option<(Slot, Priority)> {
        let answered = self.take_answered(call).map(|known| (known.slot, known.class));
        let index = self.held.iter().position(|held| held.call == call);
        let held = index.and_then(|index| take_at(&mut self.held, index));
        held.map(|held| (held.slot, held.class)).or(answered)
    }

    /// Gives a call up for its caller.
    pub(super) fn cancel(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, id: CallId) {
        let pending = self.requests.close(id);
        if let Some(pending) = &pending {
            // The caller may have noticed the time-out before this session was polled.
            let is_late = pending.deadline <= cx.now;
            let counter = if is_late { LinkCounter::CallsTimedOut } else { LinkCounter::CallsCancelled };
            wire.link.counters.count(counter);
            Self::send_cancel(wire, cx, pending);
        }
        self.release_call(wire, cx, id, pending);
    }

    /// As [`cancel`](Self::cancel), but leaves the call open for its answer.
    pub(super) fn cancel_but_wait(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, id: CallId) {
        let Some(&pending) = self.requests.waiting_for(id) else { return };
        Self::send_cancel(wire, cx, &pending);
        let Some(class) = pending.leased else { return };
        self.forget(id);
        if !Self::send_release(wire, cx, id, class) {
            self.keep_unsent(wire, cx.now, id, pending.slot, class);
        }
    }

    /// Tells the peer that a call has no caller any more. Sent once, in the stream only: the release ends motion, and is retried.
    pub(super) fn send_cancel(wire: &mut Wire<P>, cx: &mut Context<'_, P>, pending: &Pending) {
        // A stop cannot be withdrawn: its handler runs, however late.
        let stops = wire.theirs.function(pending.slot).is_some_and(|function| function.attributes.stop);
        if DETAILS && wire.phase == Phase::Live && !stops {
            let body = SessionBody::cancel(&Release { call: pending.id.0, class: pending.class });
            wire.link.send_frame(&Frame::Session(&body));
            wire.flush(cx);
        }
    }

    /// Releases a call that has failed or was cancelled. `pending` is its entry, if it was still waiting for its reply.
    pub(super) fn release_call(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        id: CallId,
        pending: Option<Pending>,
    ) {
        let known = self.forget(id);
        let waited = pending.and_then(|pending| Some((pending.slot, pending.leased?)));
        let Some((slot, class)) = waited.or(known) else { return };
        // If the link is not live, no release is needed: the callee ends all leases of a link that it loses.
        if wire.phase != Phase::Live || Self::send_release(wire, cx, id, class) {
            return;
        }
        // Keep the release for a retry: without it the motion would last as long as the lease.
        match pending {
            Some(pending) => {
                self.requests.keep_unsent_release(pending);
                wire.due.set(Part::Releases, cx.now + RETRY);
            }
            None => self.keep_unsent(wire, cx.now, id, slot, class),
        }
    }

    /// Releases all calls of a function of the peer.
    pub(super) fn release(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, slot: Slot) -> Result<(), Error> {
        if wire.phase != Phase::Live {
            return Err(Error::NotConnected);
        }
        // Stop renewing first, whether or not the release can be sent: what runs ends with its lease at the latest.
        self.held.retain(|held| held.slot != slot || !held.is_renewed());
        let newest = self.requests.newest();
        if Self::send_release_all(wire, cx, slot, newest) {
            return Ok(());
        }
        wire.due.set(Part::Releases, cx.now + RETRY);
        self.keep_release(slot, newest)
    }

    /// Keeps the release of one call for a retry. In a full table, its function's earlier calls are released with it.
    fn keep_unsent(&mut self, wire: &mut Wire<P>, now: Instant, call: CallId, slot: Slot, class: Priority) {
        let (operator, lease, renew, next) = (false, 0, Renew::Never, Instant::FAR_FUTURE);
        let held = Held { call, slot, operator, class, lease, renew, next, answered: now };
        if self.held.push(held).is_err() && self.keep_release(slot, call).is_err() {
            wire.link.counters.count(LinkCounter::FramesWithheld);
        }
        wire.due.set(Part::Releases, now + RETRY);
    }

    fn can_keep(&self, slot: Slot) -> bool {
        !self.releases.is_full() || self.releases.iter().any(|(known, _)| *known == slot)
    }

    /// Keeps a release of a function's calls up to this one for a retry.
    fn keep_release(&mut self, slot: Slot, newest: CallId) -> Result<(), Error> {
        match self.releases.iter_mut().find(|(known, _)| *known == slot) {
            Some((_, id)) => *id = newest.max(*id),
            None => self.releases.push((slot, newest)).map_err(|_| Error::Full(Limit::SendQueue))?,
        }
        Ok(())
    }

    /// Retries the releases that the stream had no capacity for.
    pub(super) fn send_releases(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        if wire.due.at(Part::Releases) == Instant::FAR_FUTURE {
            return;
        }
        wire.due.set(Part::Releases, cx.now + RETRY);
        while let Some(&(slot, id)) = self.releases.last() {
            if !Self::send_release_all(wire, cx, slot, id) {
                return;
            }
            self.releases.pop();
        }
        while let Some(Held { call, class, .. }) = self.held.iter().find(|held| !held.is_renewed()).copied() {
            if !Self::send_release(wire, cx, call, class) {
                return;
            }
            self.held.retain(|held| held.call != call);
        }
        while let Some((id, class)) = self.requests.unsent_release() {
            if !Self::send_release(wire, cx, id, class) {
                return;
            }
            self.requests.release_sent(id);
        }
        wire.due.set(Part::Releases, Instant::FAR_FUTURE);
    }

    fn send_release(wire: &mut Wire<P>, cx: &mut Context<'_, P>, id: CallId, class: Priority) -> bool {
        Self::send_both_ways(wire, cx, &SessionBody::release(&Release { call: id.0, class }))
    }

    fn send_release_all(wire: &mut Wire<P>, cx: &mut Context<'_, P>, slot: Slot, id: CallId) -> bool {
        Self::send_both_ways(wire, cx, &SessionBody::release_all(slot, id.0))
    }

    /// Sends a body by datagram and in the stream; `false` if the stream has no capacity.
    fn send_both_ways(wire: &mut Wire<P>, cx: &mut Context<'_, P>, body: &[u8]) -> bool {
        wire.send_datagram(cx, body, &[]);
        let kept = wire.link.send_frame(&Frame::Session(body));
        wire.flush(cx);
        kept
    }
}
