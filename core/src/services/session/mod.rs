//! One link to one peer: an s_unit has one session, with its manager; an m_unit has one for each peer.
//!
//! A [`Session`] is a state machine without I/O: it turns received bytes into [`Event`]s and requests into bytes. It never
//! waits: the port lends it a [`Context`], runs the handler of an [`Event::Incoming`] outside of any lock, and passes the
//! results to [`Session::answer`]. It reaches the unit's [`Hub`](super::hub::Hub) through the context's
//! [`Door`](super::hub::Door).
//!
//! # What a port does
//! - bytes arrive: [`Session::receive`] until they are consumed and nothing more comes out, then [`Session::next_call`]
//!   until it returns `None`, running what it returns;
//! - the stream is writable: [`Session::writable`];
//! - a session datagram arrives: [`Session::datagram`];
//! - [`Session::deadline`] has come, and after every other call that may have ended the link: [`Session::poll`] until
//!   it returns `None`;
//! - the hub has a [`Command`](crate::distribution::connection_handler::Command) for a link: [`Session::direct`];
//! - [`Event::Closed`] is the last event: the port forgets the link and tells the hub's node that it
//!   [left](crate::distribution::connection_handler::Node::left).

mod advertising;
mod answering;
mod details;
mod due;
mod granting;
mod handing;
mod holding;
mod inbound;
mod obeying;
mod outbound;
mod peer_clock;
mod permitting;
mod pinging;
mod proving;
mod publishing;
mod renewing;
mod streaming;
mod subscription;
mod timing;
mod wire;

pub use inbound::{Receipt, ReplyBlock, Results};
pub use outbound::{Delivery, RequestOptions};
pub use publishing::Publication;
pub use streaming::{Granted as GrantedStream, Sample};

use crate::ability::{Ability, Details, STREAMS, State, Streams};
use crate::config::{Constraints, HELLO_TIMEOUT, LINK_BUFFER_BYTES, Priority};
use crate::counters::Counters;
use crate::distribution::connection_handler::{Admission, Directive};
use crate::distribution::function_list::{Entry, Slot, TheirFunctionList};
use crate::distribution::hello::{Hello, Manager};
use crate::distribution::identity::{Epoch, Fleet, Identity};
use crate::distribution::message::{HandOverRefusal, LONGEST_HEADER_BYTES, SessionBody};
use crate::distribution::parameters::ParametersView;
use crate::error::{CloseReason, Error, Refusal};
use crate::host::connections::{Link, LinkCounter, Liveness};
use crate::host::frame::HEADER_BYTES;
use crate::host::mailman::LinkId;
use crate::host::secure::Secure;
use crate::services::access::Verb;
use crate::services::call::Callee;
use crate::services::calls::{Calls, RunningCall, Ticket};
use crate::services::heart::Beats;
use crate::services::lease::{ActuatorState, Lease, LeaseEnd, Order};
use crate::services::requests::{CallId, Made, Pending, Requests};
use crate::services::{Context, Port};
use crate::storage::{Buffers, Storage};
use crate::time::{Duration, Instant};
use granting::Granting;
use holding::Calling;
use permitting::decide;
use proving::{reply_to_hello, send_hello};
use wire::{Phase, Wire, close_code, close_reason};

/// Longest frame body that an unauthenticated peer may send; with its header it needs no buffer of the pool.
const UNPROVEN_BYTES: usize = crate::config::MINIMUM_CHUNK_BYTES - HEADER_BYTES - 1;
/// Datagrams of a challenge, beside a frame: one that is lost must not make a live peer look dead, and give a duplicate its link.
const CHALLENGE_DATAGRAMS: usize = 3;
/// Most bytes that framing adds to one chunk, without sealing.
const FRAME_BYTES: usize = HEADER_BYTES + 6;
/// Least capacity for a message: the protocol's own messages fit, however small `message_size` is.
const LEAST_MESSAGE_BYTES: usize = 512;

/// The initial settings of a session.
#[derive(Clone, Debug)]
pub struct SessionConfig<E> {
    /// The link's index.
    pub link: LinkId,
    /// `true` if this unit opens the connection, `false` if it accepted one.
    pub dialed: bool,
    /// The other end of the stream.
    pub address: E,
    /// [`Node::nonce`](crate::distribution::connection_handler::Node::nonce)
    pub nonce: u64,
    /// This unit's constraints.
    pub constraints: Constraints,
}

