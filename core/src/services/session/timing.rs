//! What a session does because time has passed: keep-alives, deadlines, leases, the end of a silent link.

use super::granting::expire_granted;
use super::{CHALLENGE_DATAGRAMS, Event, Phase, Session, close_code};
use crate::ability::{DETAILS, STREAMS};
use crate::bytes::copy;
use crate::config::{DATAGRAM_BYTES, GATHER};
use crate::distribution::datagram;
use crate::distribution::message::{SESSION_BODY_BYTES, SessionBody};
use crate::error::{CloseReason, Error};
use crate::host::connections::{LinkCounter, Report};
use crate::host::endpoint::Endpoint as _;
use crate::host::frame::Frame;
use crate::host::secure::{DATAGRAM_OVERHEAD, Secure};
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

/// Longest session datagram.
const LONGEST_DATAGRAM: usize =
    datagram::SESSION_HEADER_BYTES + SESSION_BODY_BYTES + DATAGRAM_BYTES + DATAGRAM_OVERHEAD;
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
        // Nothing has elapsed and the stamp is 0 while none has come: the first one is better.
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

/// The earliest time at which the peer can have made what it stamped so; `None` for a stamp from the future.
pub(super) fn sent_at_earliest(now: Instant, stamp: u64, since: Duration) -> Option<Instant> {
    let sent_at = Instant::from_micros(stamp) + since;
    // The peer's clock runs a little faster or slower than ours; what seems to come from the future is new.
    if Instant::from_micros(stamp) > now { None } else { Some(sent_at.min(now)) }
}

/// When each thing is due.
#[derive(Clone, Copy, Debug)]
pub(super) struct Timers {
    pub(super) keep_alive: Instant,
    /// The last write, behind which one-way messages gather.
    pub(super) last_write: Instant,
    /// Gathered messages go out.
    pub(super) gathered: Instant,
    /// The earliest end of a granted lease.
    pub(super) lease: Instant,
    /// The earliest renewal of a held lease.
    pub(super) renewal: Instant,
    /// The next try to send a release that the stream had no room for.
    pub(super) release: Instant,
}

impl Timers {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            keep_alive: now,
            last_write: Instant::START,
            gathered: Instant::FAR_FUTURE,
            lease: Instant::FAR_FUTURE,
            renewal: Instant::FAR_FUTURE,
            release: Instant::FAR_FUTURE,
        }
    }

    /// Whether a one-way message made at `now` may wait for company.
    pub(super) fn may_gather(&self, now: Instant) -> bool {
        self.last_write != Instant::START && now < self.last_write + GATHER
    }
}

impl<P: Port> Session<P> {
    /// When [`poll`](Self::poll) has something to do next.
    pub fn deadline(&self) -> Instant {
        match self.phase {
            Phase::AwaitingHello { until } | Phase::Proving { until } => until,
            Phase::Deciding => Instant::FAR_FUTURE,
            Phase::Ending(_) => Instant::START,
            Phase::Ended => Instant::FAR_FUTURE,
            Phase::Live => {
                let timers = &self.timers;
                let own =
                    timers.keep_alive.min(timers.gathered).min(timers.lease).min(timers.renewal).min(timers.release);
                let own = own.min(self.obedience.next);
                let own = own.min(self.renewal.deadline(self.dialed));
                let own = if STREAMS { own.min(self.streaming.deadline(self.link.queued())) } else { own };
                let own = if DETAILS { own.min(self.details.deadline()) } else { own };
                let own = if P::CALLS { own.min(self.requests.deadline()) } else { own };
                own.min(self.liveness.deadline())
            }
        }
    }

    /// Does what is due. Returns one event at a time; call it until it returns `None`.
    pub fn poll(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        match self.phase {
            Phase::AwaitingHello { until } | Phase::Proving { until } => {
                if cx.now < until {
                    return None;
                }
                self.close(cx, CloseReason::HelloTimeout);
                self.poll_ending(cx, CloseReason::HelloTimeout)
            }
            Phase::Deciding | Phase::Ended => None,
            Phase::Ending(reason) => self.poll_ending(cx, reason),
            Phase::Live => self.poll_live(cx),
        }
    }

    fn poll_live(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        // Leases come first: what moves must stop before anything else is done.
        if (cx.now >= self.timers.lease || self.was_stopped(cx))
            && let Some(slot) = self.expire_lease(cx)
        {
            return Some(Event::LeaseExpired(slot));
        }
        if P::CALLS
            && let Some(pending) = self.requests.expire(cx.now)
        {
            let id = pending.id;
            self.send_cancel(cx, &pending);
            self.release_call(cx, id, Some(pending));
            self.link.counters.count(LinkCounter::CallsTimedOut);
            return Some(Event::Reply(id, Err(Error::TimedOut)));
        }
        if DETAILS && let Some(event) = self.poll_details(cx.now) {
            return Some(event);
        }
        // From here on only frames are sent; what the port has to do for others was returned above, one event a call.
        if self.has_news() {
            self.pump(cx);
        }
        if P::CALLS && cx.now >= self.timers.release {
            self.send_releases(cx);
        }
        if cx.now >= self.timers.gathered {
            self.flush(cx);
        }
        if P::CALLS
            && cx.now >= self.timers.renewal
            && let Some(event) = self.renew_leases(cx)
        {
            return Some(event);
        }
        if cx.now >= self.timers.keep_alive {
            self.send_keep_alive(cx);
        }
        self.poll_renewal(cx);
        self.poll_obedience(cx);
        self.look_for_peer(cx);
        if STREAMS && cx.now >= self.streaming.deadline(self.link.queued()) {
            self.send_samples(cx);
        }
        match self.phase {
            Phase::Ending(reason) => self.poll_ending(cx, reason),
            _ => None,
        }
    }

