//! What a session does when time has passed: keep-alives, deadlines, ends of leases and of silent links.

use super::advertising::{send_limits, send_list};
use super::due::Part;
use super::granting::expire_granted;
use super::holding::Calling;
use super::{CHALLENGE_DATAGRAMS, Event, Phase, Session, close_code};
use crate::ability::{DETAILS, STREAMS};
use crate::distribution::message::SessionBody;
use crate::error::{CloseReason, Error};
use crate::host::connections::{LinkCounter, Report};
use crate::host::frame::Frame;
use crate::services::lease::LeaseEnd;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

impl<P: Port> Session<P> {
    /// When [`poll`](Self::poll) has to be called next.
    pub fn deadline(&self) -> Instant {
        match self.wire.phase {
            Phase::AwaitingHello { until } | Phase::Proving { until } => until,
            Phase::Deciding => Instant::FAR_FUTURE,
            Phase::Ending(_) => Instant::START,
            Phase::Ended => Instant::FAR_FUTURE,
            Phase::Live => {
                debug_assert!(self.is_due_right(), "a part has changed its deadline and has not said so");
                self.wire.due.next()
            }
        }
    }

    /// Whether the table agrees with each part. For calls, leases and renewals it may be early, but never late.
    fn is_due_right(&self) -> bool {
        let due = &self.wire.due;
        let granted = self.granting.granted.iter().map(|granted| granted.end);
        let held = self.calling.held.iter().map(|held| held.next);
        due.next() == due.earliest()
            && granted.chain([Instant::FAR_FUTURE]).all(|end| due.at(Part::Leases) <= end)
            && held.chain([Instant::FAR_FUTURE]).all(|next| due.at(Part::Renewals) <= next)
            && (!P::CALLS || due.at(Part::Calls) <= self.calling.requests.deadline())
            && due.at(Part::Keys) == self.renewal.deadline(self.wire.dialed)
            && due.at(Part::Liveness) == self.wire.liveness.deadline()
            && (!STREAMS || due.at(Part::Streams) == self.wire.pace.deadline(self.wire.link.queued()))
            && (!DETAILS || due.at(Part::Details) == self.details.deadline())
    }

    /// Does what is due and returns one event. Call it until it returns `None`.
    pub fn poll(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        match self.wire.phase {
            Phase::AwaitingHello { until } | Phase::Proving { until } => {
                if cx.now < until {
                    return None;
                }
                self.wire.close(cx, CloseReason::HelloTimeout);
                self.poll_ending(cx, CloseReason::HelloTimeout)
            }
            Phase::Deciding | Phase::Ended => None,
            Phase::Ending(reason) => self.poll_ending(cx, reason),
            Phase::Live => self.poll_live(cx),
        }
    }

    fn poll_live(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        // Leases first: motion must end before anything else is done.
        if (self.wire.due.has_come(Part::Leases, cx.now) || self.granting.was_stopped(cx))
            && let Some(slot) = self.granting.expire_lease(&mut self.wire, cx)
        {
            return Some(Event::LeaseExpired(slot));
        }
        if P::CALLS
            && self.wire.due.has_come(Part::Calls, cx.now)
            && let Some(pending) = self.calling.expire_call(&mut self.wire, cx.now)
        {
            let id = pending.id;
            Calling::send_cancel(&mut self.wire, cx, &pending);
            self.calling.release_call(&mut self.wire, cx, id, Some(pending));
            self.wire.link.counters.count(LinkCounter::CallsTimedOut);
            return Some(Event::Reply(id, Err(Error::TimedOut)));
        }
        if DETAILS
            && self.wire.due.has_come(Part::Details, cx.now)
            && let Some(event) = self.details.poll(&mut self.wire, &mut self.calls, cx.now)
        {
            return Some(event);
        }
        // All events were returned above, one per call. What follows only sends.
        if self.has_news() {
            self.pump(cx);
        }
        if P::CALLS && self.wire.due.has_come(Part::Releases, cx.now) {
            self.calling.send_releases(&mut self.wire, cx);
        }
        if self.wire.due.has_come(Part::Gathered, cx.now) {
            self.wire.flush(cx);
        }
        if P::CALLS
            && self.wire.due.has_come(Part::Renewals, cx.now)
            && let Some(event) = self.calling.renew_leases(&mut self.wire, cx)
        {
            return Some(event);
        }
        if self.wire.due.has_come(Part::KeepAlive, cx.now) {
            self.send_keep_alive(cx);
        }
        self.send_refused(cx);
        let moves = self.moves();
        self.renewal.poll(&mut self.wire, cx, moves);
        if self.wire.due.has_come(Part::Claims, cx.now) {
            self.poll_claims(cx);
        }
        self.look_for_peer(cx);
        if STREAMS && self.wire.due.has_come(Part::Streams, cx.now) {
            self.streaming.send_samples(&mut self.wire, cx);
        }
        match self.wire.phase {
            Phase::Ending(reason) => self.poll_ending(cx, reason),
            _ => None,
        }
    }

    fn poll_claims(&mut self, cx: &mut Context<'_, P>) {
        let Some((silent_at, until)) = self.granting.obedience.poll(&mut self.wire, cx) else { return };
        if self.wire.challenged {
            if cx.now >= silent_at {
                return self.wire.close(cx, CloseReason::PeerRestarted);
            }
        } else if self.has_given_way(cx) {
            return;
        }
        if cx.now >= until {
            (0..self.granting.granted.len()).for_each(|index| self.granting.cut_lease(&mut self.wire, cx, index));
        }
    }