/// The memory that one session uses.
pub struct SessionStorage<S: Storage> {
    /// [`LINK_BUFFER_BYTES`] bytes for partial frames.
    pub small: S::Slice<u8>,
    /// One slot per call in flight to the peer.
    pub pending: S::Slice<Option<Pending>>,
    /// One slot per call of the peer that runs here, and one more for emergencies.
    pub running: S::Slice<Option<RunningCall>>,
    /// One slot per function of this unit's own list.
    pub publications: S::Slice<Publication>,
    /// One slot per function of the peer's list that is kept.
    pub their_functions: S::Slice<Entry>,
    /// Bytes for the signatures of those.
    pub their_signatures: S::Slice<u8>,
}

/// What happened on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
// A 32-bit tag lets the compiler copy events by words instead of bytes.
#[repr(u32)]
pub enum Event {
    /// Both ends have accepted each other: the link is live, and this unit's published functions are on their way to the peer.
    Joined,
    /// Run the handler of this call, whose arguments are in the lent parameters, then call [`Session::answer`].
    Incoming(Incoming),
    /// A call of this unit has ended; [`Session::results`] reads its results.
    Reply(CallId, Result<Results, Error>),
    /// The peer refused a request that expects no reply, or its service failed.
    Failed(CallId, Error),
    /// The peer's list of functions changed.
    ListChanged,
    /// The peer has processed this unit's list up to `serial`; `skipped` functions did not fit its table.
    Acknowledged {
        /// As returned by [`Session::publish`].
        serial: u32,
        /// How many functions did not fit.
        skipped: u16,
    },
    /// A lease on a function of this unit ended without being renewed: run its safe hook before anything else.
    LeaseExpired(Slot),
    /// The peer ended the lease that a call of this unit held on its function.
    LeaseEnded {
        /// The call that held it.
        call: CallId,
        /// The peer's function.
        slot: Slot,
        /// Why.
        why: LeaseEnd,
    },
    /// The peer reports the state of an actuator: before its list is complete, if the actuator has had an order or is inhibited,
    /// and within a keep-alive interval of each change.
    Actuator {
        /// The peer's function.
        slot: Slot,
        /// Its state.
        state: ActuatorState,
    },
    /// Progress of a running call of this unit; [`Session::progress_values`] reads the values.
    Progress(CallId, <Details as Ability>::Of<Results>),
    /// The caller has given up a running call: notify its handler. The answer will be dropped.
    Cancelled(<Details as Ability>::Of<Ticket>),
    /// A value of a stream of the peer.
    Sample(<Streams as Ability>::Of<Sample>),
    /// The peer granted or ended a subscription to one of its streams; an error ends it.
    Subscribed(Slot, <Streams as Ability>::Of<Result<GrantedStream, Error>>),
    /// The peer answered a [`Session::ping`] or a [`Session::hand_over`].
    Answered,
    /// The link has ended. All calls in flight and all leases have been reported before this event.
    Closed(CloseReason),
}

/// A call of the peer that is to be run now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Incoming {
    /// Passed to [`Session::answer`] with the results.
    pub ticket: Ticket,
    /// The function of this unit's list.
    pub slot: Slot,
    /// Its class.
    pub priority: Priority,
    /// Whether the caller waits for an answer.
    pub wants_reply: bool,
    /// When the caller stops waiting for the answer.
    pub deadline: Instant,
    /// The call's order, if its service has a lease.
    pub order: Option<Order>,
}

/// One link to one peer.
pub struct Session<P: Port> {
    wire: Wire<P>,
    pings: pinging::Pings,
    renewal: renewing::Renewal,
    calling: Calling<P>,
    calls: Calls<P::Storage>,
    granting: Granting,
    streaming: streaming::StreamsPart,
    details: details::DetailsPart,
    handing: handing::HandingPart,
}