    /// Asks a peer that has missed a keep-alive for a sign of life, and gives it up when none comes.
    fn look_for_peer(&mut self, cx: &mut Context<'_, P>) {
        // What is not read for now has come all the same.
        if self.holds && !self.liveness.hears() {
            self.liveness.heard(cx.now);
        }
        let look = self.liveness.poll(cx.now, self.sent());
        if look.missed {
            self.link.counters.count(LinkCounter::KeepAlivesMissed);
        }
        if look.lost {
            return self.close(cx, CloseReason::Silent);
        }
        if look.deaf {
            self.link.counters.count(LinkCounter::DatagramsMissing);
            // The peer is told at once, in the stream: it sends its keep-alives there then.
            self.timers.keep_alive = cx.now;
        }
        if look.ask {
            self.send_datagram(cx, &SessionBody::PING, &[]);
        }
        if look.probe {
            self.send_ping(cx.now);
            self.flush(cx);
        }
    }

    /// Bytes written into the stream, as reports count them.
    fn sent(&self) -> u32 {
        self.link.counters.value(LinkCounter::BytesSent) as u32
    }

    /// What comes of the peer here.
    pub(super) fn report(&self) -> Report {
        Report {
            received: self.link.counters.value(LinkCounter::BytesReceived) as u32,
            hears: self.liveness.hears(),
            holds: self.holds,
        }
    }

    /// The peer tells what comes of this unit there.
    pub(super) fn reported(&mut self, cx: &mut Context<'_, P>, report: Report) {
        let sent = self.sent();
        if let Some(long) = self.liveness.reported(cx.now, sent, report) {
            let reason = CloseReason::StreamDead { long };
            // What the stream does not bring there: the peer need not find out by itself.
            for _ in 0..CHALLENGE_DATAGRAMS {
                self.send_datagram(cx, &SessionBody::close(close_code(reason)), &[]);
            }
            self.link.counters.count(LinkCounter::StreamsDied);
            self.close(cx, reason);
        }
    }

    /// Reports what ended with the link, one by one: leases first.
    fn poll_ending(&mut self, cx: &mut Context<'_, P>, reason: CloseReason) -> Option<Event> {
        while let Some(granted) = self.granted.pop() {
            if expire_granted(cx, &granted, LeaseEnd::Expired) {
                return Some(Event::LeaseExpired(granted.slot));
            }
        }
        if P::CALLS
            && let Some(id) = self.requests.interrupt()
        {
            return Some(Event::Reply(id, Err(Error::Interrupted)));
        }
        self.link.release(cx.buffers);
        self.calls.release(cx.buffers);
        // Results that were not looked at were in a buffer that has gone back.
        self.step = self.step.wrapping_add(1);
        self.phase = Phase::Ended;
        Some(Event::Closed(reason))
    }

    fn send_keep_alive(&mut self, cx: &mut Context<'_, P>) {
        // The peer counts by what it was told in the hello.
        let reported = Duration::from_millis(self.reported_keep_alive.into());
        self.timers.keep_alive = cx.now + self.constraints.keep_alive.min(reported).max(Duration::from_millis(1));
        self.publishing.actuators_due = true;
        self.pump(cx);
        let body = SessionBody::keep_alive(cx.now.as_micros(), self.report());
        self.send_datagram(cx, &body, &[]);
        // Where none come, none may arrive there either: the peer could not tell.
        if !self.liveness.is_heard() || !self.liveness.hears() {
            self.link.send_frame(&Frame::Session(&body));
            self.flush(cx);
        }
    }

    /// Sends a session datagram; `body` and `rest` follow each other in it. `false` when the network refused it.
    pub(super) fn send_datagram(&mut self, cx: &mut Context<'_, P>, body: &[u8], rest: &[u8]) -> bool {
        let Some((to, header)) = self.datagram_header() else { return false };
        let (front, back) = self.link.cipher().datagram_room();
        let mut bytes = [0; LONGEST_DATAGRAM];
        let start = header.len().saturating_add(front);
        let end = start.saturating_add(body.len()).saturating_add(rest.len());
        let place = bytes.get_mut(start..end).and_then(|place| place.split_at_mut_checked(body.len()));
        let Some((place, behind)) = place else { return false };
        copy(body, place);
        copy(rest, behind);
        let Some(whole) = bytes.get_mut(..end.saturating_add(back)) else { return false };
        let Some((head, sealed)) = whole.split_first_chunk_mut() else { return false };
        *head = header;
        if !self.link.cipher().seal_datagram(&header, sealed) {
            return false;
        }
        let sent = cx.mailman.send_to(to, whole);
        if sent {
            self.link.counters.count(LinkCounter::DatagramsSent);
        }
        sent
    }

    fn datagram_header(&mut self) -> Option<(P::Endpoint, [u8; datagram::SESSION_HEADER_BYTES])> {
        let mode = self.mode();
        let remote = self.remote.as_ref()?;
        if remote.datagrams.port() == 0 {
            return None;
        }
        let header = datagram::session_header(mode, remote.version, self.fleet, remote.hello.link, remote.hello.nonce);
        Some((remote.datagrams, header))
    }
}