    /// Ends a link that is to give way to a higher claim, once nothing of it moves. Returns whether it has ended.
    pub(super) fn has_given_way(&mut self, cx: &mut Context<'_, P>) -> bool {
        let ends = self.granting.obedience.gives_way() && self.granting.is_quiet(&self.wire, cx);
        if ends {
            self.wire.close(cx, CloseReason::PeerRestarted);
        }
        ends
    }

    /// Sends the peer all pending notifications, as far as there is capacity.
    pub(super) fn pump(&mut self, cx: &mut Context<'_, P>) {
        if !self.wire.may_advertise() {
            return;
        }
        self.granting.send_ends(&mut self.wire, cx);
        send_limits(&mut self.wire, cx);
        self.granting.obedience.send_claim(&mut self.wire, cx);
        send_list(&mut self.wire, cx);
        if STREAMS {
            self.streaming.pump(&mut self.wire, cx);
        }
    }

    /// Whether any notification waits for capacity.
    fn has_news(&self) -> bool {
        self.wire.publishing.has_news() || self.granting.has_news() || (STREAMS && self.streaming.has_news())
    }

    /// Asks a peer that has missed a keep-alive for a sign of life, and ends the link if none comes in time.
    fn look_for_peer(&mut self, cx: &mut Context<'_, P>) {
        // This unit leaves the stream unread, so its silence says nothing about the peer.
        if self.wire.holds && !self.wire.liveness.hears() {
            self.wire.heard(cx.now);
        }
        self.granting.obedience.note_silence(&self.wire, cx);
        if !self.wire.due.has_come(Part::Liveness, cx.now) {
            return;
        }
        let look = self.wire.liveness.poll(cx.now, self.wire.sent());
        self.wire.note_liveness();
        if look.missed {
            self.wire.link.counters.count(LinkCounter::KeepAlivesMissed);
        }
        if look.lost {
            return self.wire.close(cx, CloseReason::Silent);
        }
        if look.deaf {
            self.wire.link.counters.count(LinkCounter::DatagramsMissing);
            // Tell the peer at once, in the stream, so that it sends its keep-alives there.
            self.wire.due.set(Part::KeepAlive, cx.now);
        }
        if look.missed && self.wire.liveness.is_silent() {
            // Tell the peer at once that it is not heard: a manager that hears nothing is to be replaced soon.
            self.wire.due.set(Part::KeepAlive, cx.now);
        }
        if look.ask {
            self.wire.send_datagram(cx, &SessionBody::PING, &[]);
        }
        if look.probe {
            self.pings.send(&mut self.wire, cx.now);
            self.wire.flush(cx);
        }
    }

    /// Evaluates the peer's report of what has reached it.
    pub(super) fn reported(&mut self, cx: &mut Context<'_, P>, report: Report) {
        let sent = self.wire.sent();
        let died = self.wire.liveness.reported(cx.now, sent, report);
        self.granting.obedience.note_silence(&self.wire, cx);
        if let Some(long) = died {
            let reason = CloseReason::StreamDead { long };
            // Send the reason by datagram, since the stream does not reach the peer: else it would have to time out by itself.
            for _ in 0..CHALLENGE_DATAGRAMS {
                self.wire.send_datagram(cx, &SessionBody::close(close_code(reason)), &[]);
            }
            self.wire.link.counters.count(LinkCounter::StreamsDied);
            self.wire.close(cx, reason);
        }
    }

    /// Reports what ended with the link, one event per call: leases first.
    fn poll_ending(&mut self, cx: &mut Context<'_, P>, reason: CloseReason) -> Option<Event> {
        while let Some(granted) = self.granting.granted.pop() {
            if expire_granted(cx, &granted, LeaseEnd::Expired) {
                return Some(Event::LeaseExpired(granted.slot));
            }
        }
        if P::CALLS
            && let Some(id) = self.calling.requests.interrupt()
        {
            return Some(Event::Reply(id, Err(Error::Interrupted)));
        }
        self.wire.link.release(cx.buffers);
        self.calls.release(cx.buffers);
        // Unread results were in a buffer that is now back in the pool.
        self.wire.step = self.wire.step.wrapping_add(1);
        self.wire.phase = Phase::Ended;
        Some(Event::Closed(reason))
    }

    fn send_keep_alive(&mut self, cx: &mut Context<'_, P>) {
        // The peer's timeout counts from the interval in the hello, even if the constraint has become longer.
        let pause = self.wire.constraints.keep_alive.min(self.wire.own_keep_alive()).max(Duration::from_millis(1));
        self.wire.due.set(Part::KeepAlive, cx.now + pause);
        self.wire.publishing.actuators_due = true;
        self.pump(cx);
        let body = SessionBody::keep_alive(cx.now.as_micros(), self.wire.report());
        self.wire.send_datagram(cx, &body, &[]);
        // Use the stream, too, unless datagrams pass both ways: the peer cannot notice that they no longer reach it.
        if !self.wire.liveness.is_heard() || !self.wire.liveness.hears() {
            self.wire.link.send_frame(&Frame::Session(&body));
            self.wire.flush(cx);
        }
    }
}