impl<P: Port> Session<P> {
    /// A session on a link that is being opened or was accepted.
    pub fn new(
        now: Instant,
        config: SessionConfig<P::Endpoint>,
        cipher: P::Cipher,
        storage: SessionStorage<P::Storage>,
    ) -> Self {
        let SessionConfig { link, dialed, address, nonce, constraints } = config;
        let chunk_limit = usize::from(constraints.chunk_size);
        debug_assert!(storage.small.len() >= LINK_BUFFER_BYTES);
        let proven = cipher.is_sealing();
        let mut link = Link::new(link, cipher, storage.small, chunk_limit, message_limit(&constraints));
        if !proven {
            // An unauthenticated peer is limited to the link's own buffer, so that it cannot use up the pool.
            link.set_chunk_limit(UNPROVEN_BYTES);
        }
        let mut wire = Wire {
            link,
            phase: Phase::AwaitingHello { until: now + HELLO_TIMEOUT },
            dialed,
            nonce,
            fleet: Fleet(0),
            reported_keep_alive: 0,
            constraints,
            remote: None,
            peer_address: address,
            liveness: Liveness::new(now, constraints.keep_alive),
            holds: false,
            joined: false,
            listed: false,
            challenged: false,
            clock: peer_clock::PeerClock::new(),
            due: due::Due::new(),
            pace: State::NEW,
            last_write: Instant::START,
            publishing: publishing::Publishing::new(storage.publications),
            theirs: TheirFunctionList::new(storage.their_functions, storage.their_signatures),
            step: 0,
        };
        wire.due.set(due::Part::KeepAlive, now);
        wire.note_liveness();
        Self {
            wire,
            pings: pinging::Pings::new(),
            renewal: renewing::Renewal::new(),
            calling: Calling::new(Requests::new(storage.pending)),
            calls: Calls::new(storage.running),
            granting: Granting::new(),
            streaming: State::NEW,
            details: State::NEW,
            handing: State::NEW,
        }
    }

    /// Returns the session's slices for the next session, so that a port without an allocator can reuse them. Call it on a
    /// session that has ended; otherwise calls in flight are dropped without an event.
    pub fn into_storage(mut self, buffers: &mut dyn Buffers<P::Storage>) -> SessionStorage<P::Storage> {
        self.wire.link.release(buffers);
        self.calls.release(buffers);
        let (their_functions, their_signatures) = self.wire.theirs.into_slices();
        SessionStorage {
            small: self.wire.link.into_small(),
            pending: self.calling.requests.into_slots(),
            running: self.calls.into_slots(),
            publications: self.wire.publishing.into_table(),
            their_functions,
            their_signatures,
        }
    }

    /// Whether this unit opened the connection.
    pub const fn dialed(&self) -> bool {
        self.wire.dialed()
    }

    /// Whether both ends have accepted each other.
    pub fn is_live(&self) -> bool {
        self.wire.phase == Phase::Live
    }

    /// Whether the link has ended and all its events have been returned.
    pub fn is_ended(&self) -> bool {
        self.wire.phase == Phase::Ended
    }

    /// Whether the peer has authenticated itself; in plain mode, whether its hello has come. When a unit has too many links, the
    /// oldest that has not got so far makes way for a new one.
    pub const fn is_proven(&self) -> bool {
        self.wire.remote.is_some() && !matches!(self.wire.phase, Phase::Proving { .. })
    }

    /// The peer's hello, once it has come. Not authenticated until [`is_proven`](Self::is_proven).
    pub fn hello(&self) -> Option<&Hello> {
        self.wire.hello()
    }

    /// The link's cipher.
    pub const fn cipher(&mut self) -> &P::Cipher {
        self.wire.link.cipher()
    }

    /// The protocol version of the link, once the peer's hello has come.
    pub fn version(&self) -> Option<u8> {
        self.wire.remote.as_ref().map(|remote| remote.version)
    }

    /// The peer's identity, once its hello has come. Not authenticated until [`is_proven`](Self::is_proven).
    pub fn identity(&self) -> Option<&Identity> {
        self.wire.identity()
    }

    /// The peer's identity, once it has joined.
    pub fn peer(&self) -> Option<&Identity> {
        self.wire.identity().filter(|_| self.wire.joined)
    }

    /// The peer's boot epoch, once its hello has come.
    pub fn epoch(&self) -> Option<Epoch> {
        self.wire.hello().map(|hello| hello.epoch)
    }

