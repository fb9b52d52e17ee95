//! What a session does because time has passed: keep-alives, deadlines, leases, the end of a silent link.

use super::due::Part;
use super::granting::expire_granted;
use super::holding::Calling;
use super::publishing::{send_limits, send_list};
use super::{CHALLENGE_DATAGRAMS, Event, Phase, Session, close_code};
use crate::ability::{DETAILS, STREAMS};
use crate::distribution::message::SessionBody;
use crate::error::{CloseReason, Error};
use crate::host::connections::{LinkCounter, Report};
use crate::host::frame::Frame;
use crate::services::lease::LeaseEnd;
use crate::services::{Context, Port};
use crate::time::{Duration, Instant};

/// A peer's clock as last heard, so that it can bound the age of what we send.
#[derive(Clone, Copy, Debug)]
pub(super) struct PeerClock {
    stamp: u64,
    /// When the stamp came; in the far future while none has.
    heard: Instant,
}

/// A sample of the peer's clock counts for this long, however late the newer ones came.
const SAMPLE_LIFE: Duration = Duration::from_secs(10);
/// Part of the time since a sample by which the two clocks may have drifted apart.
const DRIFT: u64 = 1_000;

impl PeerClock {
    pub(super) const fn new() -> Self {
        Self { stamp: 0, heard: Instant::FAR_FUTURE }
    }

    /// Notes the peer's clock. A sample that was held up on its way would make everything that is sent look old, so it
    /// is passed over while a better one is fresh.
    pub(super) fn hear(&mut self, now: Instant, stamp: u64) {
        // Before the first sample both are 0, so that one is taken.
        let elapsed = now.since(self.heard);
        let expected = Duration::from_micros(self.stamp) + elapsed - elapsed.divided_by(DRIFT);
        if Duration::from_micros(stamp) >= expected || elapsed >= SAMPLE_LIFE {
            *self = Self { stamp: stamp.max(self.stamp), heard: now };
        }
    }

    /// (the stamp, time since it was heard).
    pub(super) fn stamp(&self, now: Instant) -> (u64, Duration) {
        (self.stamp, now.since(self.heard))
    }
}

/// The earliest time at which the peer can have made what it stamped so; `None` for a stamp that this clock has not reached, so never gave out.
pub(super) fn sent_at_earliest(now: Instant, stamp: u64, since: Duration) -> Option<Instant> {
    let sent_at = Instant::from_micros(stamp) + since;
    // The clocks drift: a sum that lies ahead means now.
    if Instant::from_micros(stamp) > now { None } else { Some(sent_at.min(now)) }
}

impl<P: Port> Session<P> {
    /// When [`poll`](Self::poll) has something to do next.
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

    /// Whether the table is what each part would say now. Of calls, leases and renewals it may say too early a time, and never too late.
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

    /// Does what is due. Returns one event at a time; call it until it returns `None`.
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
        // Leases come first: what moves must stop before anything else is done.
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
        // From here on only frames are sent; what the port has to do for others was returned above, one event a call.
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
                self.wire.close(cx, CloseReason::PeerRestarted);
            }
        } else if !self.has_given_way(cx) && cx.now >= until {
            (0..self.granting.granted.len()).for_each(|index| self.granting.cut_lease(&mut self.wire, cx, index));
        }
    }

    /// Ends a link that gives way when nothing of it moves; whether it has.
    pub(super) fn has_given_way(&mut self, cx: &mut Context<'_, P>) -> bool {
        let ends = self.granting.obedience.gives_way() && self.granting.is_quiet(&self.wire, cx);
        if ends {
            self.wire.close(cx, CloseReason::PeerRestarted);
        }
        ends
    }

    /// Tells the peer what it is still to be told, as far as there is room.
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

    /// Whether something waits for room.
    fn has_news(&self) -> bool {
        self.wire.publishing.has_news() || self.granting.has_news() || (STREAMS && self.streaming.has_news())
    }

    /// Asks a peer that has missed a keep-alive for a sign of life, and gives it up when none comes.
    fn look_for_peer(&mut self, cx: &mut Context<'_, P>) {
        // What is not read for now has come all the same.
        if self.wire.holds && !self.wire.liveness.hears() {
            self.wire.heard(cx.now);
        }
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
            // The peer is told at once, in the stream: it sends its keep-alives there then.
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

    /// The peer tells what comes of this unit there.
    pub(super) fn reported(&mut self, cx: &mut Context<'_, P>, report: Report) {
        let sent = self.wire.sent();
        if let Some(long) = self.wire.liveness.reported(cx.now, sent, report) {
            let reason = CloseReason::StreamDead { long };
            // What the stream does not bring there: the peer need not find out by itself.
            for _ in 0..CHALLENGE_DATAGRAMS {
                self.wire.send_datagram(cx, &SessionBody::close(close_code(reason)), &[]);
            }
            self.wire.link.counters.count(LinkCounter::StreamsDied);
            self.wire.close(cx, reason);
        }
    }

    /// Reports what ended with the link, one by one: leases first.
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
        // Results that were not looked at were in a buffer that has gone back.
        self.wire.step = self.wire.step.wrapping_add(1);
        self.wire.phase = Phase::Ended;
        Some(Event::Closed(reason))
    }

    fn send_keep_alive(&mut self, cx: &mut Context<'_, P>) {
        // The peer counts by what it was told in the hello.
        let reported = Duration::from_millis(self.wire.reported_keep_alive.into());
        let pause = self.wire.constraints.keep_alive.min(reported).max(Duration::from_millis(1));
        self.wire.due.set(Part::KeepAlive, cx.now + pause);
        self.wire.publishing.actuators_due = true;
        self.pump(cx);
        let body = SessionBody::keep_alive(cx.now.as_micros(), self.wire.report());
        self.wire.send_datagram(cx, &body, &[]);
        // Where none come, none may arrive there either: the peer could not tell.
        if !self.wire.liveness.is_heard() || !self.wire.liveness.hears() {
            self.wire.link.send_frame(&Frame::Session(&body));
            self.wire.flush(cx);
        }
    }
}