    /// The other end of the stream.
    pub const fn address(&self) -> P::Endpoint {
        self.wire.peer_address
    }

    /// This unit's constraints on this link.
    pub const fn constraints(&self) -> &Constraints {
        &self.wire.constraints
    }

    /// The nonce that the peer's session datagrams carry.
    pub const fn nonce(&self) -> u64 {
        self.wire.nonce
    }

    /// What the peer has published to this unit.
    pub const fn their_function_list(&self) -> &TheirFunctionList<P::Storage> {
        &self.wire.theirs
    }

    /// This link's counters.
    pub const fn counters(&self) -> &Counters<LinkCounter, { LinkCounter::COUNT }> {
        &self.wire.link.counters
    }

    /// The newest call of a leased function of the peer.
    pub const fn last_order(&self) -> Option<(Slot, CallId)> {
        self.calling.last_order
    }

    /// How many calls of this unit wait for a reply.
    pub fn calls_in_flight(&self) -> usize {
        self.calling.requests.in_flight()
    }

    /// How many calls of the peer run or wait here.
    pub const fn calls_held(&self) -> u16 {
        self.calls.held()
    }

    /// How long ago the peer was last heard.
    pub fn silent_for(&self, now: Instant) -> Duration {
        self.wire.liveness.silent_for(now)
    }

    /// How long ago bytes last came in the stream: a lower bound of the age of what the peer said in it.
    pub fn stream_silent_for(&self, now: Instant) -> Duration {
        self.wire.liveness.stream_silent_for(now)
    }

    /// Whether the peer's session datagrams arrive; `None` while that is unknown.
    pub const fn hears_datagrams(&self) -> Option<bool> {
        match (self.wire.liveness.hears(), self.wire.liveness.is_deaf()) {
            (false, false) => None,
            (hears, _) => Some(hears),
        }
    }

    /// Whether this unit's datagrams reach the peer, by its last report.
    pub const fn is_heard(&self) -> bool {
        self.wire.liveness.is_heard()
    }

    /// Notes that the port leaves bytes of the stream unread until the next [`receive`](Self::receive). The peer is notified: it
    /// would otherwise declare the stream dead.
    pub const fn hold_back(&mut self) {
        self.wire.holds = true;
    }

    /// Bytes of messages and frames that the network has not taken yet.
    pub fn bytes_queued(&self) -> usize {
        self.wire.link.queued()
    }

    /// Whether bytes wait for the stream to become writable. Gathered messages do not count: a deadline sends them.
    pub fn wants_to_write(&self) -> bool {
        self.wire.link.wants_to_write()
    }

    /// Whether received bytes are buffered here. If not, [`receive`](Self::receive) returns nothing more once it has consumed
    /// its input, and the final call with an empty slice can be skipped.
    pub fn holds_received(&self) -> bool {
        self.wire.link.holds_received()
    }

    /// The connection is open: the end that dialled sends its hello first.
    pub fn connected(&mut self, cx: &mut Context<'_, P>) {
        self.wire.phase = Phase::AwaitingHello { until: cx.now + HELLO_TIMEOUT };
        if self.wire.dialed() {
            send_hello(&mut self.wire, cx);
        }
    }

    /// Completes the handshake after the hub has admitted the peer. The link is live then, unless sending failed.
    fn accept(&mut self, cx: &mut Context<'_, P>) {
        if !self.wire.dialed() {
            reply_to_hello(&mut self.wire, cx);
        }
        if self.wire.phase != Phase::Deciding {
            return;
        }
        self.wire.phase = Phase::Live;
        self.wire.due.set(due::Part::KeepAlive, cx.now);
        self.renewal.rest(&mut self.wire, cx.now);
        debug!("link {} is live", self.wire.link.id().0);
    }

    /// Asks the hub whether to admit a peer that has said, or proven, who it is.
    pub(super) fn consult(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        let remote = self.wire.remote.as_ref().filter(|_| self.wire.phase == Phase::Deciding)?;
        let (now, link, from, hello) = (cx.now, self.wire.link.id(), self.wire.peer_address, &remote.hello);
        let mut admission = Admission::Wait;
        cx.hub.enter(&mut |hub| admission = hub.node.admit(now, link, from, hello));
        match admission {
            Admission::Accept => return self.admitted(cx),
            Admission::Refuse(refusal) => self.wire.refuse(cx, refusal),
            Admission::Wait => {}
        }
        None
    }

    /// Reports a sign of life to the hub, if the hub asked for one.
    pub(super) fn show_life(&mut self, cx: &mut Context<'_, P>) {
        if core::mem::take(&mut self.wire.challenged) && !self.has_given_way(cx) {
            let (now, link) = (cx.now, self.wire.link.id());
            cx.hub.enter(&mut |hub| hub.node.challenge_answered(now, link));
        }
    }

    /// Does what the hub wants of this link because of another link. A directive that no longer applies has no effect.
    pub fn direct(&mut self, cx: &mut Context<'_, P>, directive: Directive) -> Option<Event> {
        match directive {
            Directive::Challenge => self.challenge(cx),
            Directive::Yield => {
                self.granting.obedience.give_way(&self.wire, cx);
                self.challenge(cx);
            }
            // Its claim may be the lower one by now: the link that it waited for may have raised its own.
            Directive::Admit => return self.consult(cx),
            Directive::Refuse(refusal) => self.wire.refuse(cx, refusal),
            Directive::Close(reason) => self.wire.close(cx, reason),
        }
        None
    }

    /// The hub has admitted the peer: the link goes live and published functions are sent.
    fn admitted(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        self.accept(cx);
        if self.wire.phase != Phase::Live {
            return None;
        }
        self.wire.joined = true;
        if self.is_advertised(cx) {
            self.pump(cx);
        } else {
            self.publish(cx);
        }
        Some(Event::Joined)
    }

    /// Sends the peer what the hub has published to it, as far as the access table lets the peer see it. Returns the serial that
    /// [`Event::Acknowledged`] will carry.
    pub fn publish(&mut self, cx: &mut Context<'_, P>) -> u32 {
        let Some(remote) = &self.wire.remote else { return 0 };
        let (functions, publishing, identity) = (cx.functions, &mut self.wire.publishing, &remote.hello.identity);
        cx.hub.enter(&mut |hub| {
            // Withdraw what became hidden: a change from before the link was live had no other way to reach this link.
            for slot in publishing.all_slots() {
                let is_visible = hub.publications.is_visible(identity, slot);
                publishing.want(slot, functions.generation(slot).filter(|_| is_visible));
            }
            publishing.version = hub.publications.version();
        });
        self.end_of_changes(cx)
    }

    /// Whether something was published since the last [`publish`](Self::publish) of this link. A port with several threads checks
    /// this when a new link becomes visible to them, since a publication may have missed it.
    pub fn is_behind(&self, cx: &mut Context<'_, P>) -> bool {
        let mut newest = self.wire.publishing.version;
        cx.hub.enter(&mut |hub| newest = hub.publications.version());
        newest != self.wire.publishing.version
    }

    /// Ends the link because the key of its pair is no longer valid.
    pub fn revoke(&mut self, cx: &mut Context<'_, P>) {
        self.wire.refuse(cx, Refusal::NoKey);
    }

    /// Ends the link with a close frame; [`poll`](Self::poll) then reports the calls and leases that were open.
    pub fn close(&mut self, cx: &mut Context<'_, P>, reason: CloseReason) {
        self.wire.close(cx, reason);
    }

    /// The connection below the link has ended.
    pub fn disconnected(&mut self, reason: CloseReason) {
        self.wire.end(reason);
    }

    /// Asks the peer of a live link for a sign of life.
    fn challenge(&mut self, cx: &mut Context<'_, P>) {
        if self.wire.phase == Phase::Live {
            self.granting.obedience.note_question(&mut self.wire, cx.now);
            self.wire.challenged = true;
            self.pings.send(&mut self.wire, cx.now);
            self.wire.flush(cx);
            for _ in 0..CHALLENGE_DATAGRAMS {
                self.wire.send_datagram(cx, &SessionBody::PING, &[]);
            }
        }
    }

    /// The stream takes bytes again.
    pub fn writable(&mut self, cx: &mut Context<'_, P>) {
        self.wire.flush(cx);
        self.renewal.pump(&mut self.wire, cx);
        if P::CALLS {
            self.calling.send_releases(&mut self.wire, cx);
        }
        self.pump(cx);
        self.send_refused(cx);
        if STREAMS {
            self.streaming.send_samples(&mut self.wire, cx);
        }
    }

    /// Sends a ping and measures the round trip: [`Event::Answered`] follows, then [`round_trip`](Self::round_trip) is new.
    /// Replaces a ping that is still unanswered. [`Error::NotConnected`] if the link is not live, [`Error::Full`] if the stream has no
    /// capacity.
    pub fn ping(&mut self, cx: &mut Context<'_, P>) -> Result<(), Error> {
        self.pings.ping(&mut self.wire, cx)
    }

    /// The round trip of the last answered [`ping`](Self::ping).
    pub fn round_trip(&self) -> Option<Duration> {
        self.pings.round_trip()
    }

    /// Renews the keys of a secured link when they are between 7/8 of `span` and `span` old, instead of
    /// [`HANDSHAKE_LIFE`](crate::config::HANDSHAKE_LIFE); at least
    /// [`SHORTEST_HANDSHAKE_LIFE`](crate::config::SHORTEST_HANDSHAKE_LIFE). Takes effect with the next handshake, at the end that
    /// dialled; the other end follows.
    pub fn renew_every(&mut self, span: Duration) {
        self.renewal.renew_every(span);
    }

    /// Hands a vehicle over to another manager. [`Event::Answered`] follows, then [`hand_over_answer`](Self::hand_over_answer) has the
    /// answer; a vehicle that consents ends the link. It is back within about
    /// [`HAND_OVER_TIMEOUT`](crate::config::HAND_OVER_TIMEOUT) unless it has joined there.
    ///
    /// Errors: [`Error::NotConnected`], [`Error::Unsupported`] if the peer is no vehicle, [`Error::Full`] if nothing can be sent now.
    pub fn hand_over(&mut self, cx: &mut Context<'_, P>, to: &Manager) -> Result<(), Error> {
        self.handing.ask(&mut self.wire, cx, to)
    }

    /// What the vehicle answered to the last [`hand_over`](Self::hand_over); `None` before its answer, and from one that knows no
    /// hand-over.
    pub fn hand_over_answer(&self) -> Option<Result<(), HandOverRefusal>> {
        self.handing.answer()
    }

    /// Sends this unit's new claim to the peer.
    pub fn announce_claim(&mut self, cx: &mut Context<'_, P>) {
        self.granting.obedience.has_news = true;
        self.pump(cx);
    }

    /// Subscribes to a stream of the peer, with values at least `interval` apart; [`Event::Subscribed`] has the interval that
    /// the peer granted, perhaps a longer one. A repeated call replaces the earlier one. A subscription ends with the link, and
    /// when the peer replaces the stream: a port subscribes again at each [`Event::ListChanged`], which is a no-op if nothing
    /// changed. Errors: [`Error::UnknownFunction`] if the peer has no such stream, [`Error::NotConnected`].
    pub fn subscribe(&mut self, cx: &mut Context<'_, P>, stream: &str, interval: Duration) -> Result<Slot, Error> {
        self.streaming.wish(&mut self.wire, cx, stream, Some(interval))
    }

    /// Ends a subscription to a stream of the peer.
    pub fn unsubscribe(&mut self, cx: &mut Context<'_, P>, stream: &str) {
        // If the peer has no such stream, there is nothing to end.
        let _ = self.streaming.wish(&mut self.wire, cx, stream, None);
    }

    /// Notes a new value of a stream of this unit, which [`poll`](Self::poll) sends when it is due. Returns whether the peer
    /// subscribes to any stream.
    pub fn stream_changed(&mut self, now: Instant) -> bool {
        self.streaming.changed(&mut self.wire, now)
    }

    /// How many streams of this unit the peer subscribes to.
    pub fn subscriptions(&self) -> u16 {
        self.streaming.active()
    }

    /// Requests a function of the peer. With `wants_reply`, [`Event::Reply`] ends the call, with the returned id; without,
    /// only a failure is reported, as [`Event::Failed`].
    ///
    /// Nothing was sent if it returns an error: [`Error::UnknownFunction`], [`Error::Mismatch`], [`Error::MissingArgument`],
    /// [`Error::WrongType`], [`Error::WrongSize`], [`Error::ResultWouldNotFit`], [`Error::TooLarge`], [`Error::TooSoon`],
    /// [`Error::Full`], [`Error::SlowHeart`], [`Error::NotConnected`].
    pub fn request(
        &mut self,
        cx: &mut Context<'_, P>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        let result = self.calling.request(&mut self.wire, cx, callee, parameters, options, wants_reply);
        match result {
            Ok(_) => self.wire.link.counters.count(LinkCounter::RequestsSent),
            Err(_) => self.wire.link.counters.count(LinkCounter::RequestsWithheld),
        }
        result
    }

    /// Numbers a call that may have to wait before it can be sent. Passed in [`RequestOptions::made`], the number keeps the
    /// call's place among those for one actuator: it is refused as [`Error::Replaced`] if a later one has begun.
    pub fn make(&mut self) -> Made {
        self.calling.requests.make()
    }

    /// Whether this unit is renewing the lease of a call.
    pub fn holds(&self, call: CallId) -> bool {
        self.calling.holds(call)
    }

    /// Whether this unit is renewing the lease of any call.
    pub fn renews(&self) -> bool {
        self.calling.renews()
    }

    /// How much of a function's leases is left, counted from the last answer to a renewal; `None` if none is renewed. An answer
    /// names its call, not which renewal it answers: if an answer to an earlier renewal was delayed, the value is too high by
    /// that delay.
    pub fn lease_left(&self, now: Instant, slot: Slot) -> Option<Duration> {
        self.calling.lease_left(now, slot)
    }

    /// A heart has stopped: releases the calls that name it.
    pub fn release_beats(&mut self, cx: &mut Context<'_, P>, beats: Beats) {
        self.calling.release_beats(&mut self.wire, cx, beats);
    }

    /// Gives a call up. A reply that still comes counts as late, and the lease that the call holds, or would get, is released.
    /// Works for an answered call that holds a lease, too. Other calls are not affected.
    pub fn cancel(&mut self, cx: &mut Context<'_, P>, id: CallId) {
        self.calling.cancel(&mut self.wire, cx, id);
    }

    /// As [`cancel`](Self::cancel), but still reports the answer: the handler is notified and its motion stops. If no answer
    /// comes in time, end the call with [`cancel`](Self::cancel).
    pub fn cancel_but_wait(&mut self, cx: &mut Context<'_, P>, id: CallId) {
        self.calling.cancel_but_wait(&mut self.wire, cx, id);
    }

    /// Releases all calls of a function of the peer, including requests still on their way: what they started stops.
    ///
    /// [`Error::Full`] if no release can be sent now. Renewals have ended all the same, and the port may try again.
    pub fn release(&mut self, cx: &mut Context<'_, P>, slot: Slot) -> Result<(), Error> {
        self.calling.release(&mut self.wire, cx, slot)
    }

    /// Writes the gathered one-way messages now.
    pub fn flush_gathered(&mut self, cx: &mut Context<'_, P>) {
        self.wire.flush(cx);
    }

    /// How many calls of this unit may be in flight.
    pub fn call_slots(&self) -> usize {
        self.calling.requests.slots()
    }

    /// Lends more slots for calls of this unit: a multiple of the present number. Returns the slots that are now unused, which
    /// are the new ones if they are not such a multiple.
    pub fn lend_calls(
        &mut self,
        pending: <P::Storage as Storage>::Slice<Option<Pending>>,
    ) -> <P::Storage as Storage>::Slice<Option<Pending>> {
        self.calling.requests.grow(pending)
    }

    /// How many slots there are for running calls of the peer, and how many of its calls run or wait.
    pub fn running_slots(&self) -> (usize, u16) {
        (self.calls.slots(), self.calls.held())
    }

    /// Lends more slots for running calls of the peer. Returns the unused slots: the new ones if they are fewer than before.
    pub fn lend_running(
        &mut self,
        running: <P::Storage as Storage>::Slice<Option<RunningCall>>,
    ) -> <P::Storage as Storage>::Slice<Option<RunningCall>> {
        self.calls.grow(running)
    }

    /// Sets how many functions, and bytes of signatures, the peer's list may grow to if the storage has an allocator.
    pub const fn let_list_grow(&mut self, functions: usize, bytes: usize) {
        self.wire.theirs.let_grow(functions, bytes);
    }

    /// How many functions of this unit's list can be published on this link.
    pub fn publication_slots(&self) -> usize {
        self.wire.publishing.slots()
    }

    /// Lends more slots for functions of this unit's own list. Returns the unused slots: the new ones if they are fewer.
    pub fn lend_publications(
        &mut self,
        publications: <P::Storage as Storage>::Slice<Publication>,
    ) -> <P::Storage as Storage>::Slice<Publication> {
        self.wire.publishing.grow(publications)
    }

    /// The application has finished what this order started: it is no longer renewed, and its hook does not run. Returns `false`
    /// if no call of this peer has that order, or if it ended before it was finished: then its hook runs.
    pub fn end_order(&mut self, cx: &mut Context<'_, P>, lease: &Lease, order: Order) -> bool {
        self.granting.end_order(&mut self.wire, cx, lease, order)
    }

    /// Whether the peer has processed this unit's list up to `serial`.
    pub fn is_acknowledged(&self, serial: u32) -> bool {
        self.wire.publishing.is_acknowledged(serial)
    }

    /// Hides a function from the peer.
    pub fn withdraw(&mut self, cx: &mut Context<'_, P>, slot: Slot) -> u32 {
        self.wire.publishing.want(slot, None);
        self.end_of_changes(cx)
    }

    /// Applies a changed access table to a live link: publishes what the peer may see now, ends leases that it may no longer
    /// hold, and hides those of its functions that it may not publish. A link that goes live later uses the new table anyway.
    /// Returns the serial that [`Event::Acknowledged`] will carry.
    pub fn access_changed(&mut self, cx: &mut Context<'_, P>) -> u32 {
        self.wire.publishing.fill_buckets();
        self.granting.cut_forbidden(&mut self.wire, cx);
        let remote = self.wire.remote.as_ref();
        self.wire.theirs.show_only(|name| decide(cx.table(), remote, name, Verb::Publish).is_allowed());
        self.end_of_changes(cx)
    }

    pub(super) fn end_of_changes(&mut self, cx: &mut Context<'_, P>) -> u32 {
        let serial = self.wire.publishing.end_changes();
        self.granting.cut_gone(&mut self.wire, cx);
        self.pump(cx);
        serial
    }

    /// Whether all publications up to the unit's newest have been sent to the peer or are queued for it.
    pub(super) fn is_advertised(&self, cx: &mut Context<'_, P>) -> bool {
        self.wire.publishing.has_begun() && !self.is_behind(cx)
    }

    /// Changes this unit's limits and sends them to the peer.
    pub fn set_constraints(&mut self, cx: &mut Context<'_, P>, constraints: Constraints) {
        self.wire.constraints = constraints;
        self.wire.link.set_message_limit(message_limit(&constraints));
        self.wire.publishing.notify_limits();
        self.pump(cx);
    }
}

fn message_limit(constraints: &Constraints) -> usize {
    (constraints.message_size as usize).saturating_add(LONGEST_HEADER_BYTES).max(LEAST_MESSAGE_BYTES)
}

/// Size of a pool buffer that holds a message of `message_size`, framed, whatever the chunk size and with `overhead` per frame.
pub const fn buffer_bytes(message_size: u32, overhead: usize) -> usize {
    let total = (message_size as usize).saturating_add(LONGEST_HEADER_BYTES);
    let total = if total < LEAST_MESSAGE_BYTES { LEAST_MESSAGE_BYTES } else { total };
    let payload = crate::config::MINIMUM_CHUNK_BYTES.saturating_sub(overhead).saturating_sub(FRAME_BYTES);
    let frames = match total.checked_div(payload) {
        Some(frames) => frames.saturating_add(2),
        None => 2,
    };
    total.saturating_add(frames.saturating_mul(FRAME_BYTES.saturating_add(overhead)))
}

#[cfg(test)]
mod tests;
